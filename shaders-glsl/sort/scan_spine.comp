#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"

//! Scan, second of three kernels: the partitions' sums become what precedes each partition; and the total.
//!
//! One subgroup in all: SUBGROUP_SIZE sums at a time, the running total carried along.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // where in `counts` the number of values lives
    uint capacity;     // values
};

layout(binding = 0) readonly  buffer Counts { uint counts[]; };
layout(binding = 1)           buffer Sums   { uint sums[]; };   // (partitions)
layout(binding = 2) writeonly buffer Total  { uint total[]; };  // (1)

void main() {
    uint partition_count = partitions_of(min(counts[count_index], capacity));
    uint running = 0;
    for (uint first = 0; first < partition_count; first += SUBGROUP_SIZE) {
        uint part = first + gl_SubgroupInvocationID;
        uint sum = part < partition_count ? sums[part] : 0;
        uint inclusive = subgroupInclusiveAdd(sum);
        if (part < partition_count) sums[part] = running + inclusive - sum;
        running += subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
    }
    if (subgroupElect()) total[0] = running;
}
