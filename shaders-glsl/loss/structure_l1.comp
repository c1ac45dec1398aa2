#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"

//! The gradient of mean|clamp(p, 0, 1) - s| with respect to one plane p of the render, s the structure of the
//! pseudo-GT, and partial sums of the difference.
//!
//! A thread processes `VALUES_PER_THREAD` values, one subgroup apart. The gradient passes the clamp for 0 <= p <= 1 and
//! is 0 without a difference. Reference: `src/reference/structure_l1.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint VALUES_PER_THREAD = 32;

layout(push_constant) uniform Params {
    uint  pixel_count;  // HW
    uint  first;        // the plane's first value in render and d_render
    float scale;        // weight / (HW)
};

layout(binding = 0) readonly  buffer Render    { float render[]; };     // (channels, H, W)
layout(binding = 1) readonly  buffer Structure { float structure[]; };  // (H, W), in [0, 1]
layout(binding = 2) writeonly buffer DRender   { float d_render[]; };   // (channels, H, W)
layout(binding = 3) writeonly buffer Partials  { float partials[]; };   // one per workgroup

void main() {
    uint start = WORKGROUP_INDEX * SUBGROUP_SIZE * VALUES_PER_THREAD;
    if (start >= pixel_count) return;
    start += gl_LocalInvocationID.x;
    float sum = 0.0;
    for (uint k = 0; k < VALUES_PER_THREAD; ++k) {
        uint i = start + k * SUBGROUP_SIZE;
        if (i < pixel_count) {
            float p = render[first + i];
            float difference = within_unit(p) - structure[i];
            bool passes = p >= 0.0 && p <= 1.0;
            d_render[first + i] = passes ? scale * sign(difference) : 0.0;
            sum += abs(difference);
        }
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) partials[WORKGROUP_INDEX] = sum;
}
