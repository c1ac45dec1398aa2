#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"
#include "norm.glsl"

//! f' = f + relu(gamma (z - mean) / deviation + beta): norm, activation and shortcut of a repeat.
//!
//! Reference: `src/reference/norm_forward.rs`.

layout(binding = 0) readonly  buffer Values     { float values[]; };
layout(binding = 1) readonly  buffer Statistics { ChannelStatistics statistics[]; };
layout(binding = 2) readonly  buffer Source     { float source[]; };    // z, (C, H, W)
layout(binding = 3) readonly  buffer Shortcut   { float shortcut[]; };  // f, (C, H, W)
layout(binding = 4) writeonly buffer Target     { float target[]; };    // f', (C, H, W)

void main() {
    float gamma = values[offset + CHANNEL];
    float beta = values[offset + channel_count + CHANNEL];
    ChannelStatistics of_channel = statistics[slot + CHANNEL];
    uint plane = CHANNEL * pixel_count;
    for (uint i = chunk_begin(); i < chunk_end(); i += SUBGROUP_SIZE) {
        float normalised = (source[plane + i] - of_channel.mean) * of_channel.inverse_deviation;
        float y = gamma * normalised + beta;
        target[plane + i] = shortcut[plane + i] + not_below_zero(y);
    }
}
