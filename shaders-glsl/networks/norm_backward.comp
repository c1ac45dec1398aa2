#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm.glsl"

//! d_z = gamma / deviation (d_y - mean of d_y - n mean of d_y n): mean and deviation depend on every z of the channel.
//!
//! n, y and d_y are those of `norm_backward_sums`. Reference: `src/reference/norm_backward.rs`.

layout(binding = 0) readonly  buffer Values     { float values[]; };
layout(binding = 1) readonly  buffer Statistics { ChannelStatistics statistics[]; };
layout(binding = 2) readonly  buffer Sums       { vec2 sums[]; };       // (C,): of d_y and of d_y n
layout(binding = 3) readonly  buffer Source     { float source[]; };    // z, (C, H, W)
layout(binding = 4) readonly  buffer DTarget    { float d_target[]; };  // d_f', (C, H, W)
layout(binding = 5) writeonly buffer DSource    { float d_source[]; };  // d_z, (C, H, W)

void main() {
    float gamma = values[offset + CHANNEL];
    float beta = values[offset + channel_count + CHANNEL];
    ChannelStatistics of_channel = statistics[slot + CHANNEL];
    vec2 means = sums[CHANNEL] / float(pixel_count);
    uint plane = CHANNEL * pixel_count;
    for (uint i = chunk_begin(); i < chunk_end(); i += SUBGROUP_SIZE) {
        float normalised = (source[plane + i] - of_channel.mean) * of_channel.inverse_deviation;
        float d_y = gamma * normalised + beta > 0.0 ? d_target[plane + i] : 0.0;
        d_source[plane + i] = gamma * of_channel.inverse_deviation * (d_y - means.x - normalised * means.y);
    }
}
