#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Tone map: applies a view's curve to a whole image; a thread takes `QUADS_PER_THREAD` times four values, a workgroup
//! apart, so that it loads the curve once. Four at a time cost a software device half of what they cost one by one. Both
//! buffers end with the image: what the last quad has beyond it falls into their padding.

layout(local_size_x = 256) in;
layout(constant_id = 0) const uint QUADS_PER_THREAD = 4;

layout(push_constant) uniform Params {
    uint value_count;
    uint view;  // the element of `parameters`
};

layout(binding = 0) readonly buffer Image      { vec4 image[]; };  // (3, H, W), sRGB
layout(binding = 1) readonly buffer Parameters { ToneParameters parameters[]; };
layout(binding = 2) writeonly buffer Target    { vec4 target[]; };

void main() {
    ToneParameters tone = parameters[view];
    uint first = WORKGROUP_INDEX * gl_WorkGroupSize.x * QUADS_PER_THREAD + gl_LocalInvocationID.x;
    for (uint k = 0; k < QUADS_PER_THREAD; ++k) {
        uint quad = first + k * gl_WorkGroupSize.x;
        if (4 * quad >= value_count) return;
        vec4 x = image[quad];
        target[quad] = vec4(tone_curve(x.x, tone), tone_curve(x.y, tone), tone_curve(x.z, tone), tone_curve(x.w, tone));
    }
}
