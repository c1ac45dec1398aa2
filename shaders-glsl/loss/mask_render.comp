#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Mask: the image for the loss, w a + (1 - w) b with the weights w of the pixels, a the render and b the pseudo-GT,
//! one thread per value.
//!
//! A masked pixel equals its target. `mask_gradient` is the backward pass. Reference: `src/reference/mask_render.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;  // 3HW
    uint pixel_count;  // HW
};

layout(binding = 0) readonly  buffer Weights { float weights[]; };  // (H, W), within 0 and 1
layout(binding = 1) readonly  buffer Render  { float render[]; };   // (3, H, W) and more, not clamped
layout(binding = 2) readonly  buffer Target  { float target[]; };   // (3, H, W)
layout(binding = 3) writeonly buffer Shown   { float shown[]; };    // (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= value_count) return;
    float weight = weights[i % pixel_count];
    float a = render[i];
    // Pixels of full weight keep their bits.
    shown[i] = weight < 1.0 ? weight * a + (1.0 - weight) * target[i] : a;
}
