// The window of SSIM, and how the SSIM kernels march over an image.
//
// Wang et al. 2004 with the window of 3DGS: 11 x 11 Gaussian, sigma 1.5, zero padding, per channel.
//
// A subgroup owns a run of columns of one channel and marches down ROWS rows. Every lane loads COLUMNS of a row and takes
// what its windows reach beyond from the lanes beside it, so that a value is loaded once, but for the ends of the run, where
// windows lack a side and have no outputs. Per input row a lane blurs along x in registers and adds the result, weighted by
// the taps along y, to the outputs still in reach. No barrier is needed.
//
// The includer declares SUBGROUP_SIZE and the images `vec4 render[]` and `vec4 low[]`, (3, H, W).

layout(constant_id = 0) const uint COLUMNS = 8;  // per row and lane; SUBGROUP_SIZE * COLUMNS > 2 RADIUS
layout(constant_id = 1) const uint ROWS = 32;    // per subgroup, beside 2 RADIUS rows of warm-up

const int RADIUS = 5;               // of the window, pixels
const uint PENDING = 2 * RADIUS;       // rows of outputs in reach beside the one that completes
const uint REACH = COLUMNS + PENDING;  // columns that the windows of a lane see
const uint OUTPUTS = SUBGROUP_SIZE * COLUMNS - PENDING;  // columns of a subgroup that see a whole window
const uint QUADS = (COLUMNS + 6) / 4;  // aligned vectors of four that hold COLUMNS, wherever they begin

// exp(-d^2 / (2 sigma^2)) / sum for d = 0..RADIUS.
const float TAPS[RADIUS + 1] =
    float[](0.2660117248617943, 0.21300553771125366, 0.1093606895097, 0.03600077212843082, 0.007598758135239184, 0.0010283800844791099);

// Column `x` of the blurred row: one window of a row in registers.
float blur(float row[REACH], uint x) {
    uint centre = x + RADIUS;
    float sum = TAPS[0] * row[centre];
    [[unroll]] for (int d = 1; d <= RADIUS; ++d) sum += TAPS[d] * (row[centre - d] + row[centre + d]);
    return sum;
}

// Column `k` of those that a lane's windows see, the first of them RADIUS before its own.
float seen(float own[COLUMNS], uint k) {
    int column = int(k) - RADIUS;
    int lanes = (column + 16 * int(COLUMNS)) / int(COLUMNS) - 16;
    float value = own[column - lanes * int(COLUMNS)];
    if (lanes == 0) return value;
    return subgroupShuffle(value, (gl_SubgroupInvocationID + uint(lanes)) & (SUBGROUP_SIZE - 1));
}

// Float `k` of the quads from the one at `shift` on; two steps, as a device that only selects pays for four.
float unpack(vec4 quads[QUADS], uint k, int shift) {
    float at[4];
    [[unroll]] for (uint s = 0; s < 4; ++s) at[s] = quads[min((k + s) / 4, QUADS - 1)][(k + s) % 4];
    bool by_two = shift >= 2;
    return (shift & 1) == 0 ? (by_two ? at[2] : at[0]) : (by_two ? at[3] : at[1]);
}

// The rectangle whose pixels count: all of them, or the interior of a view with a margin.
bool is_inside(uint x, uint y, uvec2 begin, uvec2 end) {
    return x >= begin.x && x < end.x && y >= begin.y && y < end.y;
}

// The columns and rows of a lane.
struct Strip {
    int x;         // the first column that it loads
    int y;         // the first row of outputs
    int end;       // one past the last
    uint channel;  // may be past the last: nothing to do
};

// The strip of a workgroup, the first of which begins with channel `first`.
Strip strip_of(uint workgroup, uint first, uint width, uint height) {
    uint across = (width + OUTPUTS - 1) / OUTPUTS;
    uint down = (height + ROWS - 1) / ROWS;
    uint y = workgroup / across;
    uint top = y % down * ROWS;
    int x = int(workgroup % across * OUTPUTS + gl_SubgroupInvocationID * COLUMNS) - RADIUS;
    return Strip(x, int(top), int(min(top + ROWS, height)), first + y / down);
}

// Whether a lane's own `column` has an output: in the image, and not at an end of the subgroup's run.
bool has_output(Strip strip, uint column, uint width) {
    uint in_run = gl_SubgroupInvocationID * COLUMNS + column;
    return in_run - RADIUS < OUTPUTS && uint(strip.x) + column < width;
}

// Row `y` of both images in a lane's columns, the second one behind the curve; zero outside the image.
void load_row(Strip strip, int y, uvec2 size, ToneParameters curve, out float a[COLUMNS], out float b[COLUMNS]) {
    int from = (int(strip.channel * size.y) + y) * int(size.x) + strip.x;
    int last_quad = int(3 * size.x * size.y - 1) / 4;
    vec4 render_quads[QUADS], low_quads[QUADS];
    [[unroll]] for (int q = 0; q < QUADS; ++q) {
        int quad = clamp((from >> 2) + q, 0, last_quad);
        render_quads[q] = render[quad];
        low_quads[q] = low[quad];
    }
    bool is_row = uint(y) < size.y;
    [[unroll]] for (uint c = 0; c < COLUMNS; ++c) {
        bool inside = is_row && uint(strip.x) + c < size.x;
        a[c] = inside ? unpack(render_quads, c, from & 3) : 0.0;
        b[c] = inside ? tone_curve(unpack(low_quads, c, from & 3), curve) : 0.0;
    }
}
