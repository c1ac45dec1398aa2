#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_memory_scope_semantics : require
#include "kernel.glsl"

//! SSIM of a render a against the pseudo-GT b: partial sums of S and, for `ssim_backward`, the derivatives of S with
//! respect to the blurred moments. Both together are `ssim`, in two passes for GPUs.
//!
//! The derivatives are zero outside the loss region. A subgroup blurs a strip (include/ssim_strip.glsl). Reference:
//! `src/reference/ssim_forward.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant, scalar) uniform Params {
    uint  width;       // pixels
    uint  height;      // pixels
    uint  rows;        // of a strip
    uvec2 loss_begin;  // the first pixel
    uvec2 loss_end;    // one past the last
};

layout(binding = 0) readonly  buffer Render   { float render[]; };    // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Target   { float target[]; };    // (3, H, W)
layout(binding = 2) writeonly buffer DMean    { float d_mean[]; };    // (3, H, W), dS/dE[a]
layout(binding = 3) writeonly buffer DSquare  { float d_square[]; };  // (3, H, W), dS/dE[aa]
layout(binding = 4) writeonly buffer DProduct { float d_product[]; };  // (3, H, W), dS/dE[ab]
layout(binding = 5) writeonly buffer Partials { float partials[]; };  // one per workgroup: sum of S

#include "ssim_window.glsl"
#include "ssim_strip.glsl"

shared vec2 shared_rows[2 * ROW];

// Loads row `y` of both images; zero outside the image.
void load_row(Strip strip, int y, uint first) {
    [[unroll]] for (uint k = 0; k < LOADS; ++k) {
        uint column = k * SUBGROUP_SIZE + gl_SubgroupInvocationID;
        if (column >= ROW) continue;
        vec2 loaded = vec2(0.0);
        if (is_in_image(strip, column, y)) {
            uint at = index_of(strip, column, y);
            loaded = vec2(render[at], target[at]);
        }
        shared_rows[first + column] = loaded;
    }
}

vec4 moments_of(vec2 x) { return vec4(x, x.x * x.x + x.y * x.y, x.x * x.y); }

// The moments around a place of shared memory, blurred along x.
vec4 blur(uint centre) {
    vec4 sum = TAPS[0] * moments_of(shared_rows[centre]);
    [[unroll]] for (int d = 1; d <= RADIUS; ++d) {
        // Otherwise compilers load all values first, for which there may be no registers.
        share_rows();
        sum += TAPS[d] * (moments_of(shared_rows[centre - d]) + moments_of(shared_rows[centre + d]));
    }
    return sum;
}

void main() {
    Strip strip = strip_of(WORKGROUP_INDEX);
    if (strip.channel >= 3) return;
    uint x = strip.x + gl_SubgroupInvocationID;
    vec4 pending[PENDING];
    [[unroll]] for (uint k = 0; k < PENDING; ++k) pending[k] = vec4(0.0);

    float sum = 0.0;
    for (int y = strip.y - RADIUS; y < strip.end + RADIUS; ++y) {
        uint first = (uint(y) & 1) * ROW;
        load_row(strip, y, first);
        share_rows();
        vec4 value = blur(first + gl_SubgroupInvocationID + RADIUS);
        vec4 moments = pending[0] + TAPS[RADIUS] * value;
        [[unroll]] for (int k = 1; k < PENDING; ++k) pending[k - 1] = pending[k] + TAPS[abs(k - RADIUS)] * value;
        pending[PENDING - 1] = TAPS[RADIUS] * value;

        int complete = y - RADIUS;
        if (complete < strip.y || x >= width) continue;
        vec3 d_moments;
        float s = ssim(moments, d_moments);
        bool counts = is_inside(x, uint(complete));
        sum += counts ? s : 0.0;
        uint at = (strip.channel * height + uint(complete)) * width + x;
        d_mean[at] = counts ? d_moments.x : 0.0;
        d_square[at] = counts ? d_moments.y : 0.0;
        d_product[at] = counts ? d_moments.z : 0.0;
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) partials[WORKGROUP_INDEX] = sum;
}
