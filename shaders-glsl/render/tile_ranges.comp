#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Tile ranges: one thread per sorted intersection finds where each tile's run begins and ends.
//!
//! `tile_ranges` must be zero before: a tile without intersections keeps the empty range (0, 0).
//! Intersections whose tile is `tile_count` or beyond are padding and belong to no tile.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params { uint tile_count; };

layout(binding = 0) readonly buffer Counts { uint counts[]; };  // [0]: intersections
layout(binding = 1) readonly buffer Tiles  { uint sorted_tiles[]; };
layout(binding = 2) buffer Ranges          { uvec2 tile_ranges[]; };  // (tiles) first, one past the last

void main() {
    uint i = THREAD_INDEX;
    uint count = counts[0];
    if (i >= count) return;
    uint tile = sorted_tiles[i];
    if (tile >= tile_count) return;
    if (i == 0 || sorted_tiles[i - 1] != tile) tile_ranges[tile].x = i;
    if (i + 1 == count || sorted_tiles[i + 1] != tile) tile_ranges[tile].y = i + 1;
}
