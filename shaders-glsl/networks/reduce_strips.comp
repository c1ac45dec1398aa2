#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Adds the partial sums of all strips to the gradient of a layer: one thread per parameter, in a fixed order.
//!
//! A layer that is used more than once is reduced once per use. Reference: `src/reference/reduce_strips.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint parameter_count;
    uint strip_count;
    uint offset;  // of the layer in `gradients`
};

layout(binding = 0) readonly buffer Partials  { float partials[]; };  // (strips, parameters)
layout(binding = 1)          buffer Gradients { float gradients[]; };

void main() {
    uint i = THREAD_INDEX;
    if (i >= parameter_count) return;
    float sum = 0.0;
    for (uint strip = 0; strip < strip_count; ++strip) sum += partials[strip * parameter_count + i];
    gradients[offset + i] += sum;
}
