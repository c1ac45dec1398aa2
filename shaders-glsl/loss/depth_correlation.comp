#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "depth_region.glsl"

//! The Pearson loss P of every region and its gradient, from the moments of its chunks.
//!
//! P = 1 - mean(a^ b^) with a^ = (a - mean a) / (s_a + 1e-6), s_a^2 the unbiased variance of the rendered depth a, b
//! the estimated depth. One subgroup per region, in a fixed order: the mean of the means, then the sums of products
//! about it. If a or b is constant, P is 1 and its gradient 0. Reference: `src/reference/depth_correlation.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint  width;        // of the view, pixels
    uint  first;        // the plane's first value in render
    uint  view_chunks;  // of region 0
    uint  box_chunks;   // of each other region
    uint  region_count;
    uint  chunk_size;   // pixels, except for the last chunk of a region, which has the rest
    float view_weight;  // of region 0's P
    float box_weight;   // of each other P: weight / number of boxes
};

layout(binding = 0) readonly  buffer Render     { float render[]; };           // (channels, H, W)
layout(binding = 1) readonly  buffer Depth      { float depth[]; };            // (H, W)
layout(binding = 2) readonly  buffer Regions    { uvec4 regions[]; };          // first column and row, width, height
layout(binding = 3) readonly  buffer Moments    { DepthMoments moments[]; };   // one per chunk
layout(binding = 4) writeonly buffer Gradients  { DepthGradient gradients[]; };  // one per region, weighted
layout(binding = 5) writeonly buffer ViewValues { float view_values[]; };      // (1,), P of region 0
layout(binding = 6) writeonly buffer BoxValues  { float box_values[]; };       // P of each other region

const float EPSILON = 1e-6;

void main() {
    uint region_index = WORKGROUP_INDEX;
    if (region_index >= region_count) return;
    bool is_view = region_index == 0;
    uvec4 region = regions[region_index];
    uint pixels = region.z * region.w;
    uint begin = is_view ? 0 : view_chunks + (region_index - 1) * box_chunks;
    uint chunks = is_view ? view_chunks : box_chunks;
    float n = float(pixels);

    vec2 mean = vec2(0);
    for (uint i = gl_LocalInvocationID.x; i < chunks; i += SUBGROUP_SIZE)
        mean += float(min(chunk_size, pixels - i * chunk_size)) * moments[begin + i].mean;
    mean = vec2(subgroupAdd(mean.x), subgroupAdd(mean.y)) / n;
    vec3 products = vec3(0);
    for (uint i = gl_LocalInvocationID.x; i < chunks; i += SUBGROUP_SIZE) {
        vec2 d = moments[begin + i].mean - mean;
        products += moments[begin + i].products
            + float(min(chunk_size, pixels - i * chunk_size)) * vec3(d.x * d.x, d.x * d.y, d.y * d.y);
    }
    products = vec3(subgroupAdd(products.x), subgroupAdd(products.y), subgroupAdd(products.z));

    uint corner = region.y * width + region.x;
    DepthGradient gradient = DepthGradient(mean + vec2(render[first + corner], depth[corner]), 0.0, 0.0);
    float value = 1.0;
    // Written so that a NaN is not constant and reaches the value.
    bool is_constant = products.x == 0.0 || products.z == 0.0;
    if (!is_constant) {
        vec2 deviation = sqrt(products.xz / (n - 1.0));
        vec2 divisor = deviation + EPSILON;
        float correlation = products.y / n / divisor.x / divisor.y;
        float weight = is_view ? view_weight : box_weight;
        value = 1.0 - correlation;
        gradient.a_scale = weight * correlation / divisor.x / ((n - 1.0) * deviation.x);
        gradient.b_scale = -weight / n / divisor.x / divisor.y;
    }
    if (subgroupElect()) {
        gradients[region_index] = gradient;
        if (is_view) view_values[0] = value;
        else box_values[region_index - 1] = value;
    }
}
