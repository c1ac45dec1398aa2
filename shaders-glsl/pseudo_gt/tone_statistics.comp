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
    vec3 weights;        // of the upper neighbours of p10, p90 and p80
    uint view;           // the element of `parameters` that is written
    uint pixel_count;
    uint sum_count;      // partial sums
    float gain_c;
    float theta;
    float alpha;
    float beta;
    float least_gain;    // g0 where black is rescaled, 1 where it is added
    float constants[8];  // of the family
};

struct ToneStatistics {
    float p10;
    float p80;  // 0 but for the curve that takes it
    float p90;
    float mean_luminance;
    float mean;  // over all channels
    vec3 channel_means;
};

layout(binding = 0) readonly buffer Searches    { RankSearch searches[]; };
layout(binding = 1) readonly buffer Sums        { vec3 sums[]; };  // (sum_count)
layout(binding = 2) writeonly buffer Statistics { ToneStatistics statistics[]; };  // (1)
layout(binding = 3) writeonly buffer Parameters { ToneParameters parameters[]; };

shared vec3 thread_sums[256];

float percentile(uint search, float weight) {
    float lower = uintBitsToFloat(searches[search].prefix);
    float upper = uintBitsToFloat(searches[search + 1].prefix);
    precise float value = lower + weight * (upper - lower) + 1e-6;
    return value;
}

// theta / value, from 1 to 6.
float bounded_gain(float value) {
    return clamp(theta / value, 1.0, 6.0);
}

ToneParameters curve_of(ToneStatistics of) {
    ToneParameters tone = ToneParameters(1.0, 0.0, 1.0, constants);
    switch (TONE_CURVE) {
    case CURVE_NONE:
        break;
    case CURVE_LINEAR:
        // The floor keeps a black photograph black.
        tone.white = max(of.mean / theta, 1e-12);
        break;
    case CURVE_P80:
        tone.white = 1.0 / bounded_gain(of.p80);
        break;
    case CURVE_LUM_PRESERVE:
        tone.gain = bounded_gain(of.mean_luminance + 1e-6);
        break;
    case CURVE_PER_CHANNEL:
        [[unroll]] for (uint c = 0; c < 3; ++c) tone.constants[c] = (of.channel_means[c] + 1e-6) / theta;
        break;
    default:
        float crushed = 1.0 - clamp(of.p10 / of.p90, 0.0, 1.0);
        tone.white = of.p90;
        // beta 0 is a fixed black level, also where nothing is crushed.
        tone.offset = beta > 0.0 ? alpha * power(crushed, beta) : alpha;
        tone.gain = least_gain + gain_c * of.mean_luminance;
    }
    return tone;
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
    uint curve = TONE_CURVE;
    ToneStatistics of;
    of.p10 = percentile(0, weights.x);
    of.p80 = curve == CURVE_P80 ? percentile(4, weights.z) : 0.0;
    of.p90 = percentile(2, weights.y);
    of.mean_luminance = dot(means, vec3(0.299, 0.587, 0.114));
    of.mean = (means.r + means.g + means.b) / 3.0;
    of.channel_means = means;
    statistics[0] = of;
    parameters[view] = curve_of(of);
}
