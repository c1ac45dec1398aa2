#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The structure target: the normalised logarithm of the invariant, clamped to [0, 1].
//!
//! One thread per pixel. Reference: `src/reference/ciconv_normalize.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint pixel_count;
};

layout(binding = 0) readonly  buffer Logs      { float logs[]; };       // (H, W), ln(W + 1e-5)
layout(binding = 1) readonly  buffer Norm      { vec2 norm[]; };        // (1,), mean and 1 / standard deviation
layout(binding = 2) writeonly buffer Structure { float structure[]; };  // (H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= pixel_count) return;
    structure[i] = clamp((logs[i] - norm[0].x) * norm[0].y, 0.0, 1.0);
}
