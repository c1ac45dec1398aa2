#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "rank_search.glsl"

//! Luminance histogram: counts the second or third digit of the luminances that begin with a search's prefix.
//!
//! A workgroup takes a run of pixels, a thread four neighbours at a time, and counts in shared memory first. Counts are
//! integers, so their order does not matter. `histograms` must be zero before.

layout(local_size_x = WORKGROUP) in;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint thread_count;
    uint shift;         // of the digit: 10, then 0
    uint first_search;  // of the four
};

layout(binding = 0) readonly buffer Luminances { vec4 luminances[]; };  // (H, W)
layout(binding = 1) readonly buffer Searches   { RankSearch searches[]; };
layout(binding = 2) buffer Histograms          { uint histograms[]; };  // (SEARCHES, BINS)

shared uint counts[SEARCHES * BINS];

void main() {
    for (uint bin = gl_LocalInvocationID.x; bin < SEARCHES * BINS; bin += WORKGROUP) counts[bin] = 0;
    RankSearch search[SEARCHES];
    [[unroll]] for (uint s = 0; s < SEARCHES; ++s) search[s] = searches[first_search + s];
    barrier();

    Run run = run_of_workgroup(WORKGROUP_INDEX, thread_count / WORKGROUP, pixel_count);
    // An empty run begins behind the last pixel, within its quad.
    for (uint quad = (run.first + 3) / 4 + gl_LocalInvocationID.x; 4 * quad < run.end; quad += WORKGROUP) {
        uvec4 digits = floatBitsToUint(luminances[quad]) >> shift;
        [[unroll]] for (uint c = 0; c < 4; ++c) {
            uint histogram = SEARCHES;
            [[unroll]] for (uint s = 0; s < SEARCHES; ++s) {
                if (digits[c] >> DIGIT_BITS == search[s].prefix) histogram = search[s].histogram;
            }
            bool counts_it = histogram < SEARCHES && 4 * quad + c < run.end;
            if (counts_it) atomicAdd(counts[histogram * BINS + digits[c] % BINS], 1);
        }
    }
    barrier();

    for (uint bin = gl_LocalInvocationID.x; bin < SEARCHES * BINS; bin += WORKGROUP) {
        if (counts[bin] > 0) atomicAdd(histograms[bin], counts[bin]);
    }
}
