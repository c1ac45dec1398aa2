#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "camera.glsl"
#include "rotation.glsl"
#include "sh.glsl"
#include "splat.glsl"
#include "status.glsl"
#include "shared_intersections.glsl"
#include "lamp.glsl"

//! Project backward: one lane per Gaussian, from the records of its slots to the gradients of its attributes.
//!
//! Sums the records, which gives the gradients of the splat, and applies the chain rule through `project`; the required
//! values of the forward pass are recomputed. Also updates the statistics of density control. A gradient that is not
//! finite sets a flag, so that neither this step nor later ones change a parameter.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant, scalar) uniform Params {
    uint  camera_index;
    vec2  half_view;       // half the view, pixels, by the share that the render is of its pixels
    uint  gaussian_count;
    uint  sh_degree;       // in use; at most SH_DEGREE
    uint  adds_pixels;     // the statistic of density control is 1: the sum of pixels' norms, 0: the norm of their sum
    float damping_weight;  // 0 to 1: how much of the statistic is damped near the camera
    float damping_depth;   // world units: no damping beyond
};

layout(constant_id = 0) const uint SH_DEGREE = 3;  // stored
layout(constant_id = 5) const bool RAW_COLORS = false;
layout(constant_id = 6) const bool HALF_REST = false;  // SH above degree 0 in the format of include/half.glsl
#include "trained.glsl"
// For `adam_gaussian`, which computes what depends on the viewing direction: only the gradient of the colour is written
// of those of SH above degree 0, and that of the mean lacks the part through the direction.
layout(constant_id = 13) const bool COLOR_GRADIENTS = false;
layout(constant_id = 14) const bool ANTIALIASED = false;  // opacities are compensated for the dilation
layout(constant_id = 16) const bool LAMP = false;  // colours are lit by a lamp at the camera

layout(binding = 0) readonly  buffer Parameters { float parameters[]; };  // planes
layout(binding = 1) readonly  buffer Splats     { ProjectedSplat splats[]; };
layout(binding = 2) readonly  buffer Colors     { vec4 colors[]; };       // (gaussian_count, COLOR_VECTORS)
layout(binding = 3) readonly  buffer TileCounts { uint tile_counts[]; };
// first intersection, one past the last
layout(binding = 4) readonly  buffer IntersectionRanges    { uvec2 intersection_ranges[]; };
layout(binding = 5) readonly  buffer GradientRecords    { vec4 gradient_records[]; };      // (slots, RECORD_VECTORS)
layout(binding = 6)           buffer Status     { uint status[]; };
layout(binding = 7) writeonly buffer Gradients  { float gradients[]; };   // trained planes
layout(binding = 8) buffer GradNormSums { float grad_norm_sums[]; };
layout(binding = 9) buffer VisitCounts  { uint visit_counts[]; };
layout(binding = 10) readonly buffer Cameras { Camera cameras[]; };
layout(binding = 11) readonly buffer LampNumbers { float lamp[]; };  // (LAMP_NUMBERS), read with LAMP

layout(constant_id = 11) const uint VIEW_DEPTHS = 0;  // 1: the last channel is the depth, not a feature
const uint FEATURE_COUNT = CHANNELS - 3 - VIEW_DEPTHS;

#include "rest.glsl"
#include "gradient_records.glsl"
#include "conic.glsl"
#include "lamp_falloff.glsl"

#define STORE_VEC3(column, i, v) { \
    uint at = trained_place((column) * gaussian_count + 3 * (i)); \
    gradients[at] = (v).x; gradients[at + 1] = (v).y; gradients[at + 2] = (v).z; }
#define STORE_VEC4(column, i, v) { \
    uint at = trained_place((column) * gaussian_count + 4 * (i)); \
    gradients[at] = (v).x; gradients[at + 1] = (v).y; gradients[at + 2] = (v).z; gradients[at + 3] = (v).w; }

// The gradients of SH above degree 0 that are written, of each Gaussian.
uint written_rest() { return COLOR_GRADIENTS ? min(rest_width(), 3) : rest_width(); }

// The place of one of them.
uint rest_gradient(uint i, uint k) {
    return trained_place(rest_word(REST_COLUMN, written_rest(), gaussian_count, i, k));
}

// The gradient of a unit quaternion's rotation matrix.
vec4 rotation_backward(vec4 q, mat3 d) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return 2.0 * vec4(
        x * (d[1][2] - d[2][1]) + y * (d[2][0] - d[0][2]) + z * (d[0][1] - d[1][0]),
        w * (d[1][2] - d[2][1]) - 2.0 * x * (d[1][1] + d[2][2]) + y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0]),
        w * (d[2][0] - d[0][2]) + x * (d[0][1] + d[1][0]) - 2.0 * y * (d[0][0] + d[2][2]) + z * (d[1][2] + d[2][1]),
        w * (d[0][1] - d[1][0]) + x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) - 2.0 * z * (d[0][0] + d[1][1])
    );
}

// Writes the gradients of the SH coefficients above degree 0; returns that of the mean, through the viewing direction.
vec3 sh_backward(uint i, vec3 offset, vec3 d_color) {
    float small, distance;
    vec3 direction = direction_of(offset, small, distance);
    float basis[16];
    vec3 basis_gradient[16];
    sh_basis(sh_degree, direction, basis);
    sh_basis_gradient(sh_degree, direction, basis_gradient);
    vec3 d_direction = vec3(0.0);
    for (uint k = 1; k < sh_count(SH_DEGREE); k++) {
        d_direction += dot(rest_coefficient(i, k), d_color) * basis_gradient[k];
        for (uint c = 0; c < 3; c++) gradients[rest_gradient(i, 3 * (k - 1) + c)] = basis[k] * d_color[c];
    }
    return small * ((d_direction - direction * dot(direction, d_direction)) / distance);
}

// The largest magnitude by its bits, which are those of infinity or more where one is not finite.
uint largest_bits(vec3 v) {
    uvec3 bits = floatBitsToUint(v) & 0x7fffffffu;
    return max(max(bits.x, bits.y), bits.z);
}

// The statistic of density control: a norm of the screen-space gradient, in normalised device units. The pixels of fine
// texture pull a splat that blurs it in opposite directions, so that their sum vanishes; a sum of norms does not (Ye et
// al. 2024, AbsGS). A pixel's gradient is dL/dsigma times conic offset, whose components have the mean squares conic.xx
// and conic.yy over a splat: that is used for every pixel.
float gradient_norm(vec3 conic, vec2 d_mean2d, float magnitudes) {
    vec2 of_pixels = magnitudes * sqrt(conic.xz);
    return length(half_view * (adds_pixels == 0 ? d_mean2d : of_pixels));
}

void store_zero(uint i) {
    if (is_trained(MEANS_COLUMN)) STORE_VEC3(MEANS_COLUMN, i, vec3(0.0));
    if (is_trained(QUATS_COLUMN)) STORE_VEC4(QUATS_COLUMN, i, vec4(0.0));
    if (is_trained(LOG_SCALES_COLUMN)) STORE_VEC3(LOG_SCALES_COLUMN, i, vec3(0.0));
    if (is_trained(RAW_OPACITIES_COLUMN)) gradients[trained_place(RAW_OPACITIES_COLUMN * gaussian_count + i)] = 0.0;
    if (is_trained(DC_COLUMN)) STORE_VEC3(DC_COLUMN, i, vec3(0.0));
    uint features = trained_place(FEATURES_COLUMN * gaussian_count + FEATURE_COUNT * i);
    for (uint k = 0; k < FEATURE_COUNT; k++) gradients[features + k] = 0.0;
    for (uint k = 0; k < written_rest(); k++) gradients[rest_gradient(i, k)] = 0.0;
}

void main() {
    uint i = THREAD_INDEX;
    bool is_seen = i < gaussian_count && tile_counts[i] > 0;
    vec4 sum[RECORD_VECTORS];
    sum_gradient_records(is_seen ? intersection_ranges[i] : uvec2(0), sum);
    if (i >= gaussian_count) return;
    if (!is_seen) {
        store_zero(i);
        return;
    }
    ProjectedSplat splat = splats[i];
    float record[4 * RECORD_VECTORS];
    [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) {
        [[unroll]] for (uint c = 0; c < 4; c++) record[4 * k + c] = sum[k][c];
    }
    vec2 d_mean2d = mean2d_gradient(splat.conic, vec2(record[1], record[2]));
    vec3 d_conic = conic_gradient(vec3(record[3], record[4], record[5]));
    float d_opacity = opacity_gradient(splat.opacity, record[0]);
    vec3 color = colors[COLOR_VECTORS * i].rgb, d_color;
    for (uint c = 0; c < 3; c++) {
        // A colour clamped at zero passes nothing on.
        bool passes = color[c] > 0.0;
        if (RAW_COLORS) passes = true;
        d_color[c] = passes ? record[RECORD_HEAD + c] : 0.0;
    }
    uint features = trained_place(FEATURES_COLUMN * gaussian_count + FEATURE_COUNT * i);
    [[unroll]] for (uint k = 0; k < FEATURE_COUNT; k++) gradients[features + k] = record[RECORD_HEAD + 3 + k];

    // The forward pass again.
    Camera camera = cameras[camera_index];
    mat3 view_rotation = mat3(camera.view_from_world);
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec3 mean_in_view = camera.view_from_world * vec4(mean, 1.0);
    vec4 quat = LOAD_VEC4(parameters, QUATS_COLUMN, gaussian_count, i);
    vec4 unit = unit_quat(quat);
    mat3 axes = rotation(unit);
    vec3 scale = exp(LOAD_VEC3(parameters, LOG_SCALES_COLUMN, gaussian_count, i));
    mat3 scaled_axes = axes;
    for (uint k = 0; k < 3; k++) scaled_axes[k] *= scale[k];
    mat3 world_from_view = transpose(view_rotation);
    Jacobian jacobian = camera_jacobian(mean_in_view, camera);
    vec3 t0 = world_from_view * (jacobian.scale.x * jacobian.row0);  // rows of J W
    vec3 t1 = world_from_view * (jacobian.scale.y * jacobian.row1);
    vec3 u0 = t0 * scaled_axes, u1 = t1 * scaled_axes;

    ConicGradient d = conic_backward(splat.conic, u0, u1, d_conic);
    if (ANTIALIASED) {
        ConicGradient by = compensation_backward(u0, u1);
        float weight = d_opacity * splat.opacity;
        d = ConicGradient(d.u0 + weight * by.u0, d.u1 + weight * by.u1, d.log_scale + weight * by.log_scale);
    }

    // U = (J W) (R S)
    mat3 d_scaled_axes = outerProduct(t0, d.u0) + outerProduct(t1, d.u1);
    mat3 d_axes;
    for (uint k = 0; k < 3; k++) d_axes[k] = d_scaled_axes[k] * scale[k];
    vec4 d_unit = rotation_backward(unit, d_axes);
    float small = finite_scale(length(quat));
    float norm = length(small * quat);
    vec4 d_quat = norm > 1e-12 ? small * ((d_unit - unit * dot(unit, d_unit)) / norm) : vec4(0.0);

    vec3 d_row0 = view_rotation * (scaled_axes * d.u0);
    vec3 d_row1 = view_rotation * (scaled_axes * d.u1);
    vec3 d_mean_in_view = camera_backward(mean_in_view, camera, d_mean2d, d_row0, d_row1);
    if (VIEW_DEPTHS != 0) {
        for (uint k = 0; k < 3; k++) {
            vec3 axis = vec3(equal(uvec3(k), uvec3(0, 1, 2)));
            d_mean_in_view[k] += record[RECORD_HEAD + CHANNELS - 1] * camera_depth_change(mean_in_view, axis, camera);
        }
    }
    if (LAMP) lamp_lit_backward(mean_in_view, color, d_color, d_mean_in_view);
    vec3 d_mean = world_from_view * d_mean_in_view;
    if (COLOR_GRADIENTS) {
        for (uint c = 0; c < written_rest(); c++) gradients[rest_gradient(i, c)] = d_color[c];
    } else {
        d_mean += sh_backward(i, offset_from_camera(mean, camera.view_from_world), d_color);
    }

    if (is_trained(DC_COLUMN)) STORE_VEC3(DC_COLUMN, i, SH_C0 * d_color);
    if (is_trained(MEANS_COLUMN)) STORE_VEC3(MEANS_COLUMN, i, d_mean);
    if (is_trained(QUATS_COLUMN)) STORE_VEC4(QUATS_COLUMN, i, d_quat);
    if (is_trained(LOG_SCALES_COLUMN)) STORE_VEC3(LOG_SCALES_COLUMN, i, d.log_scale);
    uint raw_opacity = RAW_OPACITIES_COLUMN * gaussian_count + i;
    // Of an opaque Gaussian 1 - opacity is rounding; its complement is not.
    float d_raw_opacity = d_opacity * splat.opacity * sigmoid(-parameters[raw_opacity]);
    if (is_trained(RAW_OPACITIES_COLUMN)) gradients[trained_place(raw_opacity)] = d_raw_opacity;

    // No basis function is beyond 8.
    uint bits = largest_bits(8.0 * d_color);
    if (is_trained(MEANS_COLUMN)) bits = max(bits, largest_bits(d_mean));
    if (is_trained(QUATS_COLUMN)) bits = max(bits, max(largest_bits(d_quat.xyz), largest_bits(d_quat.www)));
    if (is_trained(LOG_SCALES_COLUMN)) bits = max(bits, largest_bits(d.log_scale));
    if (is_trained(RAW_OPACITIES_COLUMN)) bits = max(bits, largest_bits(vec3(d_raw_opacity)));
    [[unroll]] for (uint k = 0; k < FEATURE_COUNT; k++)
        bits = max(bits, largest_bits(vec3(record[RECORD_HEAD + 3 + k])));
    uint flags = status[3];
    if (bits >= 0x7f800000u) {
        if ((flags & ~STATUS_GRADIENT) == 0) atomicOr(status[0], STATUS_GRADIENT);
        return;
    }
    // For density control, which leaves Gaussians with frozen attributes as they are.
    if (flags == 0 && FROZEN_COLUMNS == 0) {
        float nearness = min(1.0, camera_depth(mean_in_view, camera) / damping_depth);
        float damping = damping_weight * nearness * nearness + 1.0 - damping_weight;
        grad_norm_sums[i] += damping * gradient_norm(splat.conic, d_mean2d, record[6]);
        visit_counts[i] += 1;
    }
}
