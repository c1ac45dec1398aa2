#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "splat.glsl"

//! Reduce records: one thread per depth rank sums its Gaussian's slots, in slot order.
//!
//! The same order every time gives the same bits every time.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params { uint gaussian_count; };

layout(binding = 0) readonly  buffer Counts  { uint counts[]; };  // [0]: intersections; 0 after an overflow
layout(binding = 1) readonly  buffer Ids     { uint sorted_ids[]; };
layout(binding = 2) readonly  buffer Ordered { uint ordered_counts[]; };
layout(binding = 3) readonly  buffer Offsets { uint offsets[]; };
layout(binding = 4) readonly  buffer Records { float records[]; };   // (slots, RECORD)
layout(binding = 5) writeonly buffer DSplats { float d_splats[]; };  // (gaussian_count, RECORD)

void main() {
    uint rank = THREAD_INDEX;
    if (rank >= gaussian_count) return;
    float sum[RECORD];
    for (uint k = 0; k < RECORD; k++) sum[k] = 0.0;
    uint end = offsets[rank] + ordered_counts[rank];
    if (end <= counts[0]) {
        for (uint slot = offsets[rank]; slot < end; slot++) {
            for (uint k = 0; k < RECORD; k++) sum[k] += records[RECORD * slot + k];
        }
    }
    uint id = sorted_ids[rank];
    for (uint k = 0; k < RECORD; k++) d_splats[RECORD * id + k] = sum[k];
}
