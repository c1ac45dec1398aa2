#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! What a device can do at most: moves vectors, or repeats one operation on each of their components.
//!
//! Every vector is loaded and stored once. `turns` times, its components are multiplied and added to, or exchanged with
//! those of another lane of the subgroup.

layout(local_size_x = 256) in;
layout(constant_id = 0) const uint OPERATION = 0;  // 0: none; 1: multiply and add; 2: exchange

layout(push_constant) uniform Params {
    uint vector_count;
    uint turns;      // of OPERATIONS_PER_TURN
    float factor;    // 0 to 1/2
    uint lane_bits;  // bits of the lane's number in which the other one differs
};

layout(binding = 0) readonly  buffer Source { vec4 source[]; };
layout(binding = 1) writeonly buffer Target { vec4 target[]; };

const uint OPERATIONS_PER_TURN = 16;

void main() {
    uint i = THREAD_INDEX;
    // Every lane exchanges, so that the other one is there.
    vec4 value = i < vector_count ? source[i] : vec4(0.0);
    for (uint turn = 0; turn < turns; turn++) {
        [[unroll]] for (uint k = 0; k < OPERATIONS_PER_TURN; k++) {
            if (OPERATION == 1) value = fma(value, vec4(factor), vec4(1.0));
            if (OPERATION == 2) value = subgroupShuffleXor(value, lane_bits);
        }
    }
    // An even number of exchanges with the same lane would be none.
    if (OPERATION == 2) value = subgroupShuffleXor(value, lane_bits);
    if (i < vector_count) target[i] = value;
}
