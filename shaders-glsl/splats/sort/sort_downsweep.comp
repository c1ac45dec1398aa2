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

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
// A ballot per bit of the digit, or (up to 32 lanes) a comparison per lane: the latter takes half the time on CPUs with
// narrow subgroups, whose ballots are loops.
layout(constant_id = 1) const bool RANK_BY_BALLOT = true;
layout(constant_id = 2) const uint SUBGROUPS = 1;  // partitions of a workgroup of the upsweep

layout(push_constant) uniform Params {
    uint count_index;  // index in `counts` of the number of pairs
    uint capacity;     // pairs
    uint shift;        // the digit's lowest bit
    uint digit_bits;   // 1 to 8
};

layout(binding = 0) readonly  buffer Counts       { uint counts[]; };
layout(binding = 1) readonly  buffer Table        { uint table[]; };         // (workgroups, digits), prefix sums
layout(binding = 2) readonly  buffer Offsets      { uint offsets[]; };       // (partitions, digits) in their workgroup
layout(binding = 3) readonly  buffer Begins       { uint digit_begins[]; };  // (digits)
layout(binding = 4) readonly  buffer Keys         { uint keys[]; };
layout(binding = 5) readonly  buffer Values       { uint values[]; };
layout(binding = 6) writeonly buffer SortedKeys   { uint sorted_keys[]; };
layout(binding = 7) writeonly buffer SortedValues { uint sorted_values[]; };

shared uint next_place[MAX_DIGITS];

// Orders the subgroup's accesses to shared memory; those to buffers need no order, whose barriers are slower.
void share_places() {
    controlBarrier(gl_ScopeSubgroup, gl_ScopeSubgroup, gl_StorageSemanticsShared, gl_SemanticsAcquireRelease);
}

// A function, since the reflection of kernels cannot compare constants; drivers fold it.
bool has_offsets() {
    uint subgroups = SUBGROUPS;
    return subgroups > 1;
}

void find_first_places(uint part) {
    uint digit_count = 1u << digit_bits;
    uint workgroup = part / SUBGROUPS;
    for (uint digit = gl_SubgroupInvocationID; digit < digit_count; digit += SUBGROUP_SIZE) {
        uint offset = has_offsets() ? offsets[(part << digit_bits) + digit] : 0;
        next_place[digit] = digit_begins[digit] + table[(workgroup << digit_bits) + digit] + offset;
    }
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
    uint part = WORKGROUP_INDEX;
    uint count = min(counts[count_index], capacity);
    if (part >= partitions_of(count)) return;

    uint end = partition_end(part, count);
    uint i = partition_begin(part) + gl_SubgroupInvocationID;
    // The pair of the next turn is loaded while that of this turn is ranked.
    uint next_key = keys[min(i, end - 1)], next_value = values[min(i, end - 1)];
    find_first_places(part);
    share_places();

    for (uint first = partition_begin(part); first < end; first += SUBGROUP_SIZE, i += SUBGROUP_SIZE) {
        bool holds_pair = i < end;
        uint key = next_key, value = next_value;
        uint next = min(i + SUBGROUP_SIZE, end - 1);
        next_key = keys[next];
        next_value = values[next];
        uint digit = digit_of(key, shift, digit_bits);
        uvec4 lanes = lanes_of_digit(digit, holds_pair);
        uint rank = subgroupBallotExclusiveBitCount(lanes);
        uint place = next_place[digit] + rank;
        share_places();
        if (holds_pair) {
            sorted_keys[place] = key;
            sorted_values[place] = value;
            if (rank + 1 == subgroupBallotBitCount(lanes)) next_place[digit] = place + 1;
        }
        share_places();
    }
}
