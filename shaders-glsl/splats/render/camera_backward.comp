#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "camera.glsl"
#include "rotation.glsl"
#include "splat.glsl"
#include "shared_intersections.glsl"

//! Camera backward: one lane per Gaussian, from the records of its slots to its share of the camera's gradient.
//!
//! Runs after `project_backward`, whose gradient of the mean says what a shift of the view does. A turn of the view
//! moves the mean, and turns the Gaussian against the Jacobian; colours depend on the camera's position alone.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant, scalar) uniform Params {
    uint camera_index;
    uint gaussian_count;
};

layout(constant_id = 14) const bool ANTIALIASED = false;  // opacities are compensated for the dilation

layout(binding = 0) readonly  buffer Parameters { float parameters[]; };  // planes
layout(binding = 1) readonly  buffer Splats     { ProjectedSplat splats[]; };
layout(binding = 2) readonly  buffer TileCounts { uint tile_counts[]; };
// first intersection, one past the last
layout(binding = 3) readonly  buffer IntersectionRanges    { uvec2 intersection_ranges[]; };
layout(binding = 4) readonly  buffer GradientRecords    { vec4 gradient_records[]; };      // (slots, RECORD_VECTORS)
layout(binding = 5) readonly  buffer Gradients  { float gradients[]; };   // (columns x gaussian_count)
layout(binding = 6) readonly  buffer Cameras    { Camera cameras[]; };
layout(binding = 7) writeonly buffer Shares     { float shares[]; };      // (gaussian_count, CAMERA_WIDTH)

#include "gradient_records.glsl"
#include "conic.glsl"

#define STORE(at, v, width) \
    [[unroll]] for (uint c = 0; c < (width); c++) shares[CAMERA_WIDTH * i + (at) + c] = (v)[c];

void main() {
    uint i = THREAD_INDEX;
    bool is_seen = i < gaussian_count && tile_counts[i] > 0;
    vec4 sum[RECORD_VECTORS];
    sum_gradient_records(is_seen ? intersection_ranges[i] : uvec2(0), sum);
    if (i >= gaussian_count) return;
    if (!is_seen) {
        [[unroll]] for (uint k = 0; k < CAMERA_WIDTH; k++) shares[CAMERA_WIDTH * i + k] = 0.0;
        return;
    }
    float record[4 * RECORD_VECTORS];
    [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) {
        [[unroll]] for (uint c = 0; c < 4; c++) record[4 * k + c] = sum[k][c];
    }
    vec3 conic = splats[i].conic;
    vec2 d_mean2d = mean2d_gradient(conic, vec2(record[1], record[2]));
    vec3 d_conic = conic_gradient(vec3(record[3], record[4], record[5]));

    Camera camera = cameras[camera_index];
    mat3 view_rotation = mat3(camera.view_from_world);
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec3 mean_in_view = camera.view_from_world * vec4(mean, 1.0);
    mat3 view_axes = view_rotation * rotation(unit_quat(LOAD_VEC4(parameters, QUATS_COLUMN, gaussian_count, i)));
    vec3 scale = exp(LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i));
    for (uint k = 0; k < 3; k++) view_axes[k] *= scale[k];
    Jacobian jacobian = camera_jacobian(mean_in_view, camera);
    vec3 row0 = jacobian.scale.x * jacobian.row0, row1 = jacobian.scale.y * jacobian.row1;
    vec3 u0 = row0 * view_axes, u1 = row1 * view_axes;
    ConicGradient d = conic_backward(conic, u0, u1, d_conic);
    if (ANTIALIASED) {
        ConicGradient by = compensation_backward(u0, u1);
        float weight = opacity_gradient(splats[i].opacity, record[0]) * splats[i].opacity;
        d = ConicGradient(d.u0 + weight * by.u0, d.u1 + weight * by.u1, d.log_scale);
    }
    vec3 d_row0 = view_axes * d.u0, d_row1 = view_axes * d.u1;
    vec3 d_mean_in_view = camera_backward(mean_in_view, camera, d_mean2d, d_row0, d_row1);

    vec2 place = (camera_project(mean_in_view, camera) - camera.principal_point) / camera.focal;
    vec3 d_shift = view_rotation * LOAD_VEC3(gradients, MEANS_COLUMN, gaussian_count, i);
    vec3 d_turn = cross(mean_in_view, d_mean_in_view) + cross(d_row0, row0) + cross(d_row1, row1);
    vec2 d_focal = d_mean2d * place + vec2(dot(d_row0, row0), dot(d_row1, row1)) / camera.focal;
    vec4 d_distortion = camera_distortion_backward(mean_in_view, camera, d_mean2d, d_row0, d_row1);
    STORE(0, d_shift, 3)
    STORE(3, d_turn, 3)
    STORE(6, d_focal, 2)
    STORE(8, d_mean2d, 2)
    STORE(10, d_distortion, 4)
}
