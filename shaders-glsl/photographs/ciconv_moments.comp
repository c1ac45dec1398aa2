#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The mean of an image and the scale that makes its variance 1, from the partial moments of `ciconv_columns`.
//!
//! One workgroup, in a fixed order: the mean of the means, then the sum of squares about it. The variance is biased,
//! plus 1e-5, as in an instance norm. Reference: `src/reference/ciconv_moments.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint pixels_per_moment;  // except for the last, which has the rest
};

layout(binding = 0) readonly  buffer Moments { vec2 moments[]; };     // mean and sum of squares about it
layout(binding = 1) writeonly buffer Norm    { vec2 norm[]; };        // (1,), mean and 1 / sqrt(variance + 1e-5)

const float EPSILON = 1e-5;

shared float thread_sums[256];

// The sum over all threads, the same on each of them.
float total(float value) {
    uint thread = gl_LocalInvocationID.x;
    barrier();
    thread_sums[thread] = value;
    for (uint reach = 128; reach > 0; reach /= 2) {
        barrier();
        if (thread < reach) thread_sums[thread] += thread_sums[thread + reach];
    }
    barrier();
    return thread_sums[0];
}

void main() {
    uint moment_count = (pixel_count + pixels_per_moment - 1) / pixels_per_moment;
    // Relative to the first mean: sums of values far from 0 would lose the digits in which they differ.
    float pivot = moments[0].x;
    float sum = 0.0;
    for (uint i = gl_LocalInvocationID.x; i < moment_count; i += 256) {
        float count = float(min(pixels_per_moment, pixel_count - i * pixels_per_moment));
        sum += count * (moments[i].x - pivot);
    }
    float shift = total(sum) / float(pixel_count);
    float squares = 0.0;
    for (uint i = gl_LocalInvocationID.x; i < moment_count; i += 256) {
        float count = float(min(pixels_per_moment, pixel_count - i * pixels_per_moment));
        float deviation = moments[i].x - pivot - shift;
        squares += moments[i].y + count * deviation * deviation;
    }
    float variance = total(squares) / float(pixel_count);
    if (gl_LocalInvocationID.x == 0) norm[0] = vec2(pivot + shift, inversesqrt(variance + EPSILON));
}
