#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "camera.glsl"
#include "fate.glsl"
#include "random.glsl"

//! Densify scatter: one thread per Gaussian writes what comes of it to the new planes.
//!
//! A Gaussian that stays keeps its moments; a new one begins with zero moments at a position drawn from the normal
//! distribution that its parent is (the clone too: the LITA-GS variant of Kerbl et al. 2023), after a split at 1/1.6
//! of its scale. Draws depend on seed, step, Gaussian and copy alone. Reference: `src/reference/densify_scatter.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint gaussian_count;
    uint new_gaussian_count;
    uint column_count;
    uint feature_count;
    uint seed;
    uint step;
};

layout(binding = 0) readonly  buffer Parameters       { float parameters[]; };          // planes
layout(binding = 1) readonly  buffer FirstMoments     { float first_moments[]; };       // planes
layout(binding = 2) readonly  buffer SecondMoments    { float second_moments[]; };      // planes
layout(binding = 3) readonly  buffer Fates            { uint fates[]; };                // (gaussian_count), FATE_*
layout(binding = 4) readonly  buffer Offsets          { uint offsets[]; };              // (gaussian_count), first output
layout(binding = 5) writeonly buffer NewParameters    { float new_parameters[]; };      // planes
layout(binding = 6) writeonly buffer NewFirstMoments  { float new_first_moments[]; };   // planes
layout(binding = 7) writeonly buffer NewSecondMoments { float new_second_moments[]; };  // planes

const float LOG_SPLIT_FACTOR = 0.47000362924573558;  // ln 1.6

void copy(uint from, uint to, bool is_new) {
    for (uint plane = 0; plane < PLANE_COUNT; ++plane) {
        uint column = plane_column(plane, feature_count, column_count);
        uint width = plane_column(plane + 1, feature_count, column_count) - column;
        uint source = column * gaussian_count + width * from;
        uint target = column * new_gaussian_count + width * to;
        for (uint k = 0; k < width; ++k) {
            new_parameters[target + k] = parameters[source + k];
            new_first_moments[target + k] = is_new ? 0.0 : first_moments[source + k];
            new_second_moments[target + k] = is_new ? 0.0 : second_moments[source + k];
        }
    }
}

// A draw from the normal distribution that Gaussian i is.
vec3 draw_mean(uint i, vec3 log_scales, uint copy_index) {
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec4 quat = LOAD_VEC4(parameters, QUATS_COLUMN, gaussian_count, i);
    uint key = random_bits(random_bits(random_bits(seed) + step) + 2 * i + copy_index);
    return mean + rotation(unit_quat(quat)) * (exp(log_scales) * random_normal3(key));
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    uint fate = fates[i];
    for (uint copy_index = 0; copy_index < offspring(fate); ++copy_index) {
        uint to = offsets[i] + copy_index;
        bool is_new = fate == FATE_SPLIT || copy_index > 0;
        copy(i, to, is_new);
        if (!is_new) continue;
        vec3 log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i);
        vec3 mean = draw_mean(i, log_scales, copy_index);
        if (fate == FATE_SPLIT) log_scales -= LOG_SPLIT_FACTOR;
        for (uint k = 0; k < 3; ++k) {
            new_parameters[MEANS_COLUMN * new_gaussian_count + 3 * to + k] = mean[k];
            new_parameters[LOG_SCALES_COLUMN * new_gaussian_count + 3 * to + k] = log_scales[k];
        }
    }
}
