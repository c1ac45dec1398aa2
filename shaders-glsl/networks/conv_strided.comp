#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"

//! A convolution with a square window of any size, a stride and zero padding, followed by a ReLU.
//!
//! output[o](p) = max(0, bias[o] + sum over i and t of weight[o, i, t] input[i](stride p + t - padding)), t in [0,
//! window)^2. A thread owns a pixel of OUT_BLOCK output channels, so that it loads each input once for all of them.
//! Reference: `src/reference/conv_strided.rs`.

layout(local_size_x = 64) in;
layout(constant_id = 0) const uint OUT_BLOCK = 8;

layout(push_constant) uniform Params {
    uvec2 size;          // pixels: the input
    uvec2 target_size;   // pixels: the output
    uint  in_channels;
    uint  out_channels;
    uint  window;        // taps to a side
    uint  stride;        // pixels
    uint  padding;       // pixels of zero around the input
    uint  offset;        // of the layer in `values`: weights (out, in, window, window), then biases (out)
};

layout(binding = 0) readonly  buffer Values { float values[]; };
layout(binding = 1) readonly  buffer Source { float source[]; };  // (in, H, W)
layout(binding = 2) writeonly buffer Target { float target[]; };  // (out, h, w)

void main() {
    uint pixels = target_size.x * target_size.y;
    uint i = THREAD_INDEX;
    uint first_channel = i / pixels * OUT_BLOCK;
    if (first_channel >= out_channels) return;
    uvec2 pixel = uvec2(i % pixels % target_size.x, i % pixels / target_size.x);
    uint taps = window * window;
    uint biases = offset + out_channels * in_channels * taps;

    float sum[OUT_BLOCK];
    uint layer[OUT_BLOCK];
    [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
        uint channel = min(first_channel + o, out_channels - 1);
        sum[o] = values[biases + channel];
        layer[o] = offset + channel * in_channels * taps;
    }
    for (uint c = 0; c < in_channels; ++c) {
        for (uint t = 0; t < taps; ++t) {
            // Left of and above the image, the unsigned position is large.
            uvec2 at = stride * pixel + uvec2(t % window, t / window) - padding;
            bool is_inside = all(lessThan(at, size));
            uvec2 held = min(at, size - 1);
            float value = source[(c * size.y + held.y) * size.x + held.x];
            value = is_inside ? value : 0.0;
            [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) sum[o] += values[layer[o] + c * taps + t] * value;
        }
    }
    [[unroll]] for (uint o = 0; o < OUT_BLOCK; ++o) {
        if (first_channel + o < out_channels)
            target[first_channel * pixels + o * pixels + i % pixels] = not_below_zero(sum[o]);
    }
}
