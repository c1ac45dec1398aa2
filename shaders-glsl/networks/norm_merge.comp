#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm.glsl"

//! Mean and 1 / sqrt(variance + 1e-5) of every channel from those of its chunks; the variance is biased: 1 / HW.
//!
//! Sum of squared deviations = sum over chunks of theirs + n (mean of chunk - mean)^2 (Chan, Golub and LeVeque 1983).
//! One subgroup per channel, in a fixed order. Reference: `src/reference/norm_merge.rs`.

layout(binding = 0) readonly  buffer Partials   { vec2 partials[]; };  // (C, chunks): mean, sum of squared deviations
layout(binding = 1) writeonly buffer Statistics { ChannelStatistics statistics[]; };

const float EPSILON = 1e-5;

float value_count(uint chunk) { return float(min(CHUNK, pixel_count - chunk * CHUNK)); }

void main() {
    uint first = CHANNEL * CHUNK_COUNT;
    float sum = 0.0;
    for (uint k = gl_SubgroupInvocationID; k < CHUNK_COUNT; k += SUBGROUP_SIZE)
        sum += value_count(k) * partials[first + k].x;
    float mean = subgroupAdd(sum) / float(pixel_count);
    float squares = 0.0;
    for (uint k = gl_SubgroupInvocationID; k < CHUNK_COUNT; k += SUBGROUP_SIZE) {
        float deviation = partials[first + k].x - mean;
        squares += partials[first + k].y + value_count(k) * deviation * deviation;
    }
    float variance = subgroupAdd(squares) / float(pixel_count);
    if (subgroupElect()) statistics[slot + CHANNEL] = ChannelStatistics(mean, 1.0 / sqrt(variance + EPSILON));
}
