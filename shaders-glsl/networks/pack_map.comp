#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "packed.glsl"

//! A feature map as the second factor of 16-bit matrices: packed(p + 1)[c] = scale source[c](p), zeros around and
//! beyond.
//!
//! A thread writes PACKED_CHANNELS channels of a packed pixel; neighbouring threads read neighbouring pixels. The
//! rounding error is at most 2^-10, and values below 2^-28 of the map's largest magnitude may become 0, since their
//! halves are subnormal, which some devices flush; below 2^-39 they do. Reference: `src/reference/pack_map.rs`.

layout(local_size_x = 256) in;

layout(push_constant, scalar) uniform Params {
    uvec2 size;  // pixels
    uint  channels;
};

layout(binding = 0) readonly  buffer Largest { uint largest[]; };   // of the map's magnitudes, one
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
    float scale = packed_scale(packed_exponent(largest[0]));
    uint first = block * PACKED_CHANNELS;
    [[unroll]] for (uint eight = 0; eight < PACKED_CHANNELS / 8; ++eight) {
        uvec4 words;
        [[unroll]] for (uint w = 0; w < 4; ++w) {
            vec2 pair = vec2(0.0);
            [[unroll]] for (uint half_of = 0; half_of < 2; ++half_of) {
                uint channel = first + 8 * eight + 2 * w + half_of;
                if (is_inside && channel < channels) pair[half_of] = scale * source[channel * plane + from];
            }
            words[w] = packHalf2x16(pair);
        }
        packed[(pixel * blocks + block) * (PACKED_CHANNELS / 8) + eight] = words;
    }
}
