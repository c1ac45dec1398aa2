#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"

//! Scan, first of three kernels: the sum of each partition of consecutive values.
//!
//! One subgroup per partition. Sums are modulo 2^32.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // where in `counts` the number of values lives
    uint capacity;     // values
};

layout(binding = 0) readonly  buffer Counts { uint counts[]; };
layout(binding = 1) readonly  buffer Values { uint values[]; };
layout(binding = 2) writeonly buffer Sums   { uint sums[]; };  // (partitions)

void main() {
    uint part = WORKGROUP_INDEX;
    uint count = min(counts[count_index], capacity);
    if (part >= partitions_of(count)) return;

    uint sum = 0;
    uint end = partition_end(part, count);
    for (uint i = partition_begin(part) + gl_SubgroupInvocationID; i < end; i += SUBGROUP_SIZE) {
        sum += values[i];
    }
    sum = subgroupAdd(sum);
    if (subgroupElect()) sums[part] = sum;
}
