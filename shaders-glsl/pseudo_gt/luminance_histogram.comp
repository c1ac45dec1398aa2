#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "rank_search.glsl"

//! Luminance histogram: counts the second or third digit of the luminances that begin with a search's prefix.
//!
//! A workgroup takes a run of pixels and counts in shared memory first. Counts are integers, so their order does not matter. `histograms` must be zero before.

layout(local_size_x = WORKGROUP) in;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint thread_count;
    uint shift;         // of the digit: 10, then 0
    uint first_search;  // of the four
};

layout(binding = 0) readonly buffer Luminances { float luminances[]; };
layout(binding = 1) readonly buffer Searches   { RankSearch searches[]; };
layout(binding = 2) buffer Histograms          { uint histograms[]; };  // (SEARCHES, BINS)

shared uint counts[SEARCHES * BINS];

void main() {
    for (uint bin = gl_LocalInvocationID.x; bin < SEARCHES * BINS; bin += WORKGROUP) counts[bin] = 0;
    RankSearch search[SEARCHES];
    [[unroll]] for (uint s = 0; s < SEARCHES; ++s) search[s] = searches[first_search + s];
    barrier();

    Run run = run_of_workgroup(WORKGROUP_INDEX, thread_count / WORKGROUP, pixel_count);
    for (uint i = run.first + gl_LocalInvocationID.x; i < run.end; i += WORKGROUP) {
        uint digits = floatBitsToUint(luminances[i]) >> shift;
        uint histogram = SEARCHES;
        [[unroll]] for (uint s = 0; s < SEARCHES; ++s) {
            if (digits >> DIGIT_BITS == search[s].prefix) histogram = search[s].histogram;
        }
        if (histogram < SEARCHES) atomicAdd(counts[histogram * BINS + digits % BINS], 1);
    }
    barrier();

    for (uint bin = gl_LocalInvocationID.x; bin < SEARCHES * BINS; bin += WORKGROUP) {
        if (counts[bin] > 0) atomicAdd(histograms[bin], counts[bin]);
    }
}
