#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#define CAMERA_MODEL camera.model
#include "camera.glsl"
#include "rotation.glsl"
#include "splat.glsl"
#include "densify_action.glsl"
#include "rest_layout.glsl"

//! Densify score: one thread per Gaussian computes the key that orders Gaussians by their need for densification.
//!
//! Gaussians with less than the minimum opacity or a non-finite parameter are pruned. Among the others, those whose
//! screen-space gradient, averaged over the steps in which they were visible, exceeds the threshold are candidates
//! (Kerbl et al. 2023, section 5.2), unless splitting them would change the view of a camera by more than a bound.
//! Reference: `src/reference/densify_score.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  column_count;
    uint  feature_count;
    float gradient_threshold;  // mean norm in normalised device units; exceeded, not met
    float min_raw_opacity;     // before the sigmoid
    uint  first_gaussian;      // Gaussians before those of this dispatch
    uint  camera_count;
    float near;                // world units
    float largest_change;      // of a camera's view by one split; exceeded, not met
};

layout(binding = 0) readonly  buffer Parameters   { float parameters[]; };      // planes
layout(binding = 1) readonly  buffer GradNormSums { float grad_norm_sums[]; };  // (gaussian_count)
layout(binding = 2) readonly  buffer VisitCounts  { uint visit_counts[]; };     // (gaussian_count)
layout(binding = 3) writeonly buffer Keys         { uint keys[]; };             // (gaussian_count), KEY_*
layout(binding = 4) writeonly buffer Ids          { uint ids[]; };              // (gaussian_count)
layout(binding = 5) buffer Counters { uint counters[]; };                             // COUNTER_*, initially zero
layout(binding = 6) readonly  buffer Cameras      { Camera cameras[]; };        // (camera_count)

// Written so that a NaN fails.
bool is_sound(uint i) {
    if (!(parameters[RAW_OPACITIES_COLUMN * gaussian_count + i] >= min_raw_opacity)) return false;
    for (uint plane = 0; plane < PLANE_COUNT; ++plane) {
        uint column = plane_column(plane, feature_count, column_count);
        uint width = plane_column(plane + 1, feature_count, column_count) - column;
        for (uint k = 0; k < width; ++k) {
            if (!(abs(parameters[plane_word(plane, column, width, gaussian_count, i, k)]) < 3e38)) return false;
        }
    }
    return true;
}

// An estimate of the mean squared change of a view when two halves replace a Gaussian, in units of the squared contrast
// of the area that it covers: the share of the view that it covers, times the square of its opacity and of the relative
// change of depth. Halves that move across the view show what the Gaussian showed; halves that move along the ray are
// magnified, and may pass a surface in front of the Gaussian.
float view_change(vec3 mean, mat3 axes, float opacity, uint axis, Camera camera) {
    vec3 mean_in_view = camera.view_from_world * vec4(mean, 1.0);
    mat3 view_axes = mat3(camera.view_from_world) * axes;
    float depth = camera_depth(mean_in_view, camera);
    float shift = SPLIT_OFFSET * abs(camera_depth_change(mean_in_view, axis_of(view_axes, axis), camera));
    // Both halves are in front of the near plane.
    if (depth + shift <= near) return 0.0;
    // The nearer half has the largest footprint.
    depth = max(depth - shift, max(near, NEAREST));
    mean_in_view = camera_at_depth(mean_in_view, depth, camera);
    if (camera_depth(mean_in_view, camera) <= 0.0) return 0.0;
    Jacobian jacobian = camera_jacobian(mean_in_view, camera);
    mat3 rows = transpose(view_axes);
    vec3 u0 = jacobian.scale.x * (rows * jacobian.row0);
    vec3 u1 = jacobian.scale.y * (rows * jacobian.row1);
    vec2 variance = vec2(dot(u0, u0), dot(u1, u1)) + DILATION;
    vec2 half_extent = sqrt(max(splat_level(opacity), 0.0) * variance);
    vec2 mean2d = camera_project(mean_in_view, camera);
    vec2 size = vec2(camera.size);
    vec2 covered = clamp(mean2d + half_extent, vec2(0.0), size) - clamp(mean2d - half_extent, vec2(0.0), size);
    float change = opacity * shift / depth;
    return covered.x / size.x * (covered.y / size.y) * change * change;
}

// Whether a split of the Gaussian changes every camera's view by at most the bound.
bool is_safe_to_split(uint i) {
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec3 log_scales = LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i);
    mat3 axes = rotation(unit_quat(LOAD_VEC4(parameters, QUATS_COLUMN, gaussian_count, i)));
    for (uint k = 0; k < 3; k++) axes[k] *= exp(log_scales[k]);
    float opacity = sigmoid(parameters[RAW_OPACITIES_COLUMN * gaussian_count + i]);
    uint axis = longest_axis(log_scales);
    // Written so that a NaN fails.
    for (uint k = 0; k < camera_count; ++k)
        if (!(view_change(mean, axes, opacity, axis, cameras[k]) <= largest_change)) return false;
    return true;
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    float mean_gradient = visit_counts[i] > 0 ? grad_norm_sums[i] / float(visit_counts[i]) : 0.0;
    bool is_candidate = mean_gradient > gradient_threshold;
    uint key = KEY_PRUNE;
    if (is_sound(i)) key = is_candidate && is_safe_to_split(i) ? KEY_TOP - floatBitsToUint(mean_gradient) : KEY_KEEP;
    keys[i] = key;
    ids[i] = first_gaussian + i;
    uint candidates = subgroupAdd(key < KEY_KEEP ? 1u : 0u);
    uint pruned = subgroupAdd(key == KEY_PRUNE ? 1u : 0u);
    if (subgroupElect()) {
        atomicAdd(counters[COUNTER_CANDIDATES], candidates);
        atomicAdd(counters[COUNTER_PRUNED], pruned);
    }
}
