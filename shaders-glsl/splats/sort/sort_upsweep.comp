#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "digit.glsl"

//! Radix sort, first kernel of a pass: the offset of each workgroup's keys among those of their digit, and where the
//! keys of each digit begin. With several partitions a workgroup, the other passes have these from the pass before.
//!
//! A subgroup counts the keys of a partition by digit, in shared memory. The last workgroup to finish turns the counts
//! of the workgroups into exclusive prefix sums, and sums them up by digit.

layout(constant_id = 2) const uint SUBGROUPS = 1;  // partitions of a workgroup; 1 on a CPU, where a barrier is slow
layout(local_size_x_id = 100, local_size_y_id = 2) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // where in `counts` the number of keys is
    uint capacity;     // keys
    uint shift;        // the digit's lowest bit
    uint digit_bits;   // 1 to 8
    uint next_table;   // where in `table` the next pass will have its counts: zeroed; 0 if it counts its own
};

layout(binding = 0) readonly  buffer Counts   { uint counts[]; };
layout(binding = 1) readonly  buffer Keys     { uint keys[]; };
layout(binding = 2) coherent  buffer Table    { uint table[]; };         // from the start: (workgroups, digits)
layout(binding = 3) writeonly buffer Begins   { uint digit_begins[]; };  // (digits)
layout(binding = 4) coherent  buffer Arrivals { uint arrivals[]; };

#include "digit_table.glsl"

void main() {
    uint count = min(counts[count_index], capacity);
    uint partition_count = partitions_of(count);
    uint workgroup_count = (partition_count + SUBGROUPS - 1) / SUBGROUPS;
    if (WORKGROUP_INDEX >= workgroup_count) return;

    uint digit_count = 1u << digit_bits;
    for (uint i = thread(); i < SUBGROUPS * MAX_DIGITS; i += THREADS) keys_with_digit[i] = 0;
    if (is_shared() && next_table != 0) clear_row(next_table);
    sync();
    uint part = WORKGROUP_INDEX * SUBGROUPS + gl_LocalInvocationID.y;
    if (part < partition_count) {
        count_keys(partition_begin(part) + gl_LocalInvocationID.x, partition_end(part, count), shift, digit_bits);
    }
    sync();

    for (uint digit = thread(); digit < digit_count; digit += THREADS) {
        uint sum = 0;
        [[unroll]] for (uint k = 0; k < SUBGROUPS; k++) sum += keys_with_digit[k * MAX_DIGITS + digit];
        table[(WORKGROUP_INDEX << digit_bits) + digit] = sum;
    }
    if (is_last_of(workgroup_count)) sum_table(0, digit_bits, workgroup_count);
}
