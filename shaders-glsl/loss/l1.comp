#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The gradient of mean|a - b| with respect to the render a, b the pseudo-GT, and partial sums of |a - b|.
//!
//! A thread processes `VALUES_PER_THREAD` values, one subgroup apart, so that a subgroup reads contiguous values. At a
//! = b the gradient is 0. With `WITH_LOSS_REGION` the mean is over a rectangle of the view, and outside it the gradient
//! is 0. The first term of a step writes the gradient, the others add to it. Reference: `src/reference/l1.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint VALUES_PER_THREAD = 32;
layout(constant_id = 1) const bool WITH_LOSS_REGION = false;
layout(constant_id = 2) const bool ADDS = false;

layout(push_constant) uniform Params {
    uint  value_count;     // 3HW
    float l1_scale;        // 1 / (3hw), h x w the loss region
    uint  width;           // pixels; this and the following only with a loss region
    uint  height;          // pixels
    uvec2 loss_begin;  // the first pixel
    uvec2 loss_end;    // one past the last
};

layout(binding = 0) readonly  buffer Render   { float render[]; };    // (3, H, W), not clamped
layout(binding = 1) readonly  buffer Target   { float target[]; };    // (3, H, W)
layout(binding = 2)           buffer DRender  { float d_render[]; };  // (3, H, W)
layout(binding = 3) writeonly buffer Partials { float partials[]; };  // one per workgroup

bool counts(uint i) {
    if (WITH_LOSS_REGION) {
        uint row = i / width;
        uvec2 pixel = uvec2(i - row * width, row % height);
        return all(greaterThanEqual(pixel, loss_begin)) && all(lessThan(pixel, loss_end));
    }
    return true;
}

void main() {
    uint first = WORKGROUP_INDEX * SUBGROUP_SIZE * VALUES_PER_THREAD;
    if (first >= value_count) return;
    first += gl_LocalInvocationID.x;
    float sum = 0.0;
    for (uint k = 0; k < VALUES_PER_THREAD; ++k) {
        uint i = first + k * SUBGROUP_SIZE;
        if (i < value_count) {
            float difference = counts(i) ? render[i] - target[i] : 0.0;
            float gradient = l1_scale * sign(difference);
            d_render[i] = ADDS ? d_render[i] + gradient : gradient;
            sum += abs(difference);
        }
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) partials[WORKGROUP_INDEX] = sum;
}
