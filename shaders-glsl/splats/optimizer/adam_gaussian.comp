#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#define CAMERA_MODEL camera.model
#include "camera.glsl"
#include "rotation.glsl"
#include "sh.glsl"
#include "adam_step.glsl"

//! Adam over whole Gaussians, one thread for each; its rule is that of adam.comp.
//!
//! Of the gradients that depend on the viewing direction, `project_backward` only writes that of the colour, in place
//! of the first three of the coefficients above degree 0. The others are computed here: that of a coefficient is its
//! basis function in the direction times that of the colour, and the mean moves the direction. That is less than half
//! of the memory traffic of gradients, and one kernel instead of two reads the coefficients.
//!
//! Log scales stay within bounds whose exp is finite. Coefficients above degree 0 and moments are 32-bit floats or are
//! rounded to 16 bits by chance, which preserves the mean. Reference: `src/reference/adam_gaussian.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint  camera_index;
    uint  gaussian_count;
    uint  sh_degree;           // in use; at most SH_DEGREE. 0: coefficients above degree 0 do not change
    float second_correction;   // 1 / sqrt(1 - b2^t)
    uint  step;                // t
    float rates[PLANE_COUNT];  // learning rates / (1 - b1^t), one per plane
};

layout(constant_id = 0) const uint SH_DEGREE = 3;  // stored
layout(constant_id = 1) const uint FEATURE_COUNT = 0;
layout(constant_id = 6) const bool HALF_REST = false;  // SH above degree 0 in the format of include/half.glsl
layout(constant_id = 7) const bool HALF_MOMENTS = false;
#include "trained.glsl"

layout(binding = 0)           buffer Parameters    { float parameters[]; };      // planes
layout(binding = 1) readonly  buffer Gradients     { float gradients[]; };       // trained planes
layout(binding = 2)           buffer FirstMoments  { float first_moments[]; };   // as many; none with half moments
layout(binding = 3)           buffer SecondMoments { float second_moments[]; };  // as many; none with half moments
layout(binding = 4)           buffer BothMoments   { uint both_moments[]; };     // as many; only with half moments
layout(binding = 5) readonly  buffer Status        { uint status[]; };
layout(binding = 6) readonly  buffer Cameras       { Camera cameras[]; };

#include "rest.glsl"
#include "log_scale.glsl"

// Coefficients above degree 0 are updated four at a time, which has whole vectors: fewer registers than all at once.
const uint TOGETHER = 12;

// The values after a step with these gradients, of which `count` count; their moments, at these places, are updated.
// `chance`: random numbers for rounding the values.
vec4 stepped(vec4 value, vec4 gradient, float rate, uvec4 place, uint count, out uvec4 chance) {
    Moments moments = Moments(vec4(0.0), vec4(0.0));
    uvec4 both = uvec4(0);
    [[unroll]] for (uint k = 0; k < 4; k++) {
        if (k >= count) continue;
        if (HALF_MOMENTS) {
            both[k] = both_moments[place[k]];
        } else {
            moments.first[k] = first_moments[place[k]];
            moments.second[k] = second_moments[place[k]];
        }
    }
    if (HALF_MOMENTS) moments = from_halves(both);
    moments = updated(moments, clamp_gradient(gradient));
    if (HALF_MOMENTS) moments = flushed(moments);
    chance = chance_of(value, moments, step);
    if (HALF_MOMENTS) both = in_halves(moments, chance);
    [[unroll]] for (uint k = 0; k < 4; k++) {
        if (k >= count) continue;
        if (HALF_MOMENTS) {
            both_moments[place[k]] = both[k];
        } else {
            first_moments[place[k]] = moments.first[k];
            second_moments[place[k]] = moments.second[k];
        }
    }
    return value - adam_step(moments, vec4(rate), second_correction);
}

// Updates an attribute of up to four numbers, whose gradients are the written ones and `further`.
void update_plane(uint i, uint plane, uint column, uint width, uint first, vec3 further) {
    uint at = column * gaussian_count + width * i + first;
    uint count = min(width - first, 4);
    vec4 value = vec4(0.0), gradient = vec4(0.0);
    uvec4 place = trained_place(at) + uvec4(0, 1, 2, 3), unused_chance;
    [[unroll]] for (uint k = 0; k < 4; k++) {
        if (k >= count) continue;
        value[k] = parameters[at + k];
        gradient[k] = gradients[place[k]];
    }
    gradient.xyz += further;
    value = stepped(value, gradient, rates[plane], place, count, unused_chance);
    if (column == LOG_SCALES_COLUMN) value = clamp(value, LOG_SCALE_MIN, LOG_SCALE_MAX);
    [[unroll]] for (uint k = 0; k < 4; k++) if (k < count) parameters[at + k] = value[k];
}

// The place of word k of the coefficients above degree 0.
uint coefficient_word(uint i, uint k) {
    return rest_word(REST_COLUMN, HALF_REST ? words_of(rest_width()) : rest_width(), gaussian_count, i, k);
}

// Numbers of the coefficients above degree 0 from `first`, an even one, on, and zeros after the last.
void load_rest(uint i, uint first, out float rest[TOGETHER]) {
    uint width = rest_width();
    [[unroll]] for (uint k = 0; k < TOGETHER; k += 2) {
        uint at = first + k;
        vec2 pair = vec2(0.0);
        if (HALF_REST) {
            if (at < width) pair = unpackHalf2x16(floatBitsToUint(parameters[coefficient_word(i, at / 2)]));
        } else {
            if (at < width) pair.x = parameters[coefficient_word(i, at)];
            if (at + 1 < width) pair.y = parameters[coefficient_word(i, at + 1)];
        }
        rest[k] = pair.x;
        rest[k + 1] = pair.y;
    }
}

// Writes four of them, from an even one on, rounded to their format.
void store_rest(uint i, uint first, vec4 value, uvec4 chance) {
    uint count = min(rest_width() - first, 4);
    if (HALF_REST) {
        value = rounded_by_chance(value, chance);
        parameters[coefficient_word(i, first / 2)] = uintBitsToFloat(packHalf2x16(value.xy));
        if (count > 2) parameters[coefficient_word(i, first / 2 + 1)] = uintBitsToFloat(packHalf2x16(value.zw));
        return;
    }
    [[unroll]] for (uint k = 0; k < 4; k++) if (k < count) parameters[coefficient_word(i, first + k)] = value[k];
}

// Updates the coefficients above degree 0; returns the gradient of the mean through the viewing direction. It is finite
// where coefficients are below 1e6 and the mean is not at the camera.
vec3 update_rest(uint i) {
    Camera camera = cameras[camera_index];
    vec3 offset = offset_from_camera(LOAD_VEC3(parameters, MEANS_COLUMN, gaussian_count, i), camera.view_from_world);
    float small, distance, basis[16], d_basis[16];
    vec3 direction = direction_of(offset, small, distance);
    sh_basis(sh_degree, direction, basis);
    vec4 d_color = vec4(0.0);
    [[unroll]] for (uint c = 0; c < 3; c++)
        d_color[c] = gradients[trained_place(rest_word(REST_COLUMN, 3, gaussian_count, i, c))];
    d_color = clamp_gradient(d_color);
    [[unroll]] for (uint k = 0; k < 16; k++) d_basis[k] = 0.0;
    [[unroll]] for (uint group = 0; group < 3 * MAX_COEFFICIENTS; group += TOGETHER) {
        if (group >= rest_width()) break;
        float rest[TOGETHER];
        load_rest(i, group, rest);
        [[unroll]] for (uint k = 0; k < TOGETHER / 3; k++) {
            vec3 coefficient = vec3(rest[3 * k], rest[3 * k + 1], rest[3 * k + 2]);
            uint index = 1 + group / 3 + k;
            if (index < 16) d_basis[index] = dot(coefficient, d_color.rgb);
        }
        [[unroll]] for (uint first = 0; first < TOGETHER; first += 4) {
            if (group + first >= rest_width()) break;
            vec4 value, gradient;
            uvec4 place, chance;
            [[unroll]] for (uint k = 0; k < 4; k++) {
                uint at = group + first + k;
                value[k] = rest[first + k];
                gradient[k] = at < rest_width() ? basis[min(1 + at / 3, MAX_COEFFICIENTS - 1)] * d_color[at % 3] : 0.0;
                place[k] = trained_place(rest_word(REST_COLUMN, rest_width(), gaussian_count, i, at));
            }
            uint count = min(rest_width() - group - first, 4);
            value = stepped(value, gradient, rates[PLANE_COUNT - 1], place, count, chance);
            store_rest(i, group + first, value, chance);
        }
    }
    vec3 basis_gradient[16], d_direction = vec3(0.0);
    sh_basis_gradient(sh_degree, direction, basis_gradient);
    [[unroll]] for (uint k = 1; k < MAX_COEFFICIENTS; k++) d_direction += d_basis[k] * basis_gradient[k];
    return small * ((d_direction - direction * dot(direction, d_direction)) / distance);
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count || status[0] != 0) return;
    // Before the mean changes.
    vec3 d_mean = vec3(0.0);
    if (sh_degree > 0) d_mean = update_rest(i);
    [[unroll]] for (uint plane = 0; plane < PLANE_COUNT - 1; plane++) {
        uint column = plane_column(plane, FEATURE_COUNT, 0);
        if (!is_trained(column)) continue;
        uint width = plane + 2 == PLANE_COUNT ? FEATURE_COUNT : plane_column(plane + 1, FEATURE_COUNT, 0) - column;
        vec3 further = column == MEANS_COLUMN ? d_mean : vec3(0.0);
        [[unroll]] for (uint first = 0; first < width; first += 4)
            update_plane(i, plane, column, width, first, further);
    }
}
