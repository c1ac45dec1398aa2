#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "adam_step.glsl"
#include "log_scale.glsl"

//! Adam over the planes of include/gaussian.glsl: beta 0.9 and 0.999, epsilon 1e-15.
//!
//! m = b1 m + (1 - b1) g, v = b2 v + (1 - b2) g^2, p -= rate / (1 - b1^t) m / (sqrt(v) / sqrt(1 - b2^t) + epsilon). A
//! thread processes four consecutive floats, of one plane or of two. A gradient that is not finite counts as zero, so
//! that it corrupts neither moment; log scales stay within bounds whose exp is finite. Nothing changes while status[0]
//! is set. Kingma and Ba 2015. Reference: `src/reference/adam.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  column_count;         // updated columns, from the first
    uint  feature_count;        // of these, from FEATURES_COLUMN on
    float second_correction;    // 1 / sqrt(1 - b2^t)
    float rates[PLANE_COUNT];   // learning rates / (1 - b1^t), one per plane
};

#include "trained.glsl"

layout(binding = 0)           buffer Parameters    { vec4 parameters[]; };      // planes
layout(binding = 1) readonly  buffer Gradients     { vec4 gradients[]; };       // trained planes
layout(binding = 2)           buffer FirstMoments  { vec4 first_moments[]; };   // as many
layout(binding = 3)           buffer SecondMoments { vec4 second_moments[]; };  // as many
layout(binding = 4) readonly  buffer Status        { uint status[]; };

// The learning rates of the floats at `i`.
vec4 rates_at(uvec4 i) {
    vec4 rate = vec4(rates[0]);
    [[unroll]] for (uint plane = 1; plane < PLANE_COUNT; ++plane) {
        uint begin = plane_column(plane, feature_count, column_count) * gaussian_count;
        rate = mix(rate, vec4(rates[plane]), greaterThanEqual(i, uvec4(begin)));
    }
    return rate;
}

void main() {
    uint begin = FROZEN_COLUMNS * gaussian_count;
    uint trained = THREAD_INDEX, quad = frozen_quads() + trained;
    uint end = column_count * gaussian_count;
    if (4 * quad >= end || status[0] != 0) return;
    uvec4 i = 4 * quad + uvec4(0, 1, 2, 3);
    // The first and the last quad can extend into a column that is not updated. Unsigned: before `begin`, it wraps.
    bvec4 takes_part = lessThan(i - begin, uvec4(end - begin));
    vec4 gradient = clamp_gradient(gradients[trained]);
    Moments moments = updated(Moments(first_moments[trained], second_moments[trained]), gradient);
    vec4 before = parameters[quad];
    vec4 value = before - adam_step(moments, rates_at(i), second_correction);
    // Unsigned: values before the plane wrap beyond its end.
    bvec4 is_log_scale = lessThan(i - LOG_SCALES_COLUMN * gaussian_count, uvec4(3 * gaussian_count));
    value = mix(value, clamp(value, LOG_SCALE_MIN, LOG_SCALE_MAX), is_log_scale);
    parameters[quad] = mix(before, value, takes_part);
    first_moments[trained] = mix(first_moments[trained], moments.first, takes_part);
    second_moments[trained] = mix(second_moments[trained], moments.second, takes_part);
}
