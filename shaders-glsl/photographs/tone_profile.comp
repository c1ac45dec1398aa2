#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Tone profile: one thread per pixel maps its channels as a camera profile says.
//!
//! v = 1 - exp(-x / white); u = a v + b, clamped to [0, 1]; y = s_0 + sum of s_i clamp(16 u - i + 1, 0, 1) over 16 rises
//! s_i of equal width: what `tone::Profile` is. The sum of ramps is continuous, so no rounding of u can jump.

layout(local_size_x = 256) in;

// Of equal width, of each channel.
const uint SEGMENTS = 16;
// Of a channel: three weights, a bias, the value at 0 and the rises.
const uint PROFILE_WIDTH = 5 + SEGMENTS;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint view;  // the element of `parameters`
};

layout(binding = 0) readonly buffer Image      { float image[]; };    // (3, H, W), sRGB
layout(binding = 1) readonly buffer Parameters { ToneParameters parameters[]; };
layout(binding = 2) readonly buffer Profile    { float profile[]; };  // (3, PROFILE_WIDTH)
layout(binding = 3) writeonly buffer Target    { float target[]; };

void main() {
    uint i = THREAD_INDEX;
    if (i >= pixel_count) return;
    vec3 rgb = vec3(image[i], image[pixel_count + i], image[2 * pixel_count + i]);
    // Positive phrasing: a NaN becomes black.
    vec3 known = mix(vec3(0.0), min(rgb, vec3(65504.0)), greaterThan(rgb, vec3(0.0)));
    vec3 t = known / parameters[view].white;
    vec3 v = vec3(one_minus_exp(t.r), one_minus_exp(t.g), one_minus_exp(t.b));
    for (uint channel = 0; channel < 3; ++channel) {
        uint own = PROFILE_WIDTH * channel;
        float u = profile[own] * v.r + profile[own + 1] * v.g + profile[own + 2] * v.b + profile[own + 3];
        float place = float(SEGMENTS) * clamp(u, 0.0, 1.0);
        float y = profile[own + 4];
        for (uint segment = 0; segment < SEGMENTS; ++segment) {
            y += profile[own + 5 + segment] * clamp(place - float(segment), 0.0, 1.0);
        }
        target[channel * pixel_count + i] = clamp(y, 0.0, 1.0);
    }
}
