#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#define CAMERA_MODEL camera.model
#include "camera.glsl"
#include "rotation.glsl"
#include "sh.glsl"
#include "adam_step.glsl"

//! Adam over whole Gaussians, one thread for each, with the numbers and the bits of adam.comp.
//!
//! The gradient of an SH coefficient is its basis function in the viewing direction times the gradient of the colour.
//! It is computed here: `project_backward` only writes the three numbers of the colour, in place of the first ones of
//! the coefficients above degree 0. On a GPU that is less than half of the memory traffic of gradients. All numbers are
//! 32-bit floats. Reference: `src/reference/adam_gaussian.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  camera_index;
    uint  gaussian_count;
    uint  sh_degree;          // in use; at most SH_DEGREE. 0: coefficients above degree 0 do not change
    float second_correction;  // 1 / sqrt(1 - b2^t)
    float rates[PLANE_COUNT];  // learning rates / (1 - b1^t), one per plane
};

layout(constant_id = 0) const uint SH_DEGREE = 3;  // stored
layout(constant_id = 1) const uint FEATURE_COUNT = 0;
const bool HALF_REST = false;
#include "trained.glsl"

layout(binding = 0)           buffer Parameters    { float parameters[]; };      // planes
layout(binding = 1) readonly  buffer Gradients     { float gradients[]; };       // trained planes
layout(binding = 2)           buffer FirstMoments  { float first_moments[]; };   // as many
layout(binding = 3)           buffer SecondMoments { float second_moments[]; };  // as many
layout(binding = 4) readonly  buffer Status        { uint status[]; };
layout(binding = 5) readonly  buffer Cameras       { Camera cameras[]; };

#include "rest.glsl"
#include "log_scale.glsl"

// Updates the parameters at four places; `count` of them count.
void update(uvec4 at, uint count, vec4 gradient, vec4 rate, bool is_log_scale) {
    vec4 value, first, second;
    [[unroll]] for (uint k = 0; k < 4; k++) {
        uint index = k < count ? at[k] : at[0];
        value[k] = parameters[index];
        first[k] = first_moments[trained_place(index)];
        second[k] = second_moments[trained_place(index)];
    }
    Moments moments = updated(Moments(first, second), clamp_gradient(gradient));
    value -= adam_step(moments, rate, second_correction);
    if (is_log_scale) value = clamp(value, LOG_SCALE_MIN, LOG_SCALE_MAX);
    [[unroll]] for (uint k = 0; k < 4; k++) {
        if (k >= count) continue;
        parameters[at[k]] = value[k];
        first_moments[trained_place(at[k])] = moments.first[k];
        second_moments[trained_place(at[k])] = moments.second[k];
    }
}

// Updates an attribute of up to four numbers whose gradients are written.
void update_plane(uint i, uint plane, uint column, uint width, uint first) {
    uint at = column * gaussian_count + width * i + first;
    uint count = min(width - first, 4);
    vec4 gradient = vec4(0.0);
    [[unroll]] for (uint k = 0; k < 4; k++) if (k < count) gradient[k] = gradients[trained_place(at + k)];
    update(at + uvec4(0, 1, 2, 3), count, gradient, vec4(rates[plane]), column == LOG_SCALES_COLUMN);
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count || status[0] != 0) return;
    // Before the mean changes.
    Camera camera = cameras[camera_index];
    vec3 mean = LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i);
    vec3 offset = offset_from_camera(mean, camera.view_from_world);
    [[unroll]] for (uint plane = 0; plane < PLANE_COUNT - 1; plane++) {
        uint column = plane_column(plane, FEATURE_COUNT, 0);
        if (!is_trained(column)) continue;
        uint width = plane + 2 == PLANE_COUNT ? FEATURE_COUNT : plane_column(plane + 1, FEATURE_COUNT, 0) - column;
        [[unroll]] for (uint first = 0; first < width; first += 4) update_plane(i, plane, column, width, first);
    }
    if (sh_degree == 0) return;

    float unused_scale, unused_distance, basis[16];
    sh_basis(sh_degree, direction_of(offset, unused_scale, unused_distance), basis);
    vec3 d_color;
    for (uint c = 0; c < 3; c++) {
        d_color[c] = gradients[trained_place(rest_word(REST_COLUMN, rest_width(), gaussian_count, i, c))];
    }
    [[unroll]] for (uint first = 0; first < 3 * (MAX_COEFFICIENTS - 1); first += 4) {
        if (first >= rest_width()) break;
        uvec4 at;
        vec4 gradient;
        [[unroll]] for (uint k = 0; k < 4; k++) {
            at[k] = rest_word(REST_COLUMN, rest_width(), gaussian_count, i, first + k);
            uint coefficient = min(1 + (first + k) / 3, MAX_COEFFICIENTS - 1);
            gradient[k] = basis[coefficient] * d_color[(first + k) % 3];
        }
        update(at, min(rest_width() - first, 4), gradient, vec4(rates[PLANE_COUNT - 1]), false);
    }
}
