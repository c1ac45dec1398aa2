#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm.glsl"

//! Mean and sum of squared deviations of every chunk of every channel.
//!
//! Two passes over the chunk: deviations are taken from its own mean, so that no large squares cancel.
//! `norm_merge` merges the chunks. Reference: `src/reference/norm_statistics.rs`.

layout(binding = 0) readonly  buffer Source   { float source[]; };   // (C, H, W)
layout(binding = 1) writeonly buffer Partials { vec2 partials[]; };  // (C, chunks): mean, sum of squared deviations

void main() {
    uint plane = CHANNEL * pixel_count;
    uint end = chunk_end();
    float sum = 0.0;
    for (uint i = chunk_begin(); i < end; i += SUBGROUP_SIZE) sum += source[plane + i];
    float mean = subgroupAdd(sum) / float(end - gl_WorkGroupID.x * CHUNK);
    float squares = 0.0;
    for (uint i = chunk_begin(); i < end; i += SUBGROUP_SIZE) {
        float deviation = source[plane + i] - mean;
        squares += deviation * deviation;
    }
    squares = subgroupAdd(squares);
    if (subgroupElect()) partials[CHANNEL * CHUNK_COUNT + gl_WorkGroupID.x] = vec2(mean, squares);
}
