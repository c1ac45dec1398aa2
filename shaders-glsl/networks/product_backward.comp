#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The gradient of `product`.
//!
//! Reference: `src/reference/product_backward.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;  // 3HW
};

layout(binding = 0) readonly  buffer Illumination  { float illumination[]; };    // (3, H, W)
layout(binding = 1) readonly  buffer Denoised      { float denoised[]; };        // (3, H, W)
layout(binding = 2) readonly  buffer DTarget       { float d_target[]; };        // (3, H, W)
layout(binding = 3) writeonly buffer DIllumination { float d_illumination[]; };  // (3, H, W)
layout(binding = 4)           buffer DDenoised     { float d_denoised[]; };      // added to, (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= value_count) return;
    d_illumination[i] = d_target[i] * denoised[i];
    d_denoised[i] += d_target[i] * illumination[i];
}
