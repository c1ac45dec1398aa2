#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "compensated_sum.glsl"
#include "rank_search.glsl"
#include "tone.glsl"

//! Tone statistics: percentiles and means of one view, and the curve that the settings give it.
//!
//! One workgroup; each thread takes every 256th partial sum, the first adds up the threads, so that the order is fixed.
//! Percentiles lie between the neighbours of their rank, linearly, plus 1e-6. The law is `tone::ToneSettings::parameters`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    vec2 weights;       // of the upper neighbours of p10 and p90
    uint view;          // the element of `parameters` that is written
    uint pixel_count;
    uint thread_count;  // partial sums
    float gain_c;
    float theta;
    float alpha;
    float beta;
    float base_gain;    // g0
};

struct ToneStatistics {
    float p10;
    float p90;
    float mean_luminance;
    float mean;  // over all channels
};

layout(binding = 0) readonly buffer Searches    { RankSearch searches[]; };
layout(binding = 1) readonly buffer Sums        { vec2 sums[]; };  // (thread_count)
layout(binding = 2) writeonly buffer Statistics { ToneStatistics statistics[]; };  // (1)
layout(binding = 3) writeonly buffer Parameters { ToneParameters parameters[]; };

shared vec2 thread_sums[256];

float percentile(uint search, float weight) {
    float lower = uintBitsToFloat(searches[search].prefix);
    float upper = uintBitsToFloat(searches[search + 1].prefix);
    precise float value = lower + weight * (upper - lower) + 1e-6;
    return value;
}

ToneParameters curve_of(ToneStatistics of) {
    if (TONE_CURVE == CURVE_NONE) return ToneParameters(1.0, 0.0, 1.0);
    // The floor keeps a black photograph black.
    if (TONE_CURVE == CURVE_LINEAR) return ToneParameters(max(of.mean / theta, 1e-12), 0.0, 1.0);
    float crushed = 1.0 - clamp(of.p10 / of.p90, 0.0, 1.0);
    // pow(0, beta) may be computed as exp2(beta * -inf), and is 1 where beta is 0.
    float offset = crushed > 0.0 ? alpha * pow(crushed, beta) : beta > 0.0 ? 0.0 : alpha;
    float base = TONE_CURVE == CURVE_ASE ? base_gain : 1.0;
    return ToneParameters(of.p90, offset, base + gain_c * of.mean_luminance);
}

void main() {
    uint thread = gl_LocalInvocationID.x;
    CompensatedSum total = CompensatedSum(vec2(0), vec2(0));
    for (uint i = thread; i < thread_count; i += gl_WorkGroupSize.x) total = add(total, sums[i]);
    thread_sums[thread] = total.sum;
    barrier();
    if (thread > 0) return;

    total = CompensatedSum(vec2(0), vec2(0));
    for (uint i = 0; i < gl_WorkGroupSize.x; ++i) total = add(total, thread_sums[i]);
    vec2 mean = total.sum / float(pixel_count);
    ToneStatistics of = ToneStatistics(percentile(0, weights.x), percentile(2, weights.y), mean.x, mean.y / 3.0);
    statistics[0] = of;
    parameters[view] = curve_of(of);
}
