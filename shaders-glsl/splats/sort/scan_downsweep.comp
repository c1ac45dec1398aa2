#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"

//! Scan, last of two kernels: the exclusive prefix sums within each partition, plus the sum of the preceding ones.
//!
//! One subgroup per partition: SUBGROUP_SIZE values at a time, the running total carried along.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // index in `counts` of the number of values
    uint capacity;     // values
};

layout(binding = 0) readonly  buffer Counts  { uint counts[]; };
layout(binding = 1) readonly  buffer Values  { uint values[]; };
layout(binding = 2) readonly  buffer Sums    { uint sums[]; };  // (partitions), exclusive prefix sums
layout(binding = 3) writeonly buffer Offsets { uint offsets[]; };

void main() {
    uint part = WORKGROUP_INDEX;
    uint count = min(counts[count_index], capacity);
    if (part >= partitions_of(count)) return;

    uint running = sums[part];
    uint end = partition_end(part, count);
    for (uint first = partition_begin(part); first < end; first += SUBGROUP_SIZE) {
        uint i = first + gl_SubgroupInvocationID;
        uint value = i < end ? values[i] : 0;
        uint inclusive = subgroupInclusiveAdd(value);
        if (i < end) offsets[i] = running + inclusive - value;
        running += subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
    }
}
