#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"
#include "digit.glsl"

//! Radix sort, first kernel of a pass: the offset of each partition's keys among those of their digit, and where the
//! keys of each digit begin.
//!
//! A subgroup counts the keys of a partition by digit, in shared memory. The workgroup turns the counts of its
//! partitions into exclusive prefix sums; the last workgroup to finish does the same for the counts of the workgroups,
//! and for the digits.

layout(constant_id = 2) const uint SUBGROUPS = 1;  // partitions of a workgroup; 1 on a CPU, where a barrier is slow
layout(local_size_x_id = 100, local_size_y_id = 2) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // where in `counts` the number of keys is
    uint capacity;     // keys
    uint shift;        // the digit's lowest bit
    uint digit_bits;   // 1 to 8
};

layout(binding = 0) readonly  buffer Counts   { uint counts[]; };
layout(binding = 1) readonly  buffer Keys     { uint keys[]; };
layout(binding = 2) coherent  buffer Table    { uint table[]; };         // (workgroups, digits)
layout(binding = 3) writeonly buffer Offsets  { uint offsets[]; };       // (partitions, digits) in their workgroup
layout(binding = 4) writeonly buffer Begins   { uint digit_begins[]; };  // (digits)
layout(binding = 5) coherent  buffer Arrivals { uint arrivals[]; };

#include "last_workgroup.glsl"

shared uint keys_with_digit[SUBGROUPS * MAX_DIGITS];
shared uint is_last;

// A function, since the reflection of kernels cannot compare constants; drivers fold it.
bool is_shared() {
    uint subgroups = SUBGROUPS;
    return subgroups > 1;
}

// Loads in flight: of keys, and of the counts of workgroups.
const uint KEYS_AHEAD = 8;
const uint WORKGROUPS_AHEAD = 16;

uint thread() { return gl_LocalInvocationID.y * SUBGROUP_SIZE + gl_LocalInvocationID.x; }
const uint THREADS = SUBGROUPS * SUBGROUP_SIZE;

void sync() {
    if (is_shared()) barrier();
    else subgroupBarrier();
}

void count_keys(uint part, uint count) {
    uint own = gl_LocalInvocationID.y * MAX_DIGITS;
    uint end = partition_end(part, count);
    uint first = partition_begin(part) + gl_LocalInvocationID.x;
    if (!is_shared()) {
        for (uint i = first; i < end; i += SUBGROUP_SIZE) {
            atomicAdd(keys_with_digit[digit_of(keys[i], shift, digit_bits)], 1);
        }
        return;
    }
    for (; first < end; first += KEYS_AHEAD * SUBGROUP_SIZE) {
        uint key[KEYS_AHEAD];
        [[unroll]] for (uint k = 0; k < KEYS_AHEAD; k++) key[k] = keys[min(first + k * SUBGROUP_SIZE, end - 1)];
        [[unroll]] for (uint k = 0; k < KEYS_AHEAD; k++) {
            if (first + k * SUBGROUP_SIZE < end) {
                atomicAdd(keys_with_digit[own + digit_of(key[k], shift, digit_bits)], 1);
            }
        }
    }
}

// Whether this workgroup is the last of a dispatch of several subgroups each; see `is_last_workgroup`.
bool is_last_of(uint workgroup_count) {
    if (!is_shared()) return is_last_workgroup(workgroup_count);
    memoryBarrierBuffer();
    barrier();
    if (thread() == 0) {
        is_last = uint(atomicAdd(arrivals[0], 1) + 1 == workgroup_count);
        if (is_last != 0) arrivals[0] = 0;
    }
    barrier();
    memoryBarrierBuffer();
    return is_last != 0;
}

// Exclusive prefix sums of a digit over the workgroups; returns the sum of all.
uint sum_workgroups(uint digit, uint workgroup_count) {
    uint running = 0;
    for (uint first = 0; first < workgroup_count; first += WORKGROUPS_AHEAD) {
        uint key_counts[WORKGROUPS_AHEAD];
        [[unroll]] for (uint k = 0; k < WORKGROUPS_AHEAD; k++) {
            uint workgroup = min(first + k, workgroup_count - 1);
            key_counts[k] = table[(workgroup << digit_bits) + digit];
        }
        [[unroll]] for (uint k = 0; k < WORKGROUPS_AHEAD; k++) {
            if (first + k < workgroup_count) {
                table[((first + k) << digit_bits) + digit] = running;
                running += key_counts[k];
            }
        }
    }
    return running;
}

void main() {
    uint count = min(counts[count_index], capacity);
    uint partition_count = partitions_of(count);
    uint workgroup_count = (partition_count + SUBGROUPS - 1) / SUBGROUPS;
    if (WORKGROUP_INDEX >= workgroup_count) return;

    uint digit_count = 1u << digit_bits;
    for (uint i = thread(); i < SUBGROUPS * MAX_DIGITS; i += THREADS) keys_with_digit[i] = 0;
    sync();
    uint part = WORKGROUP_INDEX * SUBGROUPS + gl_LocalInvocationID.y;
    if (part < partition_count) count_keys(part, count);
    sync();

    for (uint digit = thread(); digit < digit_count; digit += THREADS) {
        uint running = 0;
        [[unroll]] for (uint k = 0; k < SUBGROUPS; k++) {
            uint part = WORKGROUP_INDEX * SUBGROUPS + k;
            if (is_shared() && part < partition_count) offsets[(part << digit_bits) + digit] = running;
            running += keys_with_digit[k * MAX_DIGITS + digit];
        }
        table[(WORKGROUP_INDEX << digit_bits) + digit] = running;
    }
    if (!is_last_of(workgroup_count)) return;

    for (uint digit = thread(); digit < digit_count; digit += THREADS) {
        keys_with_digit[digit] = sum_workgroups(digit, workgroup_count);
    }
    sync();
    for (uint digit = thread(); digit < digit_count; digit += THREADS) {
        uint before = 0;
        for (uint first = 0; first < digit; first += 8) {
            [[unroll]] for (uint k = first; k < first + 8; k++) before += k < digit ? keys_with_digit[k] : 0;
        }
        digit_begins[digit] = before;
    }
}
