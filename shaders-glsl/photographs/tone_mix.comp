#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Tone mix: one thread per pixel applies a curve whose channels depend on more than their own value.
//!
//! `lum_preserve` scales a pixel by what its luminance gains, `per_channel` each channel by its own white. `auto` mixes the
//! curve of each channel with the curve of the luminance, which keeps the ratios of the channels.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint view;  // the element of `parameters`
};

layout(binding = 0) readonly buffer Image      { float image[]; };  // (3, H, W), sRGB
layout(binding = 1) readonly buffer Parameters { ToneParameters parameters[]; };
layout(binding = 2) writeonly buffer Target    { float target[]; };

// Of values and luminance in units of white; constants[0] is lambda. At black the factor of the luminance's curve is 1.
vec3 automatic(vec3 t, float y, ToneParameters tone) {
    float least = max(y, 1e-20);
    float factor = one_minus_exp(least) / least;
    vec3 own = vec3(one_minus_exp(t.r), one_minus_exp(t.g), one_minus_exp(t.b));
    float share = tone.constants[0];
    return tone.offset + (1.0 - tone.offset) * ((1.0 - share) * own + share * (t * factor));
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= pixel_count) return;
    ToneParameters tone = parameters[view];
    vec3 rgb = vec3(image[i], image[pixel_count + i], image[2 * pixel_count + i]);
    // Positive phrasing: a NaN becomes black.
    vec3 known = mix(vec3(0.0), min(rgb, vec3(65504.0)), greaterThan(rgb, vec3(0.0)));
    float y = 0.299 * known.r + 0.587 * known.g + 0.114 * known.b;
    vec3 scale = vec3(y * tone.gain / (y + 1e-6));
    uint curve = TONE_CURVE;
    if (curve == CURVE_PER_CHANNEL) scale = 1.0 / vec3(tone.constants[0], tone.constants[1], tone.constants[2]);
    vec3 mapped = known * scale;
    if (curve == CURVE_AUTO) mapped = automatic(known / tone.white, y / tone.white, tone);
    mapped = min(mapped, vec3(1.0));
    target[i] = mapped.r;
    target[pixel_count + i] = mapped.g;
    target[2 * pixel_count + i] = mapped.b;
}
