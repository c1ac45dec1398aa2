#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "fate.glsl"

//! Densify count: one thread per Gaussian decides what density control does with it, and how many come of it.
//!
//! Pruned: fainter than the minimum or with a parameter that is not finite. Of the rest, those whose screen-space
//! gradient, averaged over the steps that saw them, exceeds the threshold multiply: large ones split, small ones are
//! cloned (Kerbl et al. 2023, section 5.2). Reference: `src/reference/densify_count.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  column_count;
    uint  feature_count;
    float gradient_threshold;  // mean norm in normalised device units; exceeded, not met
    float split_log_scale;     // ln of the largest standard deviation of a clone
    float min_raw_opacity;     // before the sigmoid
};

layout(binding = 0) readonly  buffer Parameters    { float parameters[]; };      // planes
layout(binding = 1) readonly  buffer GradNormSums  { float grad_norm_sums[]; };  // (gaussian_count)
layout(binding = 2) readonly  buffer VisitCounts   { uint visit_counts[]; };     // (gaussian_count)
layout(binding = 3) writeonly buffer MeanGradients { float mean_gradients[]; };  // (gaussian_count)
layout(binding = 4) writeonly buffer Fates         { uint fates[]; };            // (gaussian_count), FATE_*
layout(binding = 5) writeonly buffer Offspring     { uint offspring_counts[]; }; // (gaussian_count)

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

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    float mean_gradient = visit_counts[i] > 0 ? grad_norm_sums[i] / float(visit_counts[i]) : 0.0;
    vec3 log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i);
    bool is_large = max(log_scales.x, max(log_scales.y, log_scales.z)) > split_log_scale;
    uint fate = FATE_PRUNE;
    if (is_sound(i)) {
        bool multiplies = mean_gradient > gradient_threshold;
        fate = !multiplies ? FATE_KEEP : is_large ? FATE_SPLIT : FATE_CLONE;
    }
    mean_gradients[i] = mean_gradient;
    fates[i] = fate;
    offspring_counts[i] = offspring(fate);
}
