#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_memory_scope_semantics : require
#include "kernel.glsl"
#include "partition.glsl"
#include "digit.glsl"

//! Radix sort, last kernel of a pass: every pair to its place, pairs of one digit in their previous order.
//!
//! One subgroup per partition of consecutive keys; shared memory has, per digit, the place of the partition's next key.
//! SUBGROUP_SIZE pairs are placed at a time; a pair's rank among them is the number of lower lanes with the same digit.
//!
//! With several partitions a workgroup, the subgroups first count their keys, and every pair is counted by the next
//! pass's digit where it is placed: integers, whose sums do not depend on the order. The last workgroup to finish does
//! for the next pass what `sort_upsweep` does for the first, which saves a dispatch that waits for this one.

layout(constant_id = 2) const uint SUBGROUPS = 1;  // partitions of a workgroup; 1 on a CPU, where a barrier is slow
layout(local_size_x_id = 100, local_size_y_id = 2) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
// A ballot per bit of the digit, or (up to 32 lanes) a comparison per lane: the latter takes half the time on CPUs with
// narrow subgroups, whose ballots are loops.
layout(constant_id = 1) const bool RANK_BY_BALLOT = true;

layout(push_constant) uniform Params {
    uint count_index;    // index in `counts` of the number of pairs
    uint capacity;       // pairs
    uint shift;          // the digit's lowest bit
    uint digit_bits;     // 1 to 8
    uint next_bits;      // of the next pass's digit; 0: there is no next pass, or it counts its own keys
    uint own_table;      // where in `table` the prefix sums of this pass begin,
    uint next_table;     // the counts of the next one, all zero,
    uint cleared_table;  // and those of the one after it, which are zeroed
};

layout(binding = 0) readonly  buffer Counts       { uint counts[]; };
layout(binding = 1) coherent  buffer Table        { uint table[]; };         // each: (workgroups, digits)
layout(binding = 2)           buffer Begins       { uint digit_begins[]; };  // (digits)
layout(binding = 3) readonly  buffer Keys         { uint keys[]; };
layout(binding = 4) readonly  buffer Values       { uint values[]; };
layout(binding = 5) writeonly buffer SortedKeys   { uint sorted_keys[]; };
layout(binding = 6) writeonly buffer SortedValues { uint sorted_values[]; };
layout(binding = 7) coherent  buffer Arrivals     { uint arrivals[]; };

#include "digit_table.glsl"

// Per subgroup and digit: the place of the next key.
#define next_place keys_with_digit

// Orders the subgroup's accesses to shared memory; those to buffers need no order, whose barriers are slower.
void share_places() {
    controlBarrier(gl_ScopeSubgroup, gl_ScopeSubgroup, gl_StorageSemanticsShared, gl_SemanticsAcquireRelease);
}

// The first place of every digit, for all partitions of the workgroup.
void find_first_places(uint first, uint end) {
    if (is_shared()) {
        for (uint i = thread(); i < SUBGROUPS * MAX_DIGITS; i += THREADS) keys_with_digit[i] = 0;
        barrier();
        count_keys(first, end, shift, digit_bits);
        barrier();
    }
    for (uint digit = thread(); digit < 1u << digit_bits; digit += THREADS) {
        uint position = digit_begins[digit] + table[own_table + (WORKGROUP_INDEX << digit_bits) + digit];
        [[unroll]] for (uint k = 0; k < SUBGROUPS; k++) {
            uint key_count = is_shared() ? keys_with_digit[k * MAX_DIGITS + digit] : 0;
            next_place[k * MAX_DIGITS + digit] = position;
            position += key_count;
        }
    }
    if (is_shared()) barrier();
    else share_places();
}

// The lanes that have a pair of this lane's digit.
uvec4 lanes_of_digit(uint digit, bool holds_pair) {
    if (RANK_BY_BALLOT) {
        uvec4 lanes = subgroupBallot(holds_pair);
        // Bits beyond the digit's are 0 in every lane.
        [[unroll]] for (uint bit = 0; bit < MAX_DIGIT_BITS; ++bit) {
            bool is_set = (digit >> bit & 1) == 1;
            uvec4 set = subgroupBallot(is_set);
            lanes &= is_set ? set : ~set;
        }
        return lanes;
    }
    uint compared = holds_pair ? digit : MAX_DIGITS;
    uint lanes = 0;
    for (uint lane = 0; lane < SUBGROUP_SIZE; ++lane) {
        lanes |= uint(subgroupShuffle(compared, lane) == compared) << lane;
    }
    return uvec4(lanes, 0, 0, 0);
}

void main() {
    uint count = min(counts[count_index], capacity);
    uint partition_count = partitions_of(count);
    uint workgroup_count = (partition_count + SUBGROUPS - 1) / SUBGROUPS;
    if (WORKGROUP_INDEX >= workgroup_count) return;

    // Subgroups after the last partition have an empty one.
    uint part = WORKGROUP_INDEX * SUBGROUPS + gl_LocalInvocationID.y;
    uint begin = part < partition_count ? partition_begin(part) : count;
    uint end = part < partition_count ? partition_end(part, count) : count;
    uint i = begin + gl_SubgroupInvocationID;
    // The pair of the next turn is loaded while that of this turn is ranked.
    uint next_key = keys[min(i, end - 1)], next_value = values[min(i, end - 1)];
    bool counts_next = is_shared() && next_bits != 0;
    if (counts_next) clear_row(cleared_table);
    find_first_places(i, end);

    uint row_begin = gl_LocalInvocationID.y * MAX_DIGITS;
    for (uint first = begin; first < end; first += SUBGROUP_SIZE, i += SUBGROUP_SIZE) {
        bool holds_pair = i < end;
        uint key = next_key, value = next_value;
        uint next = min(i + SUBGROUP_SIZE, end - 1);
        next_key = keys[next];
        next_value = values[next];
        uint digit = digit_of(key, shift, digit_bits);
        uvec4 lanes = lanes_of_digit(digit, holds_pair);
        uint rank = subgroupBallotExclusiveBitCount(lanes);
        uint position = next_place[row_begin + digit] + rank;
        share_places();
        if (holds_pair) {
            sorted_keys[position] = key;
            sorted_values[position] = value;
            if (rank + 1 == subgroupBallotBitCount(lanes)) next_place[row_begin + digit] = position + 1;
            if (counts_next) {
                uint row = position / (PARTITION_SIZE * SUBGROUPS);
                atomicAdd(table[next_table + (row << next_bits) + digit_of(key, shift + digit_bits, next_bits)], 1);
            }
        }
        share_places();
    }
    if (!counts_next) return;
    if (is_last_of(workgroup_count)) sum_table(next_table, next_bits, workgroup_count);
}
