#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm.glsl"

//! Per chunk: the sums of d_y and of d_y n, with n = (z - mean) / deviation, y = gamma n + beta, d_y = d_f' where y >
//! 0.
//!
//! They are the gradients of beta and gamma, and inputs of the gradient of z. Reference:
//! `src/reference/norm_backward_sums.rs`.

layout(binding = 0) readonly  buffer Values     { float values[]; };
layout(binding = 1) readonly  buffer Statistics { ChannelStatistics statistics[]; };
layout(binding = 2) readonly  buffer Source     { float source[]; };    // z, (C, H, W)
layout(binding = 3) readonly  buffer DTarget    { float d_target[]; };  // d_f', (C, H, W)
layout(binding = 4) writeonly buffer Partials   { vec2 partials[]; };   // (C, chunks)

void main() {
    float gamma = values[offset + CHANNEL];
    float beta = values[offset + channel_count + CHANNEL];
    ChannelStatistics of_channel = statistics[slot + CHANNEL];
    uint plane = CHANNEL * pixel_count;
    vec2 sums = vec2(0.0);
    for (uint i = chunk_begin(); i < chunk_end(); i += SUBGROUP_SIZE) {
        float normalised = (source[plane + i] - of_channel.mean) * of_channel.inverse_deviation;
        float d_y = gamma * normalised + beta > 0.0 ? d_target[plane + i] : 0.0;
        sums += d_y * vec2(1.0, normalised);
    }
    sums = subgroupAdd(sums);
    if (subgroupElect()) partials[CHANNEL * CHUNK_COUNT + gl_WorkGroupID.x] = sums;
}
