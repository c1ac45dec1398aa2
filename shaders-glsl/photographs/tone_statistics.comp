#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "compensated_sum.glsl"
#include "rank_search.glsl"

//! Tone statistics: percentiles and means of one view.
//!
//! One workgroup; each thread takes every 256th partial sum, the first adds up the threads, so that the order is fixed.
//! Percentiles lie between the neighbours of their rank, linearly, plus 1e-6. What curve they make
//! of the settings is the host's to say (`tone::ToneSettings::parameters`).

layout(local_size_x = 256) in;

layout(constant_id = 0) const bool TAKES_P80 = false;

layout(push_constant) uniform Params {
    vec3 weights;      // of the upper neighbours of p10, p90 and p80
    uint pixel_count;
    uint sum_count;    // partial sums
};

struct ToneStatistics {
    float p10;
    float p80;  // 0 unless it is taken
    float p90;
    float mean_luminance;
    float mean;  // over all channels
    vec3 channel_means;
};

layout(binding = 0) readonly buffer Searches    { RankSearch searches[]; };
layout(binding = 1) readonly buffer Sums        { vec3 sums[]; };  // (sum_count)
layout(binding = 2) writeonly buffer Statistics { ToneStatistics statistics[]; };  // (1)

shared vec3 thread_sums[256];

float percentile(uint search, float weight) {
    float lower = uintBitsToFloat(searches[search].prefix);
    float upper = uintBitsToFloat(searches[search + 1].prefix);
    precise float value = lower + weight * (upper - lower) + 1e-6;
    return value;
}

void main() {
    uint thread = gl_LocalInvocationID.x;
    CompensatedSum total = CompensatedSum(vec3(0), vec3(0));
    for (uint i = thread; i < sum_count; i += gl_WorkGroupSize.x) total = add(total, sums[i]);
    thread_sums[thread] = total.sum;
    barrier();
    if (thread > 0) return;

    total = CompensatedSum(vec3(0), vec3(0));
    for (uint i = 0; i < gl_WorkGroupSize.x; ++i) total = add(total, thread_sums[i]);
    vec3 means = total.sum / float(pixel_count);
    ToneStatistics of;
    of.p10 = percentile(0, weights.x);
    of.p80 = TAKES_P80 ? percentile(4, weights.z) : 0.0;
    of.p90 = percentile(2, weights.y);
    of.mean_luminance = dot(means, vec3(0.299, 0.587, 0.114));
    of.mean = (means.r + means.g + means.b) / 3.0;
    of.channel_means = means;
    statistics[0] = of;
}
