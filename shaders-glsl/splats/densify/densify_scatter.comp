#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "rotation.glsl"
#include "densify_action.glsl"
#include "random.glsl"
#include "rest_layout.glsl"

//! Densify scatter: one thread per Gaussian writes the parameters of its children to the new planes.
//!
//! Paper: a new Gaussian is at a position drawn from its parent's normal distribution (also for a clone: the LITA-GS
//! variant of Kerbl et al. 2023), and has 1/1.6 of its scale after a split; draws depend only on seed, step, Gaussian
//! and copy. Conserving: the two halves of a split are along the parent's longest axis and together cover the same
//! area. A dispatch goes from one batch of Gaussians to one batch of the new ones. Reference:
//! `src/reference/densify_scatter.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint gaussian_count;
    uint new_gaussian_count;
    uint column_count;
    uint feature_count;
    uint seed;
    uint step;
    uint first_gaussian;      // Gaussians before those of this dispatch
    uint first_new_gaussian;  // new Gaussians before those of this dispatch
};

layout(constant_id = 0) const bool CONSERVING = false;

layout(binding = 0) readonly  buffer Parameters    { float parameters[]; };     // planes
layout(binding = 1) readonly  buffer Actions         { uint actions[]; };           // (gaussian_count), ACTION_*
layout(binding = 2) readonly  buffer Offsets       { uint offsets[]; };         // (gaussian_count), first output
layout(binding = 3) writeonly buffer NewParameters { float new_parameters[]; }; // planes

void copy(uint from, uint to) {
    for (uint plane = 0; plane < PLANE_COUNT; ++plane) {
        uint column = plane_column(plane, feature_count, column_count);
        uint width = plane_column(plane + 1, feature_count, column_count) - column;
        for (uint k = 0; k < width; ++k) {
            uint source = plane_word(plane, column, width, gaussian_count, from, k);
            new_parameters[plane_word(plane, column, width, new_gaussian_count, to, k)] = parameters[source];
        }
    }
}

// The attributes that a split changes.
struct Shape {
    vec3 mean;
    vec3 log_scales;
    float raw_opacity;
};

// A draw from the normal distribution of Gaussian i.
Shape drawn(uint i, Shape parent, mat3 axes, bool is_split, uint copy_index) {
    uint key = random_bits(random_bits(random_bits(seed) + step) + 2 * (first_gaussian + i) + copy_index);
    Shape child = parent;
    child.mean += axes * (exp(parent.log_scales) * random_normal3(key));
    if (is_split) child.log_scales -= PAPER_LOG_SPLIT_FACTOR;
    return child;
}

// One half of a Gaussian along its longest axis.
Shape half_of(Shape parent, mat3 axes, uint copy_index) {
    vec3 log_scales = parent.log_scales;
    uint axis = longest_axis(log_scales);
    float opacity = sigmoid(parent.raw_opacity);
    float along = log(SPLIT_ALONG + SPLIT_ALONG_SLOPE * opacity);
    float across = log(SPLIT_ACROSS + SPLIT_ACROSS_SLOPE * opacity);
    float new_opacity = opacity * (SPLIT_OPACITY + SPLIT_OPACITY_SLOPE * opacity);
    float offset = (copy_index == 0 ? SPLIT_OFFSET : -SPLIT_OFFSET) * exp(log_scales[axis]);
    Shape child;
    child.mean = parent.mean + offset * axis_of(axes, axis);
    for (uint k = 0; k < 3; ++k) child.log_scales[k] = log_scales[k] + (k == axis ? along : across);
    child.raw_opacity = log(new_opacity / (1.0 - new_opacity));
    return child;
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    uint action = actions[i];
    Shape parent;
    parent.mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    parent.log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i);
    parent.raw_opacity = parameters[RAW_OPACITIES_COLUMN * gaussian_count + i];
    mat3 axes = rotation(unit_quat(LOAD_VEC4(parameters, QUATS_COLUMN, gaussian_count, i)));
    for (uint copy_index = 0; copy_index < child_count(action); ++copy_index) {
        // Unsigned: Gaussians before the batch wrap beyond its end.
        uint to = offsets[i] + copy_index - first_new_gaussian;
        if (to >= new_gaussian_count) continue;
        copy(i, to);
        if (!is_new(action, copy_index)) continue;
        Shape child;
        if (CONSERVING) child = half_of(parent, axes, copy_index);
        else child = drawn(i, parent, axes, action == ACTION_SPLIT, copy_index);
        for (uint k = 0; k < 3; ++k) {
            new_parameters[MEANS_COLUMN * new_gaussian_count + 3 * to + k] = child.mean[k];
            new_parameters[LOG_SCALES_COLUMN * new_gaussian_count + 3 * to + k] = child.log_scales[k];
        }
        new_parameters[RAW_OPACITIES_COLUMN * new_gaussian_count + to] = child.raw_opacity;
    }
}
