#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Tone table: one thread per value looks it up among knots, with monotone cubics between them.
//!
//! The slopes at the knots are found on the host (`tone::Table`); beyond its ends a table is constant.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint view;        // the element of `parameters`
    uint knot_count;  // per channel, at least 2
};

layout(binding = 0) readonly buffer Image      { float image[]; };  // (3, H, W), sRGB
layout(binding = 1) readonly buffer Parameters { ToneParameters parameters[]; };
layout(binding = 2) readonly buffer Knots      { vec3 knots[]; };   // (3, K): x, y, slope; x ascends
layout(binding = 3) writeonly buffer Target    { float target[]; };

// The last knot of those from `first` that is not above x, which lies between the first and the last.
uint knot_below(uint first, float x) {
    uint low = first;
    uint high = first + knot_count - 1;
    while (high - low > 1) {
        uint middle = (low + high) / 2;
        if (knots[middle].x <= x) low = middle;
        else high = middle;
    }
    return low;
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= 3 * pixel_count) return;
    uint first = i / pixel_count * knot_count;
    float low = knots[first].x;
    float high = knots[first + knot_count - 1].x;
    float x = image[i] / parameters[view].white;
    // Positive phrasing: a NaN counts as the lower end.
    x = x > low ? min(x, high) : low;
    uint at = knot_below(first, x);
    vec3 left = knots[at];
    vec3 right = knots[at + 1];
    float width = right.x - left.x;
    float s = (x - left.x) / width;
    float rise = right.y - left.y;
    float a = width * left.z - rise;
    float b = rise - width * right.z;
    float y = left.y + rise * s + s * (1.0 - s) * (a * (1.0 - s) + b * s);
    target[i] = clamp(y, 0.0, 1.0);
}
