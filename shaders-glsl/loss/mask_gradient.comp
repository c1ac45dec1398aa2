#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The gradient of `mask_render`: dL/da = w dL/d shown, in every channel of the render, one thread per value.
//!
//! Reference: `src/reference/mask_gradient.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;  // all channels
    uint pixel_count;  // HW
};

layout(binding = 0) readonly buffer Weights { float weights[]; };   // (H, W), within 0 and 1
layout(binding = 1)          buffer DRender { float d_render[]; };  // (channels, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= value_count) return;
    d_render[i] *= weights[i % pixel_count];
}
