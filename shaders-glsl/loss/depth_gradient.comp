#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "depth_region.glsl"

//! The gradient of the depth loss with respect to one plane of the render: the sum over the regions that contain a
//! pixel.
//!
//! One thread per pixel. Reference: `src/reference/depth_gradient.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uvec2 size;          // of the view, pixels
    uint  first;         // the plane's first value in render and d_render
    uint  region_count;
};

layout(binding = 0) readonly  buffer Render    { float render[]; };             // (channels, H, W)
layout(binding = 1) readonly  buffer Depth     { float depth[]; };              // (H, W)
layout(binding = 2) readonly  buffer Regions   { uvec4 regions[]; };            // first column and row, width, height
layout(binding = 3) readonly  buffer Gradients { DepthGradient gradients[]; };  // one per region
layout(binding = 4) writeonly buffer DRender   { float d_render[]; };           // (channels, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= size.x * size.y) return;
    uvec2 pixel = uvec2(i % size.x, i / size.x);
    vec2 depths = vec2(render[first + i], depth[i]);
    float d = 0.0;
    for (uint k = 0; k < region_count; ++k) {
        uvec4 region = regions[k];
        DepthGradient gradient = gradients[k];
        vec2 deviation = depths - gradient.mean;
        // Unsigned: a pixel before the region wraps beyond it.
        if (all(lessThan(pixel - region.xy, region.zw)))
            d += gradient.a_scale * deviation.x + gradient.b_scale * deviation.y;
    }
    d_render[first + i] = d;
}
