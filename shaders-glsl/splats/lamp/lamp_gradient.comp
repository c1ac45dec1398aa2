#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "lamp.glsl"

//! The gradient of the lamp's numbers: the sum of the partial sums of a view, a subgroup for each number, in a fixed
//! order.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant) uniform Params { uint chunk_count; };

layout(binding = 0) readonly  buffer Partials  { float partials[]; };   // (chunks, LAMP_WIDTH)
layout(binding = 1) writeonly buffer Gradients { float gradients[]; };  // (LAMP_WIDTH)

void main() {
    uint number = WORKGROUP_INDEX;
    float sum = 0.0;
    for (uint k = gl_SubgroupInvocationID; k < chunk_count; k += SUBGROUP_SIZE)
        sum += partials[LAMP_WIDTH * k + number];
    sum = subgroup_sum(sum);
    if (subgroupElect()) gradients[number] = sum;
}
