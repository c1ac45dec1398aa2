#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "splat.glsl"

//! Emit: one thread per depth rank writes the tiles of its Gaussian into the slots reserved for it.
//!
//! Slots are in depth order, so a stable sort by tile leaves every tile's intersections front to back. A Gaussian's
//! slots are contiguous: the backward pass sums over them.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params { uvec2 size; uint gaussian_count; uint tile_columns; };

layout(binding = 0) readonly  buffer Counts  { uint counts[]; };       // [0]: intersections; 0 after an overflow
layout(binding = 1) readonly  buffer Ids     { uint sorted_ids[]; };
layout(binding = 2) readonly  buffer Ordered { uint ordered_counts[]; };
layout(binding = 3) readonly  buffer Offsets { uint offsets[]; };      // first slot of each rank
layout(binding = 4) readonly  buffer Splats  { ProjectedSplat splats[]; };
layout(binding = 5) writeonly buffer Tiles   { uint tiles[]; };        // tile of each slot
layout(binding = 6) writeonly buffer Slots   { uint slots[]; };        // 0, 1, 2, ...
layout(binding = 7) writeonly buffer Owners  { uint owners[]; };       // Gaussian of each slot

const uint NO_TILE = 0xffffffffu;

void main() {
    uint rank = THREAD_INDEX;
    if (rank >= gaussian_count) return;
    // No slot beyond those that were counted is ever written, not even where the sum of all counts wrapped around.
    uint end = offsets[rank] + ordered_counts[rank];
    if (end == offsets[rank] || end > counts[0]) return;
    uint id = sorted_ids[rank];
    ProjectedSplat splat = splats[id];
    uint slot = offsets[rank];
    uvec2 tile_rows = splat_tile_rows(splat, size.y);
    for (uint row = tile_rows.x; row < tile_rows.y; row++) {
        uvec2 columns = splat_tiles(splat, row, size.x);
        for (uint column = columns.x; column < columns.y && slot < end; column++, slot++) {
            tiles[slot] = row * tile_columns + column;
            slots[slot] = slot;
            owners[slot] = id;
        }
    }
    // Counting and emitting share one function; should a compiler still make them disagree, nothing is left unwritten.
    for (; slot < end; slot++) {
        tiles[slot] = NO_TILE;
        slots[slot] = slot;
        owners[slot] = id;
    }
}
