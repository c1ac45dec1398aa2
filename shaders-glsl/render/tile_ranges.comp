#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "status.glsl"

//! Tile ranges: one thread per tile finds where its run of the sorted intersections begins and ends.
//!
//! Intersections whose tile is `tile_count` or beyond are padding and belong to no tile. A run longer than what the
//! blending kernels follow raises a flag that stays, and its tile shows nothing.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint tile_count;
    uint longest_run;  // that the blending kernels follow
};

layout(binding = 0) readonly  buffer Counts { uint counts[]; };  // [0]: intersections
layout(binding = 1) readonly  buffer Tiles  { uint sorted_tiles[]; };
layout(binding = 2) writeonly buffer Ranges { uvec2 tile_ranges[]; };  // (tiles) first, one past the last
layout(binding = 3)           buffer Status { uint status[]; };

// How many intersections lie in tiles before `tile`: a binary search.
uint intersections_before(uint tile) {
    uint begin = 0;
    uint end = counts[0];
    while (begin < end) {
        uint middle = begin + (end - begin) / 2;
        if (sorted_tiles[middle] < tile) begin = middle + 1;
        else end = middle;
    }
    return begin;
}

void main() {
    uint tile = THREAD_INDEX;
    if (tile >= tile_count) return;
    uvec2 range = uvec2(intersections_before(tile), intersections_before(tile + 1));
    uint run = range.y - range.x;
    if (run > longest_run) {
        atomicOr(status[0], STATUS_CROWDED);
        atomicMax(status[2], run);
        range.y = range.x;
    }
    tile_ranges[tile] = range;
}
