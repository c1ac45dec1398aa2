#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Tone map: one thread per value applies a view's curve to a whole image.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;
    uint view;  // the element of `parameters`
};

layout(binding = 0) readonly buffer Image      { float image[]; };  // (3, H, W), sRGB
layout(binding = 1) readonly buffer Parameters { ToneParameters parameters[]; };
layout(binding = 2) writeonly buffer Target    { float target[]; };

void main() {
    uint i = THREAD_INDEX;
    if (i < value_count) target[i] = tone_curve(image[i], parameters[view]);
}
