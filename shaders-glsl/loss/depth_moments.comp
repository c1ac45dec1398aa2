#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "depth_region.glsl"

//! The first and second moments of both depths, rendered a and estimated b, over chunks of every region.
//!
//! A workgroup is one subgroup and processes one chunk: the means, then the sums of products about them, to avoid
//! cancellation. Depths are relative to the region's first pixel, so that the variance of a constant is exactly 0.
//! Reference: `src/reference/depth_moments.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint VALUES_PER_THREAD = 16;  // a chunk is a subgroup times as many pixels

layout(push_constant) uniform Params {
    uint width;         // of the view, pixels
    uint first;         // the plane's first value in render
    uint view_chunks;   // of region 0
    uint box_chunks;    // of each other region
    uint chunk_count;   // of all regions
    uint chunk_size;    // pixels, except for the last chunk of a region, which has the rest
};

layout(binding = 0) readonly  buffer Render  { float render[]; };        // (channels, H, W)
layout(binding = 1) readonly  buffer Depth   { float depth[]; };         // (H, W)
layout(binding = 2) readonly  buffer Regions { uvec4 regions[]; };       // first column and row, width, height
layout(binding = 3) writeonly buffer Moments { DepthMoments moments[]; };  // one per chunk

void main() {
    uint chunk = WORKGROUP_INDEX;
    if (chunk >= chunk_count) return;
    uint region_index = 0;
    if (chunk >= view_chunks) {
        region_index = 1 + (chunk - view_chunks) / box_chunks;
        chunk = (chunk - view_chunks) % box_chunks;
    }
    uvec4 region = regions[region_index];
    uint corner = region.y * width + region.x;
    vec2 pivot = vec2(render[first + corner], depth[corner]);
    uint count = min(chunk_size, region.z * region.w - chunk * chunk_size);

    vec2 values[VALUES_PER_THREAD];
    vec2 sum = vec2(0);
    [[unroll]] for (uint k = 0; k < VALUES_PER_THREAD; ++k) {
        uint in_chunk = k * SUBGROUP_SIZE + gl_LocalInvocationID.x;
        uint in_region = chunk * chunk_size + min(in_chunk, count - 1);
        uint row = in_region / region.z;
        uint at = corner + row * width + (in_region - row * region.z);
        values[k] = vec2(render[first + at], depth[at]) - pivot;
        sum += in_chunk < count ? values[k] : vec2(0);
    }
    vec2 mean = vec2(subgroupAdd(sum.x), subgroupAdd(sum.y)) / float(count);
    vec3 products = vec3(0);
    [[unroll]] for (uint k = 0; k < VALUES_PER_THREAD; ++k) {
        vec2 d = k * SUBGROUP_SIZE + gl_LocalInvocationID.x < count ? values[k] - mean : vec2(0);
        products += vec3(d.x * d.x, d.x * d.y, d.y * d.y);
    }
    products = vec3(subgroupAdd(products.x), subgroupAdd(products.y), subgroupAdd(products.z));
    if (subgroupElect()) moments[WORKGROUP_INDEX] = DepthMoments(mean, products);
}
