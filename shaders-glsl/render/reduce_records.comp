#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "splat.glsl"
#include "shared_slots.glsl"

//! Reduce records: one lane per Gaussian sums its slots, in slot order.
//!
//! The lanes share the slots of a Gaussian that has many: each sums every SUBGROUP_SIZE-th, then a tree the lanes. The
//! same order every time gives the same bits every time.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params { uint gaussian_count; };

layout(binding = 0) readonly  buffer Emitted { uvec2 emitted[]; };   // first slot, one past the last
layout(binding = 1) readonly  buffer Records { float records[]; };   // (slots, RECORD)
layout(binding = 2) writeonly buffer DSplats { float d_splats[]; };  // (gaussian_count, RECORD)

void main() {
    uint i = THREAD_INDEX;
    uvec2 range = i < gaussian_count ? emitted[i] : uvec2(0);
    bool is_shared = range.y - range.x > SHARED_SLOTS;

    float sum[RECORD];
    [[unroll]] for (uint k = 0; k < RECORD; k++) sum[k] = 0.0;
    for (uint slot = range.x; slot < range.y && !is_shared; slot++) {
        [[unroll]] for (uint k = 0; k < RECORD; k++) sum[k] += records[RECORD * slot + k];
    }
    uvec4 sharing = subgroupBallot(is_shared);
    while (any(notEqual(sharing, uvec4(0)))) {
        uint lane = subgroupBallotFindLSB(sharing);
        sharing[lane / 32] &= sharing[lane / 32] - 1;
        uvec2 shared_range = subgroupShuffle(range, lane);
        float part[RECORD];
        [[unroll]] for (uint k = 0; k < RECORD; k++) part[k] = 0.0;
        for (uint slot = shared_range.x + gl_SubgroupInvocationID; slot < shared_range.y; slot += SUBGROUP_SIZE) {
            [[unroll]] for (uint k = 0; k < RECORD; k++) part[k] += records[RECORD * slot + k];
        }
        [[unroll]] for (uint k = 0; k < RECORD; k++) {
            float of_all = subgroupAdd(part[k]);
            if (gl_SubgroupInvocationID == lane) sum[k] = of_all;
        }
    }
    if (i < gaussian_count) {
        [[unroll]] for (uint k = 0; k < RECORD; k++) d_splats[RECORD * i + k] = sum[k];
    }
}
