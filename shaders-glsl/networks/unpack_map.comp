#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "packed.glsl"

//! The inverse of `pack_map`: target[c](p) = packed(p + 1)[c] / scale.
//!
//! A thread reads PACKED_CHANNELS channels of a pixel; neighbouring threads write neighbouring pixels. Reference:
//! `src/reference/unpack_map.rs`.

layout(local_size_x = 256) in;

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  channels;
};

layout(binding = 0) readonly  buffer Bound  { uint bound[]; };
layout(binding = 1) readonly  buffer Packed { uvec4 packed[]; };  // (rows, columns, channels), eight halves each
layout(binding = 2) writeonly buffer Target { float target[]; };  // (C, H, W)

void main() {
    uint plane = size.x * size.y;
    uint pixel = THREAD_INDEX % plane, block = THREAD_INDEX / plane;
    if (block >= packed_channels(channels) / PACKED_CHANNELS) return;
    uint from = packed_index(size, channels, uvec2(pixel % size.x, pixel / size.x));
    float inverse = packed_inverse(packed_exponent(bound[0]));
    [[unroll]] for (uint eight = 0; eight < PACKED_CHANNELS / 8; ++eight) {
        uint first = block * PACKED_CHANNELS + 8 * eight;
        float values[8] = unpacked_eight(packed[from + first / 8], inverse);
        [[unroll]] for (uint c = 0; c < 8; ++c)
            if (first + c < channels) target[(first + c) * plane + pixel] = values[c];
    }
}
