#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "exposure.glsl"

//! The gradient of all exposures from the partial sums of one view: dL/dp = sum gain d c and dL/dq = BIAS_SCALE sum d
//! of that view, 0 of the others.
//!
//! One subgroup, in a fixed order. Reference: `src/reference/exposure_gradient.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant) uniform Params {
    uint chunk_count;
    uint view;
    uint view_count;
};

layout(binding = 0) readonly  buffer Partials  { vec2 partials[]; };    // (3, chunks)
layout(binding = 1) writeonly buffer Gradients { float gradients[]; };  // (views, EXPOSURE_WIDTH)

void main() {
    uint begin = view * EXPOSURE_WIDTH;
    for (uint i = gl_SubgroupInvocationID; i < view_count * EXPOSURE_WIDTH; i += SUBGROUP_SIZE)
        if (i < begin || i >= begin + EXPOSURE_WIDTH) gradients[i] = 0.0;
    for (uint channel = 0; channel < 3; ++channel) {
        vec2 sums = vec2(0.0);
        for (uint k = gl_SubgroupInvocationID; k < chunk_count; k += SUBGROUP_SIZE)
            sums += partials[channel * chunk_count + k];
        sums = subgroup_sum(sums);
        if (subgroupElect()) {
            gradients[begin + channel] = sums.x;
            gradients[begin + channel + 3] = BIAS_SCALE * sums.y;
        }
    }
}
