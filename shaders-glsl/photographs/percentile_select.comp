#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "rank_search.glsl"

//! Percentile select: each search takes the digit whose bin holds its rank, and the histograms are cleared.
//!
//! One workgroup: all threads move the counts to shared memory, then one thread per search walks them.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint digit_bits;    // 11, then 10
    uint first_search;  // of the four
};

layout(binding = 0) buffer Searches   { RankSearch searches[]; };
layout(binding = 1) buffer Histograms { uint histograms[]; };  // (FIRST_BINS), then (SEARCHES, BINS)

shared uint counts[SEARCHES * BINS];
shared uint prefixes[SEARCHES];

void main() {
    uint thread = gl_LocalInvocationID.x;
    for (uint bin = thread; bin < SEARCHES * BINS; bin += gl_WorkGroupSize.x) {
        counts[bin] = histograms[bin];
        histograms[bin] = 0;
    }
    barrier();

    uint rank = 0;
    if (thread < SEARCHES) {
        RankSearch search = searches[first_search + thread];
        rank = search.rank;
        uint first = search.histogram * BINS;
        uint digit = 0;
        while (digit < (1u << digit_bits) - 1 && rank >= counts[first + digit]) {
            rank -= counts[first + digit];
            ++digit;
        }
        prefixes[thread] = search.prefix << digit_bits | digit;
    }
    barrier();

    if (thread < SEARCHES) {
        uint histogram = 0;
        while (prefixes[histogram] != prefixes[thread]) ++histogram;
        searches[first_search + thread] = RankSearch(prefixes[thread], rank, histogram);
    }
}
