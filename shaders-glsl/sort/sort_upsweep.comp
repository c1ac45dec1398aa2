#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "digit.glsl"

//! Radix sort, first of three kernels a pass: how many keys of each partition have each digit.
//!
//! One subgroup per partition of consecutive keys, counters in shared memory.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // where in `counts` the number of keys lives
    uint capacity;     // keys
    uint shift;        // the digit's lowest bit
    uint digit_bits;   // 1 to 8
};

layout(binding = 0) readonly  buffer Counts { uint counts[]; };
layout(binding = 1) readonly  buffer Keys   { uint keys[]; };
layout(binding = 2) writeonly buffer Table  { uint table[]; };  // (digits, partitions)

shared uint keys_with_digit[MAX_DIGITS];

void main() {
    uint part = WORKGROUP_INDEX;
    uint count = min(counts[count_index], capacity);
    uint partition_count = partitions_of(count);
    if (part >= partition_count) return;

    uint lane = gl_SubgroupInvocationID;
    uint digit_count = 1u << digit_bits;
    for (uint digit = lane; digit < digit_count; digit += SUBGROUP_SIZE) keys_with_digit[digit] = 0;
    subgroupBarrier();

    uint end = partition_end(part, count);
    for (uint i = partition_begin(part) + lane; i < end; i += SUBGROUP_SIZE) {
        atomicAdd(keys_with_digit[digit_of(keys[i], shift, digit_bits)], 1);
    }
    subgroupBarrier();

    for (uint digit = lane; digit < digit_count; digit += SUBGROUP_SIZE) {
        table[digit * partition_count + part] = keys_with_digit[digit];
    }
}
