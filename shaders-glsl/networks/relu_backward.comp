#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Zeroes the gradient where the output of a ReLU is zero.
//!
//! Reference: `src/reference/relu_backward.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;
};

layout(binding = 0) readonly buffer Activations { float activations[]; };  // outputs of the ReLU
layout(binding = 1)          buffer Gradient    { float gradient[]; };     // of the ReLU's output, then of its input

void main() {
    uint i = THREAD_INDEX;
    if (i < value_count) gradient[i] = activations[i] > 0.0 ? gradient[i] : 0.0;
}
