#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"
#include "ssim.glsl"

//! SSIM of a render against the pseudo-GT, and its derivatives with respect to the blurred moments.
//!
//! With a the render, b the target, and E[.] the windowed mean, per pixel and channel:
//! S = (2 E[a] E[b] + C1) (2 (E[ab] - E[a] E[b]) + C2)
//!   / ((E[a]^2 + E[b]^2 + C1) (E[aa] - E[a]^2 + E[bb] - E[b]^2 + C2)).
//! Writes dS/dE[a], dS/dE[aa], dS/dE[ab] for `ssim_backward`, and one partial sum of S per workgroup. Pixels outside the
//! interior are seen by the windows, but their S counts neither in the sum nor in the derivatives, which are 0 there.
//! The thread mapping is that of include/ssim.glsl. Reference: `src/reference/ssim_forward.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint  width;           // pixels
    uint  height;          // pixels
    uvec2 interior_begin;  // the first pixel
    uvec2 interior_end;    // one past the last
};

layout(binding = 0) readonly  buffer Render   { vec4 render[]; };           // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Low      { vec4 low[]; };              // (3, H, W), sRGB-encoded
layout(binding = 2) readonly  buffer Tone     { ToneParameters tone[]; };   // (1,)
layout(binding = 3) writeonly buffer DMoments { vec3 d_moments[]; };        // (3, H, W, 3), dS/dE[a], dS/dE[aa], dS/dE[ab]
layout(binding = 4) writeonly buffer Partials { float partials[]; };        // one per workgroup

const float C1 = 0.0001;  // (0.01 L)^2, L = 1
const float C2 = 0.0009;  // (0.03 L)^2

// The five blurred moments, in the order of the arrays below.
const uint A = 0, B = 1, AA = 2, BB = 3, AB = 4, MOMENTS = 5;

// S at one pixel, 0 where it does not count; leaves its three derivatives at `i`.
float ssim(float moments[MOMENTS], uint i, bool counts) {
    float a = moments[A], b = moments[B];
    float a1 = 2.0 * a * b + C1;
    float a2 = 2.0 * (moments[AB] - a * b) + C2;
    float b1 = a * a + b * b + C1;
    // The variances are not negative: only the cancellation of large bright values reaches the floor.
    float b2 = max(moments[AA] - a * a + moments[BB] - b * b, 0.0) + C2;
    float scale = 1.0 / (b1 * b2);
    float s = a1 * a2 * scale;
    vec3 d = vec3(2.0 * (b * (a2 - a1) * scale - a * s * (1.0 / b1 - 1.0 / b2)), -s / b2, 2.0 * a1 * scale);
    d_moments[i] = counts ? d : vec3(0);
    return counts ? s : 0.0;
}

void main() {
    Strip strip = strip_of(THREAD_INDEX, width, height);
    uint plane = strip.channel * width * height;
    float pending[MOMENTS][COLUMNS][PENDING];
    [[unroll]] for (uint m = 0; m < MOMENTS; ++m)
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x)
            [[unroll]] for (uint k = 0; k < PENDING; ++k) pending[m][x][k] = 0.0;

    ToneParameters curve = tone[0];
    float sum = 0.0;
    int last_quad = int(3 * width * height - 1) / 4;
    // A workgroup's last threads can be beyond the image: no rows, yet they take part in the sum.
    int end = strip.channel < 3 ? strip.end + RADIUS : strip.y - RADIUS;
    for (int y = strip.y - RADIUS; y < end; ++y) {
        int from = (int(strip.channel * height) + y) * int(width) + strip.x - RADIUS;
        vec4 render_quads[QUADS], low_quads[QUADS];
        [[unroll]] for (int q = 0; q < QUADS; ++q) {
            // Beyond the image a window sees zeros, whatever is loaded.
            int quad = clamp((from >> 2) + q, 0, last_quad);
            render_quads[q] = render[quad];
            low_quads[q] = low[quad];
        }
        float row[MOMENTS][REACH];
        [[unroll]] for (int k = 0; k < REACH; ++k) {
            int x = strip.x + k - RADIUS;
            bool inside = x >= 0 && x < int(width) && y >= 0 && y < int(height);
            float a = inside ? unpack(render_quads, k, from & 3) : 0.0;
            float b = inside ? tone_curve(unpack(low_quads, k, from & 3), curve) : 0.0;
            row[A][k] = a;
            row[B][k] = b;
            row[AA][k] = a * a;
            row[BB][k] = b * b;
            row[AB][k] = a * b;
        }
        int done = y - RADIUS;
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x) {
            float moments[MOMENTS];
            [[unroll]] for (uint m = 0; m < MOMENTS; ++m) {
                float value = blur(row[m], x);
                moments[m] = pending[m][x][0] + TAPS[RADIUS] * value;
                [[unroll]] for (int k = 1; k < PENDING; ++k)
                    pending[m][x][k - 1] = pending[m][x][k] + TAPS[abs(k - RADIUS)] * value;
                pending[m][x][PENDING - 1] = TAPS[RADIUS] * value;
            }
            uint column = uint(strip.x) + x;
            if (done >= strip.y && column < width) {
                bool counts = is_inside(column, uint(done), interior_begin, interior_end);
                sum += ssim(moments, plane + uint(done) * width + column, counts);
            }
        }
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) partials[WORKGROUP_INDEX] = sum;
}
