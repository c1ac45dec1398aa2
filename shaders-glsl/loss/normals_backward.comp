#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "map_normal.glsl"

//! The gradient of the normals' loss with respect to the mean depth, over alpha as `blend_backward` takes it.
//!
//! A point is the right end of the difference u of the pixel left of it, the left end of that of the pixel right of it,
//! and so for v above and below. One thread per pixel. Reference: `src/reference/normals_backward.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uvec2 size;             // pixels
    vec2  focal;            // pixels
    vec2  principal_point;  // pixels
    uint  first;            // the first value of the depth in d_render
    float scale;            // weight / number of normals of the map
};

layout(binding = 0) readonly  buffer Transmittances { float transmittances[]; };  // (H, W)
layout(binding = 1) readonly  buffer DDifferences   { vec4 d_differences[]; };    // (H, W, 2) of u and v
layout(binding = 2) writeonly buffer DRender        { float d_render[]; };        // (channels, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= size.x * size.y) return;
    uvec2 p = uvec2(i % size.x, i / size.x);
    vec3 d = vec3(0.0);
    if (p.x > 0) d += d_differences[2 * (i - 1)].xyz;
    if (p.x + 1 < size.x) d -= d_differences[2 * (i + 1)].xyz;
    if (p.y > 0) d += d_differences[2 * (i - size.x) + 1].xyz;
    if (p.y + 1 < size.y) d -= d_differences[2 * (i + size.x) + 1].xyz;
    float d_depth = scale * dot(pixel_ray(p, focal, principal_point), d);
    // A gradient is that of an opaque pixel.
    d_render[first + i] = d_depth == 0.0 ? 0.0 : d_depth / (1.0 - transmittances[i]);
}
