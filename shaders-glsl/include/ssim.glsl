// The window of SSIM, and how the SSIM kernels march over an image.
//
// Wang et al. 2004 with the window of 3DGS: 11 x 11 Gaussian, sigma 1.5, zero padding, per channel.
//
// A thread owns COLUMNS columns of one channel and marches down ROWS rows. Per input row it blurs along x
// in registers and adds the result, weighted by the taps along y, to the outputs still in reach: each value
// is loaded once per strip, nothing is shared between threads, and no barrier is needed.

layout(constant_id = 0) const uint COLUMNS = 8;  // outputs per row and thread
layout(constant_id = 1) const uint ROWS = 32;    // rows per thread, beside 2 RADIUS rows of warm-up

const int RADIUS = 5;               // of the window, pixels
const uint PENDING = 2 * RADIUS;    // rows of outputs in reach beside the one that completes
const uint REACH = COLUMNS + PENDING;  // inputs along x
const uint QUADS = (REACH + 6) / 4;    // aligned vectors of four that hold them, wherever they begin

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

// Input `k` along x, the first of which is `shift` floats into the quads.
float unpack(vec4 quads[QUADS], uint k, uint shift) {
    float at[4];
    [[unroll]] for (uint s = 0; s < 4; ++s) at[s] = quads[(k + s) / 4][(k + s) % 4];
    return shift < 2 ? (shift == 0 ? at[0] : at[1]) : (shift == 2 ? at[2] : at[3]);
}

// The rectangle whose pixels count: all of them, or the interior of a view with a margin.
bool is_inside(uint x, uint y, uvec2 begin, uvec2 end) {
    return x >= begin.x && x < end.x && y >= begin.y && y < end.y;
}

// The columns and rows that a thread owns.
struct Strip {
    int x;        // first column
    int y;        // first row
    int end;      // one past the last row
    uint channel; // 0..3; 3 and more: nothing to do
};

Strip strip_of(uint thread, uint width, uint height) {
    uint across = (width + COLUMNS - 1) / COLUMNS;
    uint down = (height + ROWS - 1) / ROWS;
    uint y = thread / across;
    uint top = y % down * ROWS;
    return Strip(int(thread % across * COLUMNS), int(top), int(min(top + ROWS, height)), y / down);
}
