#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "no_tile.glsl"

//! Place pairs: the depth and the slot of every intersection go to the place of its tile that emit gave it. The order
//! within a tile is that in which the intersections arrived there.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params { uint capacity; };  // intersections

layout(binding = 0) readonly  buffer Counts      { uint counts[]; };        // [0]: intersections
layout(binding = 1) readonly  buffer Tiles       { uint tiles[]; };         // of each slot
layout(binding = 2) readonly  buffer Ranks       { uint ranks[]; };         // of each slot within its tile
layout(binding = 3) readonly  buffer GaussianIds { uint gaussian_ids[]; };  // of each slot
layout(binding = 4) readonly  buffer DepthKeys   { uint depth_keys[]; };    // of each Gaussian
layout(binding = 5) readonly  buffer Begins      { uint tile_begins[]; };
layout(binding = 6) writeonly buffer Pairs       { uvec2 pairs[]; };        // depth key and slot, by tile

void main() {
    uint slot = THREAD_INDEX;
    if (slot >= min(counts[0], capacity)) return;
    uint tile = tiles[slot];
    if (tile == NO_TILE) return;
    pairs[tile_begins[tile] + ranks[slot]] = uvec2(depth_keys[gaussian_ids[slot]], slot);
}
