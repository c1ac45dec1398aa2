#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! The gradient of (1 - w) mean|a - b| + w (1 - mean SSIM) with respect to the render a, and partial sums of |a - b|.
//!
//! dSSIM/da = E[dS/dE[a]] + 2 a E[dS/dE[aa]] + b E[dS/dE[ab]]: the window is symmetric and zero outside the
//! image, so the transposed blur is the blur. The derivatives come from `ssim_forward`, which shares the
//! mapping to subgroups. At a = b the gradient of the L1 term is 0. Means are over the interior; the L1 term stays
//! inside it, the SSIM term reaches a window's radius beyond. Reference: `src/reference/ssim_backward.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint  width;           // pixels
    uint  height;          // pixels
    uvec2 interior_begin;  // the first pixel
    uvec2 interior_end;    // one past the last
    uint  channel_begin;   // the channels of this dispatch: `d_moments` holds theirs alone
    uint  channel_end;     // one past the last
    float l1_scale;        // (1 - w) / (3hw), h x w the interior
    float ssim_scale;      // w / (3hw)
};

layout(binding = 0) readonly  buffer Render   { vec4 render[]; };           // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Low      { vec4 low[]; };              // (3, H, W), sRGB-encoded
layout(binding = 2) readonly  buffer Tone     { ToneParameters tone[]; };   // (1,)
layout(binding = 3) readonly  buffer DMoments { vec3 d_moments[]; };        // (channels, H, W, 3), dS/dE[a], dS/dE[aa], dS/dE[ab]
layout(binding = 4) writeonly buffer DRender  { float d_render[]; };        // (3, H, W)
layout(binding = 5)           buffer Partials { float partials[]; };        // one per workgroup, over the channels so far

#include "ssim.glsl"

// The three derivatives, in the order of the arrays below.
const uint MEAN = 0, SQUARE = 1, PRODUCT = 2, DERIVATIVES = 3;

void main() {
    Strip strip = strip_of(WORKGROUP_INDEX, channel_begin, width, height);
    if (strip.channel >= channel_end) return;
    uint plane = strip.channel * width * height;
    uint moments = plane - channel_begin * width * height;
    float pending[DERIVATIVES][COLUMNS][PENDING];
    [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m)
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x)
            [[unroll]] for (uint k = 0; k < PENDING; ++k) pending[m][x][k] = 0.0;

    ToneParameters curve = tone[0];
    float sum = 0.0;
    for (int y = strip.y - RADIUS; y < strip.end + RADIUS; ++y) {
        int done = y - RADIUS;
        float own[DERIVATIVES][COLUMNS];
        [[unroll]] for (uint c = 0; c < COLUMNS; ++c) {
            uint x = uint(strip.x) + c;
            bool inside = x < width && uint(y) < height;
            vec3 d = d_moments[inside ? moments + uint(y) * width + x : 0];
            [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m) own[m][c] = inside ? d[m] : 0.0;
        }
        float a[COLUMNS], b[COLUMNS];
        load_row(strip, done, uvec2(width, height), curve, a, b);
        float row[DERIVATIVES][REACH];
        [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m)
            [[unroll]] for (uint k = 0; k < REACH; ++k) row[m][k] = seen(own[m], k);
        [[unroll]] for (uint x = 0; x < COLUMNS; ++x) {
            float blurred[DERIVATIVES];
            [[unroll]] for (uint m = 0; m < DERIVATIVES; ++m) {
                float value = blur(row[m], x);
                blurred[m] = pending[m][x][0] + TAPS[RADIUS] * value;
                [[unroll]] for (int k = 1; k < PENDING; ++k)
                    pending[m][x][k - 1] = pending[m][x][k] + TAPS[abs(k - RADIUS)] * value;
                pending[m][x][PENDING - 1] = TAPS[RADIUS] * value;
            }
            if (done >= strip.y && has_output(strip, x, width)) {
                uint column = uint(strip.x) + x;
                float d_ssim = blurred[MEAN] + 2.0 * a[x] * blurred[SQUARE] + b[x] * blurred[PRODUCT];
                bool counts = is_inside(column, uint(done), interior_begin, interior_end);
                float difference = counts ? a[x] - b[x] : 0.0;
                d_render[plane + uint(done) * width + column] = l1_scale * sign(difference) - ssim_scale * d_ssim;
                sum += abs(difference);
            }
        }
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) {
        float of_channels_before = channel_begin > 0 ? partials[WORKGROUP_INDEX] : 0.0;
        partials[WORKGROUP_INDEX] = of_channels_before + sum;
    }
}
