#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "no_tile.glsl"
#include "splat.glsl"
#include "shared_intersections.glsl"

//! Emit: one lane per rank writes the tiles of its Gaussian into the slots reserved for it.
//!
//! Where ranks and so slots are in the order of depth, a stable sort by tile leaves every tile's intersections front to
//! back. Where each tile is sorted by itself, ranks are in the order of the Gaussians, and every slot gets a place in
//! its tile in the order of arrival. A Gaussian's slots are contiguous: the backward pass sums over them. The lanes
//! share those of a Gaussian that has many.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant, scalar) uniform Params { uvec2 size; uint gaussian_count; uint tile_columns; };

layout(binding = 0) readonly  buffer Counts  { uint counts[]; };       // [0]: intersections; 0 after an overflow
layout(binding = 1) readonly  buffer Ids     { uint sorted_ids[]; };
layout(binding = 2) readonly  buffer Before  { uint intersection_offsets[]; };  // by rank, within its partition
layout(binding = 3) readonly  buffer Sums    { uint sums[]; };          // what precedes each partition of ranks
layout(binding = 4) readonly  buffer Splats  { ProjectedSplat splats[]; };
layout(binding = 5) writeonly buffer Tiles   { uint tiles[]; };        // tile of each slot
layout(binding = 6) writeonly buffer IntersectionIds   { uint intersection_ids[]; };  // the slot, or its place
layout(binding = 7) writeonly buffer GaussianIds  { uint gaussian_ids[]; };       // of each intersection
// first intersection of each Gaussian, one past the last
layout(binding = 8) writeonly buffer IntersectionRanges { uvec2 intersection_ranges[]; };
layout(binding = 9) readonly  buffer TileCounts { uint tile_counts[]; };  // by Gaussian
layout(binding = 10)          buffer TileSizes  { uint tile_sizes[]; };   // intersections of each tile, zeros before

layout(constant_id = 5) const bool SORTS_TILES = false;  // each tile is sorted by itself

// The tiles of a row that a lane writes in one turn.
const uint TILES_PER_TURN = 2;

void write_slot(uint slot, uint tile, uint id) {
    tiles[slot] = tile;
    bool is_placed = SORTS_TILES && tile != NO_TILE;
    intersection_ids[slot] = is_placed ? atomicAdd(tile_sizes[tile], 1) : slot;
    gaussian_ids[slot] = id;
}

// The tiles of a row into slots from `slot` to before `end`.
void emit_row(uint tile, uint slot, uint end, uint id) {
    for (; slot < end; slot += TILES_PER_TURN, tile += TILES_PER_TURN) {
        [[unroll]] for (uint k = 0; k < TILES_PER_TURN; k++) if (slot + k < end) write_slot(slot + k, tile + k, id);
    }
}

void main() {
    uint rank = THREAD_INDEX;
    uint lane = gl_SubgroupInvocationID;
    if (rank - lane >= gaussian_count) return;
    bool is_rank = rank < gaussian_count;
    uint id = is_rank ? sorted_ids[rank] : 0;
    uint begin = is_rank ? sums[rank / PARTITION_SIZE] + intersection_offsets[rank] : 0;
    // No slot beyond those that were counted is ever written, not even where the sum of all counts wrapped around.
    uint end = begin + (is_rank ? tile_counts[id] : 0);
    bool is_whole = end <= counts[0] && end >= begin;
    // The Gaussian across the end of the memory covers no tile: its slots before the end are padding.
    if (!is_whole) end = max(begin, counts[0]);
    ProjectedSplat splat = splats[id];
    uvec2 rows = is_whole && end > begin ? splat_tile_rows(splat, size.y) : uvec2(0);
    bool is_shared = is_whole && end - begin > SHARED_INTERSECTIONS;
    uvec4 sharing = subgroupBallot(is_shared);

    // First every lane its own splat, then all together those that are shared, a row for each: in one loop, for a
    // device that does not jump over branches pays for a second one even where nothing is shared.
    ProjectedSplat walked = splat;
    uint walked_id = id, slot = begin, walked_end = end, walked_rows = rows.y;
    uint row = is_shared ? rows.y : rows.x;
    uint owner = lane, last = begin, stride = 1;
    while (true) {
        while (subgroupAny(row < walked_rows)) {
            uvec2 columns = row < walked_rows ? splat_tiles(walked, row, size.x) : uvec2(0);
            uint count = columns.y - columns.x;
            uint count_to_here = subgroup_inclusive_sum(count);
            bool is_alone = stride == 1;
            uint first = is_alone ? slot : slot + count_to_here - count;
            emit_row(row * tile_columns + columns.x, first, min(first + count, walked_end), walked_id);
            slot += is_alone ? count : subgroupShuffle(count_to_here, SUBGROUP_SIZE - 1);
            slot = min(slot, walked_end);
            row += stride;
        }
        if (owner == lane) last = slot;
        if (all(equal(sharing, uvec4(0)))) break;
        owner = subgroupBallotFindLSB(sharing);
        sharing[owner / 32] &= sharing[owner / 32] - 1;
        stride = SUBGROUP_SIZE;
        walked.mean2d = subgroupShuffle(splat.mean2d, owner);
        walked.conic = subgroupShuffle(splat.conic, owner);
        walked.opacity = subgroupShuffle(splat.opacity, owner);
        walked.half_extent = subgroupShuffle(splat.half_extent, owner);
        walked_id = subgroupShuffle(id, owner);
        slot = subgroupShuffle(begin, owner);
        walked_end = subgroupShuffle(end, owner);
        row = subgroupShuffle(rows.x, owner) + lane;
        walked_rows = subgroupShuffle(rows.y, owner);
    }
    if (is_rank) intersection_ranges[id] = uvec2(begin, last);
    // Counting and emitting share one function; should a compiler still make them disagree, nothing is left unwritten.
    for (; last < end; last++) write_slot(last, NO_TILE, id);
}
