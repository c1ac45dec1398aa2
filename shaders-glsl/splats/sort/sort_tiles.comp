#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_memory_scope_semantics : require
#include "kernel.glsl"
#include "no_tile.glsl"

//! Sort tiles: the intersections of each tile by depth, those of equal depth by slot. A workgroup sorts a tile.
//!
//! A pair (depth key, slot) is unique, so the result does not depend on the order of arrival. The network is Batcher's
//! bitonic one with ascending exchanges alone: what would lie beyond the last pair counts as larger than any, and never
//! moves, so any number of pairs is sorted in place. Pairs are in shared memory, CAPACITY at a time; exchanges that
//! reach farther, of tiles with more, are in memory.
//!
//! The workgroup after the last tile fills what belongs to no tile.

layout(constant_id = 0) const uint SUBGROUPS = 1;
layout(constant_id = 1) const uint CAPACITY = 2048;  // pairs, a power of two
layout(local_size_x_id = 100, local_size_y_id = 0) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params { uint tile_count; };

layout(binding = 0) readonly  buffer Counts { uint counts[]; };          // [0]: intersections
layout(binding = 1) readonly  buffer Begins { uint tile_begins[]; };     // (tiles + 1)
layout(binding = 2) coherent  buffer Pairs  { uvec2 pairs[]; };          // depth key and slot, by tile
layout(binding = 3) writeonly buffer Tiles  { uint sorted_tiles[]; };
layout(binding = 4) writeonly buffer IntersectionIds { uint sorted_intersections[]; };  // slots

shared uvec2 held[CAPACITY];

const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;

uint thread() { return gl_LocalInvocationID.y * SUBGROUP_SIZE + gl_LocalInvocationID.x; }

// Orders the accesses to shared memory of two steps whose exchanges reach at most `reach`: up to the lanes of a
// subgroup, each subgroup exchanges pairs of its own.
void sync_held(uint reach) {
    if (reach > SUBGROUP_SIZE) barrier();
    else controlBarrier(gl_ScopeSubgroup, gl_ScopeSubgroup, gl_StorageSemanticsShared, gl_SemanticsAcquireRelease);
}

void sync_pairs() {
    memoryBarrierBuffer();
    barrier();
}

bool are_swapped(uvec2 low, uvec2 high) { return low.x > high.x || (low.x == high.x && low.y > high.y); }

// The elements of exchange `t` at a distance, a power of two.
uvec2 at_distance(uint t, uint distance) {
    uint low = 2 * t - (t & (distance - 1));
    return uvec2(low, low + distance);
}

// The same of the step that begins a run of twice `half_run`: the first with the last, and so on inwards.
uvec2 mirrored(uint t, uint half_run) {
    uint inside = t & (half_run - 1);
    uint low = 2 * t - inside;
    return uvec2(low, low - 2 * inside + 2 * half_run - 1);
}

void exchange_held(uvec2 at, uint count) {
    if (at.y >= count) return;
    uvec2 low = held[at.x], high = held[at.y];
    if (are_swapped(low, high)) {
        held[at.x] = high;
        held[at.y] = low;
    }
}

void exchange_pairs(uvec2 at, uint begin, uint count) {
    if (at.y >= count) return;
    uvec2 low = pairs[begin + at.x], high = pairs[begin + at.y];
    if (are_swapped(low, high)) {
        pairs[begin + at.x] = high;
        pairs[begin + at.y] = low;
    }
}

// Exchanges at `distance` and all smaller ones, which end a run.
void merge_held(uint distance, uint count, uint next) {
    for (; distance > 0; distance /= 2) {
        for (uint t = thread(); 2 * t < count + distance; t += THREADS) exchange_held(at_distance(t, distance), count);
        sync_held(distance > 1 ? distance : next);
    }
}

// Runs of up to `count` pairs, which are not sorted at first.
void sort_held(uint count) {
    for (uint half_run = 1; half_run < count; half_run *= 2) {
        for (uint t = thread(); 2 * t < count + half_run; t += THREADS) exchange_held(mirrored(t, half_run), count);
        sync_held(half_run);
        merge_held(half_run / 2, count, 2 * half_run);
    }
}

void load(uint first, uint count) {
    for (uint i = thread(); i < count; i += THREADS) held[i] = pairs[first + i];
    barrier();
}

void store(uint first, uint count) {
    barrier();
    for (uint i = thread(); i < count; i += THREADS) pairs[first + i] = held[i];
    barrier();
}

void main() {
    uint tile = WORKGROUP_INDEX;
    if (tile > tile_count) return;
    uint begin = tile_begins[tile];
    if (tile == tile_count) {
        for (uint i = begin + thread(); i < counts[0]; i += THREADS) {
            sorted_tiles[i] = NO_TILE;
            sorted_intersections[i] = 0;
        }
        return;
    }
    uint count = tile_begins[tile + 1] - begin;
    bool is_held = count <= CAPACITY;
    for (uint first = 0; first < count; first += CAPACITY) {
        uint part = min(count - first, CAPACITY);
        load(begin + first, part);
        sort_held(part);
        if (!is_held) store(begin + first, part);
    }
    for (uint half_run = CAPACITY; half_run < count; half_run *= 2) {
        sync_pairs();
        for (uint t = thread(); 2 * t < count + half_run; t += THREADS)
            exchange_pairs(mirrored(t, half_run), begin, count);
        sync_pairs();
        for (uint distance = half_run / 2; distance >= CAPACITY; distance /= 2) {
            for (uint t = thread(); 2 * t < count + distance; t += THREADS)
                exchange_pairs(at_distance(t, distance), begin, count);
            sync_pairs();
        }
        for (uint first = 0; first < count; first += CAPACITY) {
            uint part = min(count - first, CAPACITY);
            load(begin + first, part);
            merge_held(CAPACITY / 2, part, CAPACITY);
            store(begin + first, part);
        }
    }
    if (is_held) barrier();
    else sync_pairs();
    for (uint i = thread(); i < count; i += THREADS) {
        sorted_tiles[begin + i] = tile;
        sorted_intersections[begin + i] = is_held ? held[i].y : pairs[begin + i].y;
    }
}
