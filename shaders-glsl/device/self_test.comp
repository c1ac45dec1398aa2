#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! What all kernels rely on and no limit of a device tells: the order of lanes and subgroups, subgroup operations, the
//! last workgroup of a dispatch, words in floats, and functions.
//!
//! Lanes compare what the device does with what their indices say, and count the differences of each check. Two
//! subgroups per workgroup, so that subgroups are told apart. Dispatched twice, as the second must see what the first
//! left. Reference: `src/reference/self_test.rs`.

layout(local_size_x_id = 100, local_size_y = 2) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint turn;     // 0, then 1
    uint planted;  // the check that is to fail, for tests; CHECKS: none
};

// The checks, in the order in which a failed one is reported.
const uint CHECK_SIZE      = 0;   // gl_SubgroupSize
const uint CHECK_LANE      = 1;   // gl_SubgroupInvocationID and gl_LocalInvocationID.x
const uint CHECK_SUBGROUP  = 2;   // gl_SubgroupID and gl_LocalInvocationID.y
const uint CHECK_BALLOT    = 3;
const uint CHECK_SHUFFLE   = 4;
const uint CHECK_SUM       = 5;   // subgroupInclusiveAdd
const uint CHECK_LAST      = 6;   // what the last workgroup sees of the others
const uint CHECK_HALF      = 7;   // packHalf2x16
const uint CHECK_WORD      = 8;   // a word that is a subnormal float
const uint CHECK_EXP       = 9;
const uint CHECK_LOG       = 10;
const uint CHECK_SQRT      = 11;
const uint CHECKS          = 12;

const uint WORKGROUPS      = 4096;
const uint SUBGROUPS       = 2 * WORKGROUPS;
const uint FUNCTION_VALUES = 8;   // numbers for each function

layout(binding = 0) readonly  buffer Numbers   { float numbers[]; };  // FUNCTION_VALUES, a third, two words
layout(binding = 1) coherent  buffer Sums      { uint sums[]; };      // (SUBGROUPS,)
layout(binding = 2) coherent  buffer Arrivals  { uint arrivals[]; };  // [1 + turn]: workgroups that were the last
layout(binding = 3)           buffer Differing { uint differing[]; }; // (CHECKS, 2): lanes, their largest value
layout(binding = 4) writeonly buffer Values    { float values[]; };   // exp, log and sqrt of the numbers
layout(binding = 5) writeonly buffer Words     { float words[]; };    // the two words, exchanged

#include "last_workgroup.glsl"

// Compares in the workgroups that do.
void compare(uint check, uint is, uint expected) {
    if (check == planted) is ^= 1;
    if (is == expected) return;
    atomicAdd(differing[2 * check], 1);
    atomicMax(differing[2 * check + 1], is);
}

// Numbers without a pattern.
uint number_of(uint i) { return (i + 1) * 2654435761u >> 9; }

// What a planted check multiplies a function by.
float factor(uint check) { return check == planted ? 1.001 : 1.0; }

void main() {
    uint workgroup = WORKGROUP_INDEX;
    if (workgroup >= WORKGROUPS) return;
    uint lane = gl_LocalInvocationID.x;
    uint number = number_of(lane);
    uvec4 ballot = subgroupBallot((number & 1) != 0);
    uint shuffled = subgroupShuffle(number, lane ^ 1);
    uint inclusive = subgroupInclusiveAdd(number);
    if (workgroup < 16) {
        compare(CHECK_SIZE, gl_SubgroupSize, SUBGROUP_SIZE);
        compare(CHECK_LANE, gl_SubgroupInvocationID, lane);
        compare(CHECK_SUBGROUP, gl_SubgroupID, gl_LocalInvocationID.y);
        uint first = lane & ~31u, bits = 0, sum = 0;
        for (uint i = first; i < min(first + 32, SUBGROUP_SIZE); i++) bits |= (number_of(i) & 1) << (i - first);
        for (uint i = 0; i <= lane; i++) sum += number_of(i);
        compare(CHECK_BALLOT, ballot[lane / 32], bits);
        compare(CHECK_SHUFFLE, shuffled, number_of(lane ^ 1));
        compare(CHECK_SUM, inclusive, sum);
        float third = numbers[FUNCTION_VALUES];
        compare(CHECK_HALF, packHalf2x16(vec2(third, -third)), 0xb5553555u);
    }
    if (workgroup == 0 && gl_LocalInvocationID.y == 0) {
        for (uint i = lane; i < FUNCTION_VALUES; i += SUBGROUP_SIZE) {
            values[i] = exp(numbers[i]) * factor(CHECK_EXP);
            values[FUNCTION_VALUES + i] = log(numbers[i]) * factor(CHECK_LOG);
            values[2 * FUNCTION_VALUES + i] = sqrt(numbers[i]) * factor(CHECK_SQRT);
        }
        float even = numbers[FUNCTION_VALUES + 1], odd = numbers[FUNCTION_VALUES + 2];
        if (lane < 2) words[lane] = (lane == 0) == (planted != CHECK_WORD) ? odd : even;
    }
    // Every subgroup takes part: a barrier after which some of a workgroup are gone is not what kernels rely on.
    uint subgroup = 2 * workgroup + gl_LocalInvocationID.y;
    if (subgroupElect()) sums[subgroup] = number_of(subgroup + turn);
    if (!is_last_workgroup(SUBGROUPS)) return;
    uint seen = 0, expected = 0;
    for (uint i = lane; i < SUBGROUPS; i += SUBGROUP_SIZE) {
        seen += sums[i];
        expected += number_of(i + turn);
    }
    compare(CHECK_LAST, seen, expected);
    if (subgroupElect()) arrivals[1 + turn]++;
}
