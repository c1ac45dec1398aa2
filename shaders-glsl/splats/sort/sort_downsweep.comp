#version 460
#extension GL_GOOGLE_include_directive : require
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

layout(push_constant) uniform Params {
    uint count_index;  // index in `counts` of the number of pairs
    uint capacity;     // pairs
    uint shift;        // the digit's lowest bit
    uint digit_bits;   // 1 to 8
};

layout(binding = 0) readonly  buffer Counts       { uint counts[]; };
layout(binding = 1) readonly  buffer Table        { uint table[]; };         // (partitions, digits), prefix sums
layout(binding = 2) readonly  buffer Totals       { uint digit_totals[]; };  // (digits)
layout(binding = 3) readonly  buffer Keys         { uint keys[]; };
layout(binding = 4) readonly  buffer Values       { uint values[]; };
layout(binding = 5) writeonly buffer SortedKeys   { uint sorted_keys[]; };
layout(binding = 6) writeonly buffer SortedValues { uint sorted_values[]; };

shared uint next_place[MAX_DIGITS];

void find_first_places(uint part) {
    uint digit_count = 1u << digit_bits;
    uint running = 0;
    for (uint first = 0; first < digit_count; first += SUBGROUP_SIZE) {
        uint digit = first + gl_SubgroupInvocationID;
        uint keys = digit < digit_count ? digit_totals[digit] : 0;
        uint inclusive = subgroupInclusiveAdd(keys);
        if (digit < digit_count) {
            next_place[digit] = running + inclusive - keys + table[part * digit_count + digit];
        }
        running += subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
    }
}

// The lanes that have a pair of this lane's digit.
uvec4 lanes_of_digit(uint digit, bool holds_pair) {
    if (RANK_BY_BALLOT) {
        uvec4 lanes = subgroupBallot(holds_pair);
        for (uint bit = 0; bit < digit_bits; ++bit) {
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

    find_first_places(part);
    subgroupBarrier();

    uint end = partition_end(part, count);
    for (uint first = partition_begin(part); first < end; first += SUBGROUP_SIZE) {
        uint i = first + gl_SubgroupInvocationID;
        bool holds_pair = i < end;
        uint key = holds_pair ? keys[i] : 0;
        uint digit = digit_of(key, shift, digit_bits);
        uvec4 lanes = lanes_of_digit(digit, holds_pair);
        uint rank = subgroupBallotExclusiveBitCount(lanes);
        uint place = next_place[digit] + rank;
        subgroupBarrier();
        if (holds_pair) {
            sorted_keys[place] = key;
            sorted_values[place] = values[i];
            if (rank + 1 == subgroupBallotBitCount(lanes)) next_place[digit] = place + 1;
        }
        subgroupBarrier();
    }
}
