#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "fate.glsl"

//! Densify decide: one thread per place in the order of the keys settles the fate of the Gaussian there.
//!
//! A round may take its share of the room below the limit. Where the candidates exceed it, only those above the largest
//! that finds no room multiply: the limit holds, and equal gradients fare alike. Reference:
//! `src/reference/densify_decide.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;   // of all batches
    uint  first_gaussian;   // how many lie before those of this dispatch
    uint  batch_count;      // how many these are
    uint  max_gaussians;
    uint  rounds_left;      // this one included; at least 1
    float split_log_scale;  // ln of the largest standard deviation of a clone
    uint  most_added;       // of all batches
};

layout(constant_id = 0) const bool CONSERVING = false;  // every candidate is split

layout(binding = 0) readonly  buffer Parameters { float parameters[]; };      // planes of the batch
layout(binding = 1) readonly  buffer SortedKeys { uint sorted_keys[]; };      // (gaussian_count), KEY_*
layout(binding = 2) readonly  buffer SortedIds  { uint sorted_ids[]; };       // (gaussian_count)
layout(binding = 3) buffer Tally { uint tally[]; };                           // TALLY_*
layout(binding = 4) writeonly buffer Fates      { uint fates[]; };            // (gaussian_count), FATE_*
layout(binding = 5) writeonly buffer Offspring  { uint offspring_counts[]; }; // (gaussian_count)

// How many may multiply; each adds one Gaussian.
uint room() {
    uint kept = gaussian_count - tally[TALLY_PRUNED];
    uint free = max(max_gaussians, kept) - kept;
    return min(most_added, free / rounds_left + (free % rounds_left > 0 ? 1 : 0));
}

bool is_small(uint i) {
    if (CONSERVING) return false;
    vec3 log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, batch_count, i - first_gaussian);
    return max(log_scales.x, max(log_scales.y, log_scales.z)) <= split_log_scale;
}

void main() {
    uint place = THREAD_INDEX;
    if (place >= gaussian_count) return;
    uint i = sorted_ids[place], key = sorted_keys[place];
    // Unsigned: what lies before the batch wraps beyond its end.
    if (i - first_gaussian >= batch_count) return;
    uint first_without = room();
    uint end = tally[TALLY_CANDIDATES] > first_without ? sorted_keys[first_without] : KEY_KEEP;
    uint fate = key == KEY_PRUNE ? FATE_PRUNE : FATE_KEEP;
    if (key < end) fate = is_small(i) ? FATE_CLONE : FATE_SPLIT;
    fates[i] = fate;
    offspring_counts[i] = offspring(fate);
    uint cloned = subgroupAdd(fate == FATE_CLONE ? 1u : 0u);
    uint split = subgroupAdd(fate == FATE_SPLIT ? 1u : 0u);
    if (subgroupElect()) {
        atomicAdd(tally[TALLY_CLONED], cloned);
        atomicAdd(tally[TALLY_SPLIT], split);
    }
}
