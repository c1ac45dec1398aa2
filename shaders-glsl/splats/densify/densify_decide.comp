#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "densify_action.glsl"

//! Densify decide: one thread per position in the order of the keys decides the action for the Gaussian there.
//!
//! A round may use its share of the headroom below the limit. If the candidates exceed it, only those with a larger
//! gradient than the first one beyond the share are densified: the limit holds, and equal gradients are treated
//! equally. Reference: `src/reference/densify_decide.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;   // of all batches
    uint  first_gaussian;   // Gaussians before those of this dispatch
    uint  batch_count;      // Gaussians of this dispatch
    uint  max_gaussians;
    uint  rounds_left;      // including this one; at least 1
    float split_log_scale;  // ln of the largest standard deviation of a clone
    uint  max_added;       // of all batches
};

layout(constant_id = 0) const bool CONSERVING = false;  // every candidate is split

layout(binding = 0) readonly  buffer Parameters { float parameters[]; };      // planes of the batch
layout(binding = 1) readonly  buffer SortedKeys { uint sorted_keys[]; };      // (gaussian_count), KEY_*
layout(binding = 2) readonly  buffer SortedIds  { uint sorted_ids[]; };       // (gaussian_count)
layout(binding = 3) buffer Counters { uint counters[]; };                           // COUNTER_*
layout(binding = 4) writeonly buffer Actions      { uint actions[]; };            // (gaussian_count), ACTION_*
layout(binding = 5) writeonly buffer ChildCounts  { uint child_counts[]; }; // (gaussian_count)

// The number of Gaussians that may be added; each candidate adds one.
uint available() {
    uint kept = gaussian_count - counters[COUNTER_PRUNED];
    uint free = max(max_gaussians, kept) - kept;
    return min(max_added, free / rounds_left + (free % rounds_left > 0 ? 1 : 0));
}

bool is_small(uint i) {
    if (CONSERVING) return false;
    vec3 log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, batch_count, i - first_gaussian);
    return max(log_scales.x, max(log_scales.y, log_scales.z)) <= split_log_scale;
}

void main() {
    uint rank = THREAD_INDEX;
    if (rank >= gaussian_count) return;
    uint i = sorted_ids[rank], key = sorted_keys[rank];
    // Unsigned: Gaussians before the batch wrap beyond its end.
    if (i - first_gaussian >= batch_count) return;
    uint first_without = available();
    uint end = counters[COUNTER_CANDIDATES] > first_without ? sorted_keys[first_without] : KEY_KEEP;
    uint action = key == KEY_PRUNE ? ACTION_PRUNE : ACTION_KEEP;
    if (key < end) action = is_small(i) ? ACTION_CLONE : ACTION_SPLIT;
    actions[i] = action;
    child_counts[i] = child_count(action);
    uint cloned = subgroupAdd(action == ACTION_CLONE ? 1u : 0u);
    uint split = subgroupAdd(action == ACTION_SPLIT ? 1u : 0u);
    if (subgroupElect()) {
        atomicAdd(counters[COUNTER_CLONED], cloned);
        atomicAdd(counters[COUNTER_SPLIT], split);
    }
}
