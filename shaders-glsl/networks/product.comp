#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The input of the tonemapper: illumination times denoised image, one thread per value.
//!
//! Reference: `src/reference/product.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;  // 3HW
};

layout(binding = 0) readonly  buffer Illumination { float illumination[]; };  // (3, H, W)
layout(binding = 1) readonly  buffer Denoised     { float denoised[]; };      // (3, H, W)
layout(binding = 2) writeonly buffer Target       { float target[]; };        // (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i < value_count) target[i] = illumination[i] * denoised[i];
}
