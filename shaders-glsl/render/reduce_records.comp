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
#include "subgroup_sum.glsl"

layout(push_constant) uniform Params { uint gaussian_count; };

layout(binding = 0) readonly  buffer Emitted { uvec2 emitted[]; };   // first slot, one past the last
layout(binding = 1) readonly  buffer Records { vec3 records[]; };    // (slots, RECORD_VECTORS)
layout(binding = 2) writeonly buffer DSplats { vec3 d_splats[]; };   // (gaussian_count, RECORD_VECTORS)

void main() {
    uint i = THREAD_INDEX;
    uint lane = gl_SubgroupInvocationID;
    uvec2 range = i < gaussian_count ? emitted[i] : uvec2(0);
    bool is_shared = range.y - range.x > SHARED_SLOTS;
    uvec4 sharing = subgroupBallot(is_shared);

    // First every lane its own slots, then all together those that are shared: in one loop, for a device that does not
    // jump over branches pays for a second one even where nothing is shared.
    uvec2 walked = is_shared ? uvec2(0) : range;
    uint owner = lane, stride = 1;
    vec3 sum[RECORD_VECTORS];
    while (true) {
        vec3 part[RECORD_VECTORS];
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) part[k] = vec3(0.0);
        for (uint slot = walked.x; slot < walked.y; slot += stride) {
            [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) part[k] += records[RECORD_VECTORS * slot + k];
        }
        bool is_alone = stride == 1;
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) {
            vec3 of_all = subgroup_sum(part[k]);
            if (owner == lane) sum[k] = is_alone ? part[k] : of_all;
        }
        if (all(equal(sharing, uvec4(0)))) break;
        owner = subgroupBallotFindLSB(sharing);
        sharing[owner / 32] &= sharing[owner / 32] - 1;
        stride = SUBGROUP_SIZE;
        walked = subgroupShuffle(range, owner) + uvec2(lane, 0);
    }
    if (i < gaussian_count) {
        [[unroll]] for (uint k = 0; k < RECORD_VECTORS; k++) d_splats[RECORD_VECTORS * i + k] = sum[k];
    }
}
