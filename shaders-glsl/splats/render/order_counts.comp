#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "status.glsl"

//! Order counts: the number of slots before those of each depth rank within its partition, and before each partition.
//!
//! One subgroup per partition; the last to finish computes prefix sums of the partitions' sums, and the total. More
//! intersections than the buffers hold set a sticky flag: the step then renders and updates nothing; the host grows the
//! buffers, clears the flag and repeats it. A renderer that truncates keeps the nearest intersections that fit, and
//! sets no flag.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
#include "subgroup_sum.glsl"

layout(push_constant) uniform Params {
    uint gaussian_count;
    uint capacity;   // intersections
    uint truncates;  // 1: those that fit are kept
};

layout(binding = 0) readonly  buffer Ids        { uint sorted_ids[]; };   // by depth
layout(binding = 1) readonly  buffer TileCounts { uint tile_counts[]; };  // by Gaussian
layout(binding = 2) writeonly buffer Before     { uint intersection_offsets[]; };  // by rank, within its partition
layout(binding = 3) coherent  buffer Sums       { uint sums[]; };    // (partitions), exclusive prefix sums
layout(binding = 4) writeonly buffer Counts     { uint counts[]; };  // [0]: intersections to blend
layout(binding = 5)           buffer Status     { uint status[]; };
layout(binding = 6) coherent  buffer Arrivals   { uint arrivals[]; };

#include "last_workgroup.glsl"

// Loads in flight.
const uint AHEAD = 8;

void main() {
    uint part = WORKGROUP_INDEX;
    uint lane = gl_SubgroupInvocationID;
    // Even no Gaussians have a total.
    uint partition_count = max(partitions_of(gaussian_count), 1);
    if (part >= partition_count) return;

    uint sum = 0;
    uint end = gaussian_count == 0 ? 0 : partition_end(part, gaussian_count);
    for (uint first = partition_begin(part); first < end; first += AHEAD * SUBGROUP_SIZE) {
        uint count[AHEAD];
        [[unroll]] for (uint k = 0; k < AHEAD; k++) {
            count[k] = sorted_ids[min(first + k * SUBGROUP_SIZE + lane, end - 1)];
        }
        [[unroll]] for (uint k = 0; k < AHEAD; k++) count[k] = tile_counts[count[k]];
        [[unroll]] for (uint k = 0; k < AHEAD; k++) {
            uint rank = first + k * SUBGROUP_SIZE + lane;
            uint counted = rank < end ? count[k] : 0;
            uint inclusive = subgroup_inclusive_sum(counted);
            if (rank < end) intersection_offsets[rank] = sum + inclusive - counted;
            sum += subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
        }
    }
    if (subgroupElect()) sums[part] = sum;

    if (!is_last_workgroup(partition_count)) return;
    uint total = 0;
    bool wraps = false;
    for (uint first = 0; first < partition_count; first += AHEAD * SUBGROUP_SIZE) {
        uint ahead[AHEAD];
        [[unroll]] for (uint k = 0; k < AHEAD; k++) {
            ahead[k] = sums[min(first + k * SUBGROUP_SIZE + lane, partition_count - 1)];
        }
        [[unroll]] for (uint k = 0; k < AHEAD; k++) {
            uint i = first + k * SUBGROUP_SIZE + lane;
            uint sum_of_part = i < partition_count ? ahead[k] : 0;
            uint inclusive = subgroup_inclusive_sum(sum_of_part);
            if (i < partition_count) sums[i] = total + inclusive - sum_of_part;
            uint sum_of_lanes = subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
            total += sum_of_lanes;
            wraps = wraps || inclusive < sum_of_part || total < sum_of_lanes;
        }
    }
    wraps = subgroupAny(wraps);
    if (wraps) total = 0xffffffffu;
    if (subgroupElect()) {
        bool fits = total <= capacity;
        // Where the sum wrapped around, the offsets did too.
        uint kept = truncates != 0 && !wraps ? capacity : 0;
        counts[0] = fits ? total : kept;
        uint flags = status[0];
        if (!fits && truncates == 0) flags |= STATUS_OVERFLOWED;
        status[0] = flags;
        status[3] = flags;
        status[1] = max(status[1], total);
    }
}
