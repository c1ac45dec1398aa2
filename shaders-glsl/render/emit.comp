#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "splat.glsl"
#include "shared_slots.glsl"

//! Emit: one lane per depth rank writes the tiles of its Gaussian into the slots reserved for it.
//!
//! Slots are in depth order, so a stable sort by tile leaves every tile's intersections front to back. A Gaussian's
//! slots are contiguous: the backward pass sums over them. The lanes share those of a Gaussian that has many.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant, scalar) uniform Params { uvec2 size; uint gaussian_count; uint tile_columns; };

layout(binding = 0) readonly  buffer Counts  { uint counts[]; };       // [0]: intersections; 0 after an overflow
layout(binding = 1) readonly  buffer Ids     { uint sorted_ids[]; };
layout(binding = 2) readonly  buffer Ordered { uint ordered_counts[]; };
layout(binding = 3) readonly  buffer Sums    { uint sums[]; };         // what precedes each partition of ranks
layout(binding = 4) readonly  buffer Splats  { ProjectedSplat splats[]; };
layout(binding = 5) writeonly buffer Tiles   { uint tiles[]; };        // tile of each slot
layout(binding = 6) writeonly buffer Slots   { uint slots[]; };        // 0, 1, 2, ...
layout(binding = 7) writeonly buffer Owners  { uint owners[]; };       // Gaussian of each slot
layout(binding = 8) writeonly buffer Emitted { uvec2 emitted[]; };     // by Gaussian: first slot, one past the last

const uint NO_TILE = 0xffffffffu;
// What a lane writes of a shared Gaussian in one go.
const uint SLOTS_PER_LANE = 4;

void write_slot(uint slot, uint tile, uint id) {
    tiles[slot] = tile;
    slots[slot] = slot;
    owners[slot] = id;
}

// The first slot of this lane's rank, which has `count` slots.
uint first_slot(uint rank, uint count) {
    uint part = rank / PARTITION_SIZE;
    uint subgroup_begin = rank - gl_SubgroupInvocationID;
    uint before = 0;
    for (uint i = partition_begin(part) + gl_SubgroupInvocationID; i < subgroup_begin; i += SUBGROUP_SIZE) {
        before += ordered_counts[i];
    }
    return sums[part] + subgroupAdd(before) + subgroupExclusiveAdd(count);
}

// The tiles of a splat row by row into slots from `slot` to before `end`; gives one past the last that it took.
uint emit_alone(ProjectedSplat splat, uint id, uint slot, uint end) {
    uvec2 tile_rows = splat_tile_rows(splat, size.y);
    for (uint row = tile_rows.x; row < tile_rows.y; row++) {
        uvec2 columns = splat_tiles(splat, row, size.x);
        for (uint column = columns.x; column < columns.y && slot < end; column++, slot++) {
            write_slot(slot, row * tile_columns + column, id);
        }
    }
    return slot;
}

// The same by all lanes: a row of tiles for each, then a slot for each.
uint emit_together(ProjectedSplat splat, uint id, uint slot, uint end) {
    uvec2 tile_rows = splat_tile_rows(splat, size.y);
    for (uint top = tile_rows.x; top < tile_rows.y; top += SUBGROUP_SIZE) {
        uint row = top + gl_SubgroupInvocationID;
        uvec2 columns = row < tile_rows.y ? splat_tiles(splat, row, size.x) : uvec2(0);
        uint row_end = subgroupInclusiveAdd(columns.y - columns.x);
        // The tile of the row's first slot, less the number of that slot: what a slot's number is to be added to.
        uint row_tile = row * tile_columns + columns.y - row_end;
        uint count = subgroupShuffle(row_end, SUBGROUP_SIZE - 1);
        for (uint first = 0; first < count; first += SLOTS_PER_LANE * SUBGROUP_SIZE) {
            [[unroll]] for (uint k = 0; k < SLOTS_PER_LANE; k++) {
                uint i = first + k * SUBGROUP_SIZE + gl_SubgroupInvocationID;
                // How many rows end at or before slot i.
                uint lane = 0;
                [[unroll]] for (uint bit = 0; bit < 7; bit++) {
                    uint lanes = 64u >> bit;
                    if (lanes < SUBGROUP_SIZE && subgroupShuffle(row_end, lane + lanes - 1) <= i) lane += lanes;
                }
                uint tile = subgroupShuffle(row_tile, lane) + i;
                if (i < count && slot + i < end) write_slot(slot + i, tile, id);
            }
        }
        slot = min(slot + count, end);
    }
    return slot;
}

void main() {
    uint rank = THREAD_INDEX;
    if (rank - gl_SubgroupInvocationID >= gaussian_count) return;
    bool is_rank = rank < gaussian_count;
    uint count = is_rank ? ordered_counts[rank] : 0;
    uint begin = first_slot(rank, count);
    // No slot beyond those that were counted is ever written, not even where the sum of all counts wrapped around.
    uint end = begin + count;
    if (end > counts[0] || end < begin) end = begin;
    uint id = is_rank ? sorted_ids[rank] : 0;
    ProjectedSplat splat = splats[id];
    bool is_shared = end - begin > SHARED_SLOTS;

    uint slot = begin;
    if (end > begin && !is_shared) slot = emit_alone(splat, id, begin, end);
    uvec4 sharing = subgroupBallot(is_shared);
    while (any(notEqual(sharing, uvec4(0)))) {
        uint lane = subgroupBallotFindLSB(sharing);
        sharing[lane / 32] &= sharing[lane / 32] - 1;
        ProjectedSplat shared_splat;
        shared_splat.mean2d = subgroupShuffle(splat.mean2d, lane);
        shared_splat.conic = subgroupShuffle(splat.conic, lane);
        shared_splat.opacity = subgroupShuffle(splat.opacity, lane);
        shared_splat.half_extent = subgroupShuffle(splat.half_extent, lane);
        uint last = emit_together(
            shared_splat, subgroupShuffle(id, lane), subgroupShuffle(begin, lane), subgroupShuffle(end, lane));
        if (gl_SubgroupInvocationID == lane) slot = last;
    }
    if (is_rank) emitted[id] = uvec2(begin, slot);
    // Counting and emitting share one function; should a compiler still make them disagree, nothing is left unwritten.
    for (; slot < end; slot++) write_slot(slot, NO_TILE, id);
}
