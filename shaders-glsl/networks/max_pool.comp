#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Max pooling: the largest of each square window, without padding, one thread per value.
//!
//! Reference: `src/reference/max_pool.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uvec2 size;         // pixels: the input
    uvec2 target_size;  // pixels: the output
    uint  channels;
    uint  window;       // pixels to a side
    uint  stride;       // pixels
};

layout(binding = 0) readonly  buffer Source { float source[]; };  // (channels, H, W)
layout(binding = 1) writeonly buffer Target { float target[]; };  // (channels, h, w)

void main() {
    uint i = THREAD_INDEX;
    uint pixels = target_size.x * target_size.y;
    if (i >= channels * pixels) return;
    uvec2 corner = stride * uvec2(i % pixels % target_size.x, i % pixels / target_size.x);
    uint first = (i / pixels * size.y + corner.y) * size.x + corner.x;
    float largest = source[first];
    for (uint t = 1; t < window * window; ++t) {
        largest = max(largest, source[first + t / window * size.x + t % window]);
    }
    target[i] = largest;
}
