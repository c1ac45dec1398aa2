#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "exposure.glsl"

//! The gradient of `expose`: of the render, in place of that of the exposed image, and the sums of gain d c and of d
//! per chunk, for the gradient of the exposure. A value that `expose` has clipped at its target has the gradient 0.
//!
//! A subgroup processes `CHUNK` values of one channel, in a fixed order: the partition of a sum does not depend on the
//! device. Reference: `src/reference/expose_backward.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"
layout(constant_id = 0) const uint CHUNK = 1024;

layout(push_constant) uniform Params {
    uint pixel_count;  // of a channel
    uint view;
};

layout(binding = 0) readonly  buffer Exposures { float exposures[]; };  // (views, EXPOSURE_WIDTH)
layout(binding = 1) readonly  buffer Whites    { float whites[]; };     // (views, 3), the target of white
layout(binding = 2) readonly  buffer Render    { float render[]; };     // (3, H, W) and more, not clamped
layout(binding = 3) readonly  buffer Target    { float target[]; };     // (3, H, W)
layout(binding = 4) readonly  buffer Exposed   { float exposed[]; };    // (3, H, W), of `expose`
layout(binding = 5)           buffer DRender { float d_render[]; };  // (3, H, W) and more: d, then that of the render
layout(binding = 6) writeonly buffer Partials  { vec2 partials[]; };    // (3, chunks)

void main() {
    uint channel = gl_WorkGroupID.y;
    uint chunk_count = (pixel_count + CHUNK - 1) / CHUNK;
    uint end = min((gl_WorkGroupID.x + 1) * CHUNK, pixel_count);
    float gain = exp(exposures[view * EXPOSURE_WIDTH + channel]);
    float white = whites[3 * view + channel];
    vec2 sums = vec2(0.0);
    for (uint k = gl_WorkGroupID.x * CHUNK + gl_SubgroupInvocationID; k < end; k += SUBGROUP_SIZE) {
        uint i = channel * pixel_count + k;
        float t = target[i];
        float d = exposed[i] >= t && is_clipped(t, white) ? 0.0 : d_render[i];
        float of_render = gain * d;
        sums += vec2(of_render * render[i], d);
        d_render[i] = of_render;
    }
    sums = subgroup_sum(sums);
    if (subgroupElect()) partials[channel * chunk_count + gl_WorkGroupID.x] = sums;
}
