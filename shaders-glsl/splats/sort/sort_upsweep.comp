#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "digit.glsl"

//! Radix sort, first kernel of a pass: the offset of each partition's keys among those of their digit.
//!
//! One subgroup per partition of consecutive keys counts them by digit, in shared memory. The last subgroup to finish
//! turns each digit's counts into exclusive prefix sums; for many partitions, `sort_spine` does it instead, with a
//! subgroup for every digit.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // index in `counts` of the number of keys
    uint capacity;     // keys
    uint shift;        // the digit's lowest bit
    uint digit_bits;   // 1 to 8
    uint folds_spine;  // not 0: this kernel computes the prefix sums
};

layout(binding = 0) readonly  buffer Counts   { uint counts[]; };
layout(binding = 1) readonly  buffer Keys     { uint keys[]; };
layout(binding = 2) coherent  buffer Table    { uint table[]; };         // (partitions, digits)
layout(binding = 3) writeonly buffer Totals   { uint digit_totals[]; };  // (digits)
layout(binding = 4) coherent  buffer Arrivals { uint arrivals[]; };

#include "last_workgroup.glsl"

shared uint keys_with_digit[MAX_DIGITS];

// The number of partitions whose loads are in flight at a time.
const uint BATCH = 4;

void make_prefix_sums(uint partition_count) {
    uint digit_count = 1u << digit_bits;
    for (uint digit = gl_SubgroupInvocationID; digit < digit_count; digit += SUBGROUP_SIZE) {
        uint running = 0;
        for (uint first = 0; first < partition_count; first += BATCH) {
            uint key_counts[BATCH];
            [[unroll]] for (uint k = 0; k < BATCH; k++) {
                uint part = min(first + k, partition_count - 1);
                key_counts[k] = table[part * digit_count + digit];
            }
            [[unroll]] for (uint k = 0; k < BATCH; k++) {
                if (first + k < partition_count) {
                    table[(first + k) * digit_count + digit] = running;
                    running += key_counts[k];
                }
            }
        }
        digit_totals[digit] = running;
    }
}

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
        table[part * digit_count + digit] = keys_with_digit[digit];
    }
    if (folds_spine == 0) return;
    if (is_last_workgroup(partition_count)) make_prefix_sums(partition_count);
}
