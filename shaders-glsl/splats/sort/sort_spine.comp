#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "partition.glsl"

//! Radix sort, between the two kernels of a pass over many partitions: the offset of each among the keys of one digit.
//!
//! One subgroup per digit turns the digit's column of the table into exclusive prefix sums and writes the column's
//! total, which the downsweep sums over the smaller digits.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint count_index;  // index in `counts` of the number of keys
    uint capacity;     // keys
    uint digit_bits;   // there are 2^digit_bits digits
};

layout(binding = 0) readonly  buffer Counts { uint counts[]; };
layout(binding = 1)           buffer Table  { uint table[]; };         // (partitions, digits)
layout(binding = 2) writeonly buffer Totals { uint digit_totals[]; };  // (digits)

void main() {
    uint digit = WORKGROUP_INDEX;
    if (digit >> digit_bits != 0) return;
    uint partition_count = partitions_of(min(counts[count_index], capacity));
    uint running = 0;
    for (uint first = 0; first < partition_count; first += SUBGROUP_SIZE) {
        uint part = first + gl_SubgroupInvocationID;
        uint i = (part << digit_bits) + digit;
        uint keys = part < partition_count ? table[i] : 0;
        uint inclusive = subgroupInclusiveAdd(keys);
        if (part < partition_count) table[i] = running + inclusive - keys;
        running += subgroupShuffle(inclusive, SUBGROUP_SIZE - 1);
    }
    if (subgroupElect()) digit_totals[digit] = running;
}
