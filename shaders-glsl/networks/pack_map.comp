#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "packed.glsl"

//! A feature map as the second factor of 16-bit matrices: packed(p + 1)[c] = scale source[c](p), zeros around and
//! beyond.
//!
//! A thread writes PACKED_CHANNELS channels of a packed pixel; neighbouring threads read neighbouring pixels. The
//! rounding error is at most 2^-10, and values below 2^-28 of the map's bound may become 0, since their halves are
//! subnormal, which some devices flush; below 2^-39 they do. Reference: `src/reference/pack_map.rs`.

layout(local_size_x = 256) in;

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  channels;
};

layout(binding = 0) readonly  buffer Bound   { uint bound[]; };     // of the map
layout(binding = 1) readonly  buffer Source  { float source[]; };   // (C, H, W)
layout(binding = 2) writeonly buffer Packed  { uvec4 packed[]; };   // (rows, columns, channels), eight halves each

void main() {
    uvec2 extent = packed_size(size);
    uint pixels = extent.x * extent.y, blocks = packed_channels(channels) / PACKED_CHANNELS;
    uint pixel = THREAD_INDEX % pixels, block = THREAD_INDEX / pixels;
    if (block >= blocks) return;
    // In the border around the map, also left of it and above, these are beyond the map.
    uvec2 at = uvec2(pixel % extent.x, pixel / extent.x) - 1;
    bool is_inside = at.x < size.x && at.y < size.y;
    uint plane = size.x * size.y, from = is_inside ? at.y * size.x + at.x : 0;
    float scale = packed_scale(packed_exponent(bound[0]));
    uint first = block * PACKED_CHANNELS;
    [[unroll]] for (uint eight = 0; eight < PACKED_CHANNELS / 8; ++eight) {
        float values[8];
        [[unroll]] for (uint c = 0; c < 8; ++c) {
            uint channel = first + 8 * eight + c;
            values[c] = is_inside && channel < channels ? source[channel * plane + from] : 0.0;
        }
        packed[(pixel * blocks + block) * (PACKED_CHANNELS / 8) + eight] = packed_eight(values, scale);
    }
}
