#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Crop scatter: adds planes to a rectangle of some planes of an image, one thread per value; `crop_gather` backward.
//!
//! Reference: `src/reference/crop_scatter.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uvec2 size;         // pixels: the image
    uvec2 origin;       // pixels: the crop's corner
    uvec2 crop;       // pixels: its size
    uint  first_plane;  // of the image
    uint  plane_count;
};

layout(binding = 0) readonly buffer Content { float content[]; };  // (plane_count, h, w)
layout(binding = 1)          buffer Image   { float image[]; };    // (planes, H, W)

void main() {
    uint i = THREAD_INDEX;
    uint pixels = crop.x * crop.y;
    if (i >= plane_count * pixels) return;
    uint plane = first_plane + i / pixels;
    uvec2 pixel = origin + uvec2(i % pixels % crop.x, i % pixels / crop.x);
    image[(plane * size.y + pixel.y) * size.x + pixel.x] += content[i];
}
