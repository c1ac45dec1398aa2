#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm_half.glsl"

//! `norm_statistics` of a packed map: mean and sum of squared deviations of every chunk of every channel.
//!
//! Reference: `src/reference/norm_statistics_half.rs`.

layout(binding = 0) readonly  buffer SourceBound { uint source_bound[]; };
layout(binding = 1) readonly  buffer Source   { uvec4 source[]; };   // z, packed
layout(binding = 2) writeonly buffer Partials { vec2 partials[]; };  // (C, chunks): mean, sum of squared deviations

void main() {
    float inverse = packed_inverse(packed_exponent(source_bound[0]));
    uint end = chunk_end(size.x * size.y);
    float mean[8], deviations[8], squares[8];
    [[unroll]] for (uint c = 0; c < 8; ++c) mean[c] = deviations[c] = squares[c] = 0.0;
    for (uint i = chunk_begin(); i < end; i += STEP) {
        float z[8] = unpacked_eight(source[eight_of(i)], inverse);
        [[unroll]] for (uint c = 0; c < 8; ++c) mean[c] += z[c];
    }
    float count = float(end - gl_WorkGroupID.x * CHUNK);
    [[unroll]] for (uint c = 0; c < 8; ++c) mean[c] = sum_of_pixels(mean[c]) / count;
    for (uint i = chunk_begin(); i < end; i += STEP) {
        float z[8] = unpacked_eight(source[eight_of(i)], inverse);
        [[unroll]] for (uint c = 0; c < 8; ++c) {
            float deviation = z[c] - mean[c];
            deviations[c] += deviation;
            squares[c] += deviation * deviation;
        }
    }
    [[unroll]] for (uint c = 0; c < 8; ++c) {
        float sum = sum_of_pixels(deviations[c]), squared = sum_of_pixels(squares[c]);
        float correction = sum / count;
        uint channel = 8 * EIGHT + c;
        if (gl_SubgroupInvocationID < PIXEL_LANES && channel < channel_count)
            partials[channel * CHUNK_COUNT + gl_WorkGroupID.x] = vec2(mean[c] + correction, squared - correction * sum);
    }
}
