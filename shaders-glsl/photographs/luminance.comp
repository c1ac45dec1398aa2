#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "compensated_sum.glsl"
#include "rank_search.glsl"

//! Luminance: BT.601 on encoded values, per pixel, with partial sums of the channels and the first digit's histogram.
//!
//! A workgroup takes a run of pixels and each of its threads every 256th of them, so that the order of every sum is
//! fixed; counts are integers, so theirs does not matter. NaN and negative values count as 0, values above 65504 as 65504.
//! `histograms` must be zero before.

layout(local_size_x = WORKGROUP) in;

layout(push_constant) uniform Params {
    uvec4 ranks;        // of the four searches
    uint pixel_count;
    uint thread_count;
    uint first_search;  // of the four
    uint first_sum;     // of the threads'
};

layout(binding = 0) readonly buffer Image       { float image[]; };      // (3, H, W), sRGB
layout(binding = 1) writeonly buffer Luminances { float luminances[]; }; // (H, W)
layout(binding = 2) writeonly buffer Sums       { vec3 sums[]; };        // (threads) red, green, blue
layout(binding = 3) writeonly buffer Searches   { RankSearch searches[]; };
layout(binding = 4) buffer Histograms           { uint histograms[]; };  // (FIRST_BINS)

shared uint counts[FIRST_BINS];

// Positive phrasing: a NaN fails it too.
float measurable(float x) {
    return x > 0.0 ? min(x, 65504.0) : 0.0;
}

void main() {
    uint thread = THREAD_INDEX;
    if (thread < SEARCHES) searches[first_search + thread] = RankSearch(0, ranks[thread], 0);
    for (uint bin = gl_LocalInvocationID.x; bin < FIRST_BINS; bin += WORKGROUP) counts[bin] = 0;
    barrier();

    CompensatedSum total = CompensatedSum(vec3(0), vec3(0));
    Run run = run_of_workgroup(thread / WORKGROUP, thread_count / WORKGROUP, pixel_count);
    for (uint i = run.first + gl_LocalInvocationID.x; i < run.end; i += WORKGROUP) {
        vec3 rgb = vec3(measurable(image[i]), measurable(image[pixel_count + i]), measurable(image[2 * pixel_count + i]));
        // `precise`: a fused multiply-add would move a percentile by an ulp between devices.
        precise float luminance = 0.299 * rgb.r + 0.587 * rgb.g + 0.114 * rgb.b;
        luminances[i] = luminance;
        total = add(total, rgb);
        atomicAdd(counts[floatBitsToUint(luminance) >> FIRST_SHIFT], 1);
    }
    sums[first_sum + thread] = total.sum;
    barrier();

    for (uint bin = gl_LocalInvocationID.x; bin < FIRST_BINS; bin += WORKGROUP) {
        if (counts[bin] > 0) atomicAdd(histograms[bin], counts[bin]);
    }
}
