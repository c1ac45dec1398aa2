#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "camera.glsl"

//! Camera gradient: the sum of all Gaussians' shares, a subgroup for each number, in a fixed order.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant) uniform Params { uint gaussian_count; };

layout(binding = 0) readonly  buffer Shares   { float shares[]; };    // (gaussian_count, CAMERA_WIDTH)
layout(binding = 1) writeonly buffer Gradient { float gradient[]; };  // (CAMERA_WIDTH)

void main() {
    uint number = WORKGROUP_INDEX;
    float sum = 0.0;
    for (uint i = gl_SubgroupInvocationID; i < gaussian_count; i += SUBGROUP_SIZE)
        sum += shares[CAMERA_WIDTH * i + number];
    sum = subgroup_sum(sum);
    if (subgroupElect()) gradient[number] = sum;
}
