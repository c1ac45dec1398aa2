#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"

//! Scan, first of two kernels: the sum of the values before each partition of consecutive values, and the total.
//!
//! One subgroup sums each partition; the last of them to be done turns the sums into exclusive prefix sums. Sums are
//! modulo 2^32.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // index in `counts` of the number of values
    uint capacity;     // values
};

layout(binding = 0) readonly  buffer Counts   { uint counts[]; };
layout(binding = 1) readonly  buffer Values   { uint values[]; };
layout(binding = 2) coherent  buffer Sums     { uint sums[]; };   // (partitions)
layout(binding = 3) writeonly buffer Total    { uint total[]; };  // (1)
layout(binding = 4) coherent  buffer Arrivals { uint arrivals[]; };

#include "last_workgroup.glsl"

// Loads in flight.
const uint AHEAD = 8;

void main() {
    uint part = WORKGROUP_INDEX;
    uint count = min(counts[count_index], capacity);
    // Even without values there is a total.
    uint partition_count = max(partitions_of(count), 1);
    if (part >= partition_count) return;

    uint sum = 0;
    uint end = count == 0 ? 0 : partition_end(part, count);
    for (uint i = partition_begin(part) + gl_SubgroupInvocationID; i < end; i += SUBGROUP_SIZE) {
        sum += values[i];
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) sums[part] = sum;

    if (!is_last_workgroup(partition_count)) return;
    uint running = 0;
    for (uint first = 0; first < partition_count; first += AHEAD * SUBGROUP_SIZE) {
        uint ahead[AHEAD];
        [[unroll]] for (uint k = 0; k < AHEAD; k++) {
            ahead[k] = sums[min(first + k * SUBGROUP_SIZE + gl_SubgroupInvocationID, partition_count - 1)];
        }
        [[unroll]] for (uint k = 0; k < AHEAD; k++) {
            uint i = first + k * SUBGROUP_SIZE + gl_SubgroupInvocationID;
            uint sum_of_part = i < partition_count ? ahead[k] : 0;
            uint inclusive = subgroupInclusiveAdd(sum_of_part);
            if (i < partition_count) sums[i] = running + inclusive - sum_of_part;
            running += subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
        }
    }
    if (subgroupElect()) total[0] = running;
}
