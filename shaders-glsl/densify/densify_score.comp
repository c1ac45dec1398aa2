#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "fate.glsl"

//! Densify score: one thread per Gaussian makes the key that orders it by how much it asks to multiply.
//!
//! To go: fainter than the minimum or with a parameter that is not finite. Of the rest, those whose screen-space
//! gradient, averaged over the steps that saw them, exceeds the threshold are candidates (Kerbl et al. 2023, section
//! 5.2), unless a camera is near for how wide they are: its view of such a Gaussian is not that of two halves.
//! Reference: `src/reference/densify_score.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  column_count;
    uint  feature_count;
    float gradient_threshold;  // mean norm in normalised device units; exceeded, not met
    float min_raw_opacity;     // before the sigmoid
    uint  first_gaussian;      // how many lie before those of this dispatch
    uint  camera_count;        // 0: a Gaussian of any width may multiply
};

layout(binding = 0) readonly  buffer Parameters   { float parameters[]; };      // planes
layout(binding = 1) readonly  buffer GradNormSums { float grad_norm_sums[]; };  // (gaussian_count)
layout(binding = 2) readonly  buffer VisitCounts  { uint visit_counts[]; };     // (gaussian_count)
layout(binding = 3) writeonly buffer Keys         { uint keys[]; };             // (gaussian_count), KEY_*
layout(binding = 4) writeonly buffer Ids          { uint ids[]; };              // (gaussian_count)
layout(binding = 5) buffer Tally { uint tally[]; };                             // TALLY_*, zero before
layout(binding = 6) readonly  buffer Cameras      { float cameras[]; };         // (camera_count, 3), where they stand

// Positive phrasing: a NaN fails the test.
bool is_sound(uint i) {
    if (!(parameters[RAW_OPACITIES_COLUMN * gaussian_count + i] >= min_raw_opacity)) return false;
    for (uint plane = 0; plane < PLANE_COUNT; ++plane) {
        uint column = plane_column(plane, feature_count, column_count);
        uint width = plane_column(plane + 1, feature_count, column_count) - column;
        uint first = column * gaussian_count + width * i;
        for (uint k = 0; k < width; ++k) if (!(abs(parameters[first + k]) < 3e38)) return false;
    }
    return true;
}

// Whether two halves would look as it does from everywhere that views are seen from.
bool is_far_enough(uint i) {
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec3 log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i);
    float width = exp(max(log_scales.x, max(log_scales.y, log_scales.z)));
    float least = width / WIDEST_SPLIT;
    bool is_far = true;
    for (uint k = 0; k < camera_count; ++k) {
        vec3 away = mean - vec3(cameras[3 * k], cameras[3 * k + 1], cameras[3 * k + 2]);
        is_far = is_far && dot(away, away) >= least * least;
    }
    return is_far;
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    float mean_gradient = visit_counts[i] > 0 ? grad_norm_sums[i] / float(visit_counts[i]) : 0.0;
    bool is_candidate = mean_gradient > gradient_threshold && is_far_enough(i);
    uint key = KEY_PRUNE;
    if (is_sound(i)) key = is_candidate ? KEY_TOP - floatBitsToUint(mean_gradient) : KEY_KEEP;
    keys[i] = key;
    ids[i] = first_gaussian + i;
    uint candidates = subgroupAdd(key < KEY_KEEP ? 1u : 0u);
    uint pruned = subgroupAdd(key == KEY_PRUNE ? 1u : 0u);
    if (subgroupElect()) {
        atomicAdd(tally[TALLY_CANDIDATES], candidates);
        atomicAdd(tally[TALLY_PRUNED], pruned);
    }
}
