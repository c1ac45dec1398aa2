#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm.glsl"

//! Mean and sum of squared deviations of every chunk of every channel.
//!
//! Two passes over the chunk: deviations are taken from its own mean, so that no large squares cancel, and their sum
//! corrects the rounding of that mean (Chan, Golub and LeVeque 1983). `norm_merge` merges the chunks. Reference:
//! `src/reference/norm_statistics.rs`.

layout(binding = 0) readonly  buffer Source   { float source[]; };   // (C, H, W)
layout(binding = 1) writeonly buffer Partials { vec2 partials[]; };  // (C, chunks): mean, sum of squared deviations

void main() {
    uint plane = CHANNEL * pixel_count;
    uint end = chunk_end();
    float sum = 0.0;
    for (uint i = chunk_begin(); i < end; i += SUBGROUP_SIZE) sum += source[plane + i];
    float count = float(end - gl_WorkGroupID.x * CHUNK);
    float mean = subgroupAdd(sum) / count;
    vec2 deviations = vec2(0.0);  // sum, sum of squares
    for (uint i = chunk_begin(); i < end; i += SUBGROUP_SIZE) {
        float deviation = source[plane + i] - mean;
        deviations += deviation * vec2(1.0, deviation);
    }
    deviations = subgroupAdd(deviations);
    float correction = deviations.x / count;
    if (subgroupElect()) {
        partials[CHANNEL * CHUNK_COUNT + gl_WorkGroupID.x] =
            vec2(mean + correction, deviations.y - correction * deviations.x);
    }
}
