#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Tile begins: where the intersections of each tile begin once they are sorted by tile, and after the last tile their
//! number.
//!
//! One workgroup: each thread sums the sizes of consecutive tiles, and the sums become prefix sums. The sizes are
//! cleared for the next render.

layout(constant_id = 0) const uint SUBGROUPS = 1;
layout(local_size_x_id = 100, local_size_y_id = 0) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant) uniform Params { uint tile_count; };

layout(binding = 0)           buffer Sizes  { uint tile_sizes[]; };   // (tiles), zeros afterwards
layout(binding = 1) writeonly buffer Begins { uint tile_begins[]; };  // (tiles + 1)

shared uint sums_of_subgroups[SUBGROUPS];

const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;

void main() {
    uint thread = gl_LocalInvocationID.y * SUBGROUP_SIZE + gl_LocalInvocationID.x;
    uint share = (tile_count + THREADS - 1) / THREADS;
    uint first = min(thread * share, tile_count), end = min(first + share, tile_count);
    uint sum = 0;
    for (uint tile = first; tile < end; ++tile) sum += tile_sizes[tile];
    uint to_here = subgroup_inclusive_sum(sum);
    if (gl_LocalInvocationID.x == SUBGROUP_SIZE - 1) sums_of_subgroups[gl_LocalInvocationID.y] = to_here;
    barrier();
    uint begin = to_here - sum;
    for (uint k = 0; k < gl_LocalInvocationID.y; ++k) begin += sums_of_subgroups[k];
    for (uint tile = first; tile < end; ++tile) {
        tile_begins[tile] = begin;
        begin += tile_sizes[tile];
        tile_sizes[tile] = 0;
    }
    if (thread == THREADS - 1) tile_begins[tile_count] = begin;
}
