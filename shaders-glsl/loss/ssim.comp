#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! L1 and SSIM of a render a against the pseudo-GT b: the gradient of (1 - w) mean|a - b| + w (1 - mean SSIM) with
//! respect to a, and partial sums of |a - b| and of SSIM.
//!
//! Wang et al. 2004 with the window of 3DGS: 11 x 11 Gaussian, sigma 1.5, zero padding, per channel. With E[.] the
//! windowed mean, per pixel and channel: S = (2 E[a] E[b] + C1) (2 (E[ab] - E[a] E[b]) + C2) / ((E[a]^2 + E[b]^2 + C1)
//! (E[aa] - E[a]^2 + E[bb] - E[b]^2 + C2)), and the gradient of sum S is E[dS/dE[a]] + 2 a E[dS/dE[aa]] + b
//! E[dS/dE[ab]]: the window is symmetric and zero outside the image, so the transposed blur is the blur. At a = b the
//! gradient of the L1 term is 0. Means are over the loss region: windows include pixels outside it, but the S of those
//! pixels counts neither in the sum nor in the derivatives. The gradient of the L1 term is zero outside the loss
//! region, that of the SSIM term beyond a window's radius. The first term of a step writes the gradient, the others add
//! to it. Reference: `src/reference/ssim.rs`.
//!
//! A subgroup owns a run of columns of one channel and marches down ROWS rows. Every lane loads COLUMNS of a row and
//! gets the further columns of its windows from neighbouring lanes, so that a value is loaded once, except at the ends
//! of the run, where windows are incomplete and have no outputs. A loaded row is blurred along x in registers and
//! added, weighted by the taps along y, to the moments of the rows in reach; those RADIUS rows above are then complete,
//! their derivatives are blurred in the same way, and the gradient 2 RADIUS rows above is complete. No barrier is
//! needed, and no intermediate image is written. That suits a CPU; on a GPU, whose registers do not hold the state of
//! both blurs, `ssim_forward` and `ssim_backward` are used instead.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint COLUMNS = 8;    // per row and lane; SUBGROUP_SIZE COLUMNS > 2 HALO
layout(constant_id = 1) const uint ROWS = 32;      // per subgroup, in addition to 4 RADIUS rows of warm-up
layout(constant_id = 2) const uint ALIGNMENT = 1;  // 4 if width and COLUMNS are multiples of four: whole vectors
layout(constant_id = 3) const bool ADDS = false;

layout(push_constant) uniform Params {
    uint  width;           // pixels
    uint  height;          // pixels
    uvec2 loss_begin;  // the first pixel
    uvec2 loss_end;    // one past the last
    float l1_scale;        // (1 - w) / (3hw), h x w the loss region
    float ssim_scale;      // w / (3hw)
};

layout(binding = 0) readonly  buffer Render       { vec4 render[]; };          // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Target       { vec4 target[]; };          // (3, H, W)
layout(binding = 2)           buffer DRender      { vec4 d_render[]; };        // (3, H, W)
layout(binding = 3) writeonly buffer L1Partials   { float l1_partials[]; };    // one per workgroup: sum of |a - b|
layout(binding = 4) writeonly buffer SsimPartials { float ssim_partials[]; };  // one per workgroup: sum of S

#include "ssim_window.glsl"

const uint REACH = COLUMNS + PENDING;  // columns that the windows of a lane see
// Columns at an end of a subgroup's run without complete windows of windows.
const uint HALO = (2 * RADIUS + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
const uint OUTPUTS = SUBGROUP_SIZE * COLUMNS - 2 * HALO;
const uint QUADS = (COLUMNS + 7 - ALIGNMENT) / 4;  // vectors of four that contain COLUMNS at any offset

// The blurred moments, in the order of the arrays below; SSIM only needs the sum of the squares.
const uint A = 0, B = 1, SQUARES = 2, PRODUCT = 3, MOMENTS = 4;
// The derivatives with respect to E[a], E[aa] and E[ab].
const uint DERIVATIVES = 3;

// The columns and rows of a lane.
struct Strip {
    int x;         // the first column that it loads
    int y;         // the first row of outputs
    int end;       // one past the last
    uint channel;  // may be past the last: nothing to do
};

Strip strip_of(uint workgroup) {
    uint across = (width + OUTPUTS - 1) / OUTPUTS;
    uint down = (height + ROWS - 1) / ROWS;
    uint y = workgroup / across;
    uint top = y % down * ROWS;
    int x = int(workgroup % across * OUTPUTS + gl_SubgroupInvocationID * COLUMNS) - int(HALO);
    return Strip(x, int(top), int(min(top + ROWS, height)), y / down);
}

// Whether a lane's own `column` has an output: in the image, and not at an end of the subgroup's run.
bool has_output(Strip strip, uint column) {
    uint in_run = gl_SubgroupInvocationID * COLUMNS + column;
    return in_run - HALO < OUTPUTS && uint(strip.x) + column < width;
}

bool is_aligned() {
    uint alignment = ALIGNMENT;
    return alignment == 4;
}

// Float `k` of the quads from the one at `shift` on; in two steps, since a device without dynamic indexing would pay
// for four.
float unpack(vec4 quads[QUADS], uint k, int shift) {
    if (is_aligned()) return quads[k / 4][k % 4];
    float at[4];
    [[unroll]] for (uint s = 0; s < 4; ++s) at[s] = quads[min((k + s) / 4, QUADS - 1)][(k + s) % 4];
    bool by_two = shift >= 2;
    return (shift & 1) == 0 ? (by_two ? at[2] : at[0]) : (by_two ? at[3] : at[1]);
}

// Row `y` of both images in a lane's columns; zero outside the image.
void load_row(Strip strip, int y, out float a[COLUMNS], out float b[COLUMNS]) {
    int from = (int(strip.channel * height) + y) * int(width) + strip.x;
    int last_quad = int(3 * width * height - 1) / 4;
    vec4 render_quads[QUADS], target_quads[QUADS];
    [[unroll]] for (int q = 0; q < QUADS; ++q) {
        int quad = clamp((from >> 2) + q, 0, last_quad);
        render_quads[q] = render[quad];
        target_quads[q] = target[quad];
    }
    bool is_row = uint(y) < height;
    [[unroll]] for (uint c = 0; c < COLUMNS; ++c) {
        bool inside = is_row && uint(strip.x) + c < width;
        a[c] = inside ? unpack(render_quads, c, from & 3) : 0.0;
        b[c] = inside ? unpack(target_quads, c, from & 3) : 0.0;
    }
}

// Stores the gradient in a lane's columns that have outputs, from value `at` on.
void store_row(Strip strip, uint at, float gradient[COLUMNS]) {
    if (is_aligned()) {
        [[unroll]] for (uint x = 0; x < COLUMNS; x += 4)
            if (has_output(strip, x)) {
                vec4 added = vec4(gradient[x], gradient[x + 1], gradient[x + 2], gradient[x + 3]);
                d_render[(at + x) / 4] = ADDS ? d_render[(at + x) / 4] + added : added;
            }
    } else {
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x)
            if (has_output(strip, x)) {
                uint quad = (at + x) / 4, lane = (at + x) % 4;
                d_render[quad][lane] = ADDS ? d_render[quad][lane] + gradient[x] : gradient[x];
            }
    }
}

// Column `k` of those within a lane's windows, the first of them RADIUS before its own.
float seen(float columns[COLUMNS], uint k) {
    int column = int(k) - RADIUS;
    int lanes = (column + 16 * int(COLUMNS)) / int(COLUMNS) - 16;
    float value = columns[column - lanes * int(COLUMNS)];
    if (lanes == 0) return value;
    return subgroupShuffle(value, (gl_SubgroupInvocationID + uint(lanes)) & (SUBGROUP_SIZE - 1));
}

// Column `x` of the blurred row: one window of a row in registers.
float blur(float row[REACH], uint x) {
    uint centre = x + RADIUS;
    float sum = TAPS[0] * row[centre];
    [[unroll]] for (int d = 1; d <= RADIUS; ++d) sum += TAPS[d] * (row[centre - d] + row[centre + d]);
    return sum;
}

// Adds a value blurred along x to the outputs in reach along y; returns the completed one.
float march(inout float pending[PENDING], float value) {
    float complete = pending[0] + TAPS[RADIUS] * value;
    [[unroll]] for (int k = 1; k < PENDING; ++k) pending[k - 1] = pending[k] + TAPS[abs(k - RADIUS)] * value;
    pending[PENDING - 1] = TAPS[RADIUS] * value;
    return complete;
}

void main() {
    Strip strip = strip_of(WORKGROUP_INDEX);
    if (strip.channel >= 3) return;
    uint plane = strip.channel * width * height;
    float pending[MOMENTS][COLUMNS][PENDING], d_pending[DERIVATIVES][COLUMNS][PENDING];
    [[unroll]] for (uint x = 0; x < COLUMNS; ++x) {
        [[unroll]] for (uint k = 0; k < PENDING; ++k) {
            [[unroll]] for (uint m = 0; m < MOMENTS; ++m) pending[m][x][k] = 0.0;
            [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m) d_pending[m][x][k] = 0.0;
        }
    }

    float l1_sum = 0.0, ssim_sum = 0.0;
    for (int y = strip.y - 2 * RADIUS; y < strip.end + 2 * RADIUS; ++y) {
        float a[COLUMNS], b[COLUMNS];
        load_row(strip, y, a, b);
        float row[MOMENTS][REACH];
        [[unroll]] for (uint k = 0; k < REACH; ++k) {
            float a_here = seen(a, k);
            float b_here = seen(b, k);
            row[A][k] = a_here;
            row[B][k] = b_here;
            row[SQUARES][k] = a_here * a_here + b_here * b_here;
            row[PRODUCT][k] = a_here * b_here;
        }
        int complete = y - RADIUS;
        float derivatives[DERIVATIVES][COLUMNS];
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x) {
            float moments[MOMENTS];
            [[unroll]] for (uint m = 0; m < MOMENTS; ++m) moments[m] = march(pending[m][x], blur(row[m], x));
            bool counts = is_inside(uint(strip.x) + x, uint(complete));
            vec3 d_moments;
            float s = ssim(vec4(moments[A], moments[B], moments[SQUARES], moments[PRODUCT]), d_moments);
            [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m) derivatives[m][x] = counts ? d_moments[m] : 0.0;
            bool is_own = complete >= strip.y && complete < strip.end && has_output(strip, x);
            ssim_sum += counts && is_own ? s : 0.0;
        }

        float d_row[DERIVATIVES][REACH];
        [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m)
            [[unroll]] for (uint k = 0; k < REACH; ++k) d_row[m][k] = seen(derivatives[m], k);
        int done = y - 2 * RADIUS;
        load_row(strip, done, a, b);
        float gradient[COLUMNS];
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x) {
            float d[DERIVATIVES];
            [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m) d[m] = march(d_pending[m][x], blur(d_row[m], x));
            float difference = is_inside(uint(strip.x) + x, uint(done)) ? a[x] - b[x] : 0.0;
            gradient[x] = l1_scale * sign(difference) - ssim_scale * d_ssim(a[x], b[x], vec3(d[0], d[1], d[2]));
            l1_sum += done >= strip.y && has_output(strip, x) ? abs(difference) : 0.0;
        }
        if (done >= strip.y) store_row(strip, plane + uint(done) * width + uint(strip.x), gradient);
    }
    l1_sum = subgroupAdd(l1_sum);
    ssim_sum = subgroupAdd(ssim_sum);
    if (subgroupElect()) {
        l1_partials[WORKGROUP_INDEX] = l1_sum;
        ssim_partials[WORKGROUP_INDEX] = ssim_sum;
    }
}
