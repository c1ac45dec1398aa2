#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Tone map: applies a view's curve to a whole image; a thread takes `VALUES_PER_THREAD` values, a workgroup apart, so
//! that it loads the curve once.

layout(local_size_x = 256) in;
layout(constant_id = 0) const uint VALUES_PER_THREAD = 16;

layout(push_constant) uniform Params {
    uint value_count;
    uint view;  // the element of `parameters`
};

layout(binding = 0) readonly buffer Image      { float image[]; };  // (3, H, W), sRGB
layout(binding = 1) readonly buffer Parameters { ToneParameters parameters[]; };
layout(binding = 2) writeonly buffer Target    { float target[]; };

void main() {
    ToneParameters tone = parameters[view];
    uint first = WORKGROUP_INDEX * gl_WorkGroupSize.x * VALUES_PER_THREAD + gl_LocalInvocationID.x;
    for (uint k = 0; k < VALUES_PER_THREAD; ++k) {
        uint i = first + k * gl_WorkGroupSize.x;
        if (i < value_count) target[i] = tone_curve(image[i], tone);
    }
}
