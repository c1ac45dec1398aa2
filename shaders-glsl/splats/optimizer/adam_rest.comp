#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "adam_step.glsl"
#include "half.glsl"
#include "rest_layout.glsl"

//! Adam over SH coefficients above degree 0 that are stored as 16-bit floats (include/half.glsl), otherwise as
//! adam.comp.
//!
//! A thread processes four coefficients of a Gaussian. They are updated as floats and then rounded stochastically,
//! which preserves the mean. Reference: `src/reference/adam_rest.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint  gaussian_count;
    uint  first_column;       // columns before the coefficients
    uint  coefficient_count;  // of each Gaussian
    float rate;               // learning rate / (1 - b1^t)
    float second_correction;  // 1 / sqrt(1 - b2^t)
    uint  step;               // t
};

layout(constant_id = 0) const bool HALF_MOMENTS = false;
#include "trained.glsl"

layout(binding = 0)           buffer Parameters    { uint parameters[]; };       // planes, halves after first_column
layout(binding = 1) readonly  buffer Gradients     { float gradients[]; };       // trained planes
layout(binding = 2)           buffer FirstMoments  { float first_moments[]; };   // as many; none with half moments
layout(binding = 3)           buffer SecondMoments { float second_moments[]; };  // as many
layout(binding = 4)           buffer BothMoments   { uint both_moments[]; };     // as many; only with half moments
layout(binding = 5) readonly  buffer Status        { uint status[]; };

// The two halves of a word, or zero beyond a Gaussian's.
vec2 halves_at(uint word, bool takes_part) {
    return takes_part ? unpackHalf2x16(parameters[word]) : vec2(0.0);
}

void main() {
    uint quads = (coefficient_count + 3) / 4;
    if (THREAD_INDEX >= gaussian_count * quads || status[0] != 0) return;
    uint i = REST_BY_COLUMN ? THREAD_INDEX % gaussian_count : THREAD_INDEX / quads;
    uint first = 4 * (REST_BY_COLUMN ? THREAD_INDEX / gaussian_count : THREAD_INDEX % quads);
    uint count = min(coefficient_count - first, 4);
    uint at = trained_place(rest_word(first_column, coefficient_count, gaussian_count, i, first));
    uint word = rest_word(first_column, words_of(coefficient_count), gaussian_count, i, first / 2);
    uint next = REST_BY_COLUMN ? gaussian_count : 1;  // from a word of a Gaussian to the next

    vec4 gradient = vec4(0.0);
    Moments moments = Moments(vec4(0.0), vec4(0.0));
    uvec4 both = uvec4(0);
    [[unroll]] for (uint k = 0; k < 4; ++k) {
        if (k >= count) continue;
        gradient[k] = gradients[at + k * next];
        if (HALF_MOMENTS) {
            both[k] = both_moments[at + k * next];
        } else {
            moments.first[k] = first_moments[at + k * next];
            moments.second[k] = second_moments[at + k * next];
        }
    }
    if (HALF_MOMENTS) moments = from_halves(both);
    moments = updated(moments, clamp_gradient(gradient));
    if (HALF_MOMENTS) moments = flushed(moments);

    vec4 value = vec4(halves_at(word, true), halves_at(word + next, count > 2));
    uvec4 chance = chance_of(value, moments, step);
    value -= adam_step(moments, vec4(rate), second_correction);
    value = rounded_by_chance(value, chance);
    parameters[word] = packHalf2x16(value.xy);
    if (count > 2) parameters[word + next] = packHalf2x16(value.zw);
    if (HALF_MOMENTS) both = in_halves(moments, chance);
    [[unroll]] for (uint k = 0; k < 4; ++k) {
        if (k >= count) continue;
        if (HALF_MOMENTS) {
            both_moments[at + k * next] = both[k];
        } else {
            first_moments[at + k * next] = moments.first[k];
            second_moments[at + k * next] = moments.second[k];
        }
    }
}
