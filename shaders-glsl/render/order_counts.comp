#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Order counts: one thread per depth rank fetches how many tiles its Gaussian covers.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params { uint gaussian_count; };

layout(binding = 0) readonly  buffer Ids        { uint sorted_ids[]; };   // by depth
layout(binding = 1) readonly  buffer TileCounts { uint tile_counts[]; };  // by Gaussian
layout(binding = 2) writeonly buffer Ordered    { uint ordered_counts[]; };

void main() {
    uint rank = THREAD_INDEX;
    if (rank < gaussian_count) ordered_counts[rank] = tile_counts[sorted_ids[rank]];
}
