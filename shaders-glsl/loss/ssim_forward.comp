#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! SSIM of a render against the pseudo-GT, and its derivatives with respect to the blurred moments.
//!
//! With a the render, b the target, and E[.] the windowed mean, per pixel and channel:
//! S = (2 E[a] E[b] + C1) (2 (E[ab] - E[a] E[b]) + C2)
//!   / ((E[a]^2 + E[b]^2 + C1) (E[aa] - E[a]^2 + E[bb] - E[b]^2 + C2)).
//! Writes dS/dE[a], dS/dE[aa], dS/dE[ab] for `ssim_backward`, and one partial sum of S per workgroup. Pixels outside the
//! interior are seen by the windows, but their S counts neither in the sum nor in the derivatives, which are 0 there.
//! The mapping to subgroups is that of include/ssim.glsl. Reference: `src/reference/ssim_forward.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint  width;           // pixels
    uint  height;          // pixels
    uvec2 interior_begin;  // the first pixel
    uvec2 interior_end;    // one past the last
    uint  channel_begin;   // the channels of this dispatch: `d_moments` holds theirs alone
    uint  channel_end;     // one past the last
};

layout(binding = 0) readonly  buffer Render   { vec4 render[]; };           // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Low      { vec4 low[]; };              // (3, H, W), sRGB-encoded
layout(binding = 2) readonly  buffer Tone     { ToneParameters tone[]; };   // (1,)
layout(binding = 3) writeonly buffer DMoments { vec3 d_moments[]; };        // (channels, H, W, 3), dS/dE[a], dS/dE[aa], dS/dE[ab]
layout(binding = 4)           buffer Partials { float partials[]; };        // one per workgroup, over the channels so far

#include "ssim.glsl"

const float C1 = 0.0001;  // (0.01 L)^2, L = 1
const float C2 = 0.0009;  // (0.03 L)^2

// The blurred moments, in the order of the arrays below: of the squares, SSIM knows the sum alone.
const uint A = 0, B = 1, SQUARES = 2, PRODUCT = 3, MOMENTS = 4;

// S at one pixel, 0 where it does not count; leaves its three derivatives at `i`.
float ssim(float moments[MOMENTS], uint i, bool counts) {
    float a = moments[A], b = moments[B];
    float a1 = 2.0 * a * b + C1;
    float a2 = 2.0 * (moments[PRODUCT] - a * b) + C2;
    float b1 = a * a + b * b + C1;
    // The variances are not negative: only the cancellation of large bright values reaches the floor.
    float b2 = max(moments[SQUARES] - (a * a + b * b), 0.0) + C2;
    float scale = 1.0 / (b1 * b2);
    float s = a1 * a2 * scale;
    vec3 d = vec3(2.0 * (b * (a2 - a1) * scale - a * s * (1.0 / b1 - 1.0 / b2)), -s / b2, 2.0 * a1 * scale);
    d_moments[i] = counts ? d : vec3(0);
    return counts ? s : 0.0;
}

void main() {
    Strip strip = strip_of(WORKGROUP_INDEX, channel_begin, width, height);
    if (strip.channel >= channel_end) return;
    uint plane = (strip.channel - channel_begin) * width * height;
    float pending[MOMENTS][COLUMNS][PENDING];
    [[unroll]] for (uint m = 0; m < MOMENTS; ++m)
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x)
            [[unroll]] for (uint k = 0; k < PENDING; ++k) pending[m][x][k] = 0.0;

    ToneParameters curve = tone[0];
    float sum = 0.0;
    for (int y = strip.y - RADIUS; y < strip.end + RADIUS; ++y) {
        int done = y - RADIUS;
        float a[COLUMNS], b[COLUMNS];
        load_row(strip, y, uvec2(width, height), curve, a, b);
        float row[MOMENTS][REACH];
        [[unroll]] for (uint k = 0; k < REACH; ++k) {
            float a_here = seen(a, k);
            float b_here = seen(b, k);
            row[A][k] = a_here;
            row[B][k] = b_here;
            row[SQUARES][k] = a_here * a_here + b_here * b_here;
            row[PRODUCT][k] = a_here * b_here;
        }
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x) {
            float moments[MOMENTS];
            [[unroll]] for (uint m = 0; m < MOMENTS; ++m) {
                float value = blur(row[m], x);
                moments[m] = pending[m][x][0] + TAPS[RADIUS] * value;
                [[unroll]] for (int k = 1; k < PENDING; ++k)
                    pending[m][x][k - 1] = pending[m][x][k] + TAPS[abs(k - RADIUS)] * value;
                pending[m][x][PENDING - 1] = TAPS[RADIUS] * value;
            }
            if (done >= strip.y && has_output(strip, x, width)) {
                uint column = uint(strip.x) + x;
                bool counts = is_inside(column, uint(done), interior_begin, interior_end);
                sum += ssim(moments, plane + uint(done) * width + column, counts);
            }
        }
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) {
        float of_channels_before = channel_begin > 0 ? partials[WORKGROUP_INDEX] : 0.0;
        partials[WORKGROUP_INDEX] = of_channels_before + sum;
    }
}
