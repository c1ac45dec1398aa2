#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "rank_search.glsl"

//! Percentile select: each search takes the digit whose bin holds its rank, and the histograms are cleared.
//!
//! One workgroup; one thread per search, then all threads clear.

layout(local_size_x = 256) in;

layout(binding = 0) buffer Searches   { RankSearch searches[]; };
layout(binding = 1) buffer Histograms { uint histograms[]; };  // (SEARCHES, BINS)

shared uint prefixes[SEARCHES];

void main() {
    uint thread = gl_LocalInvocationID.x;
    uint rank = 0;
    if (thread < SEARCHES) {
        RankSearch search = searches[thread];
        rank = search.rank;
        uint first = search.histogram * BINS;
        uint digit = 0;
        while (digit < BINS - 1 && rank >= histograms[first + digit]) {
            rank -= histograms[first + digit];
            ++digit;
        }
        prefixes[thread] = search.prefix << 8 | digit;
    }
    barrier();

    if (thread < SEARCHES) {
        uint histogram = 0;
        while (prefixes[histogram] != prefixes[thread]) ++histogram;
        searches[thread] = RankSearch(prefixes[thread], rank, histogram);
    }
    for (uint bin = thread; bin < SEARCHES * BINS; bin += gl_WorkGroupSize.x) histograms[bin] = 0;
}
