#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm.glsl"

//! The sums of every channel from those of its chunks; adds them to the gradients of beta and gamma.
//!
//! One subgroup per channel, in a fixed order. Reference: `src/reference/norm_backward_merge.rs`.

layout(binding = 0) readonly  buffer Partials  { vec2 partials[]; };  // (C, chunks): sums of d_y and of d_y n
layout(binding = 1) writeonly buffer Sums      { vec2 sums[]; };      // (C,)
layout(binding = 2)           buffer Gradients { float gradients[]; };

void main() {
    uint first = CHANNEL * CHUNK_COUNT;
    vec2 sum = vec2(0.0);
    for (uint k = gl_SubgroupInvocationID; k < CHUNK_COUNT; k += SUBGROUP_SIZE) sum += partials[first + k];
    sum = subgroupAdd(sum);
    if (subgroupElect()) {
        sums[CHANNEL] = sum;
        gradients[offset + CHANNEL] += sum.y;
        gradients[offset + channel_count + CHANNEL] += sum.x;
    }
}
