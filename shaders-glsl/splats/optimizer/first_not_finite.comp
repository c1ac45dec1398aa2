#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The first of some values that is NaN or infinite; a thread tests four consecutive ones.
//!
//! The lowest index wins, whichever thread is first; without any, `first` is unchanged. Reference:
//! `src/reference/first_not_finite.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint value_count;
};

layout(binding = 0) readonly buffer Values { vec4 values[]; };
layout(binding = 1)          buffer First  { uint first[]; };  // [0]: the lowest index so far

void main() {
    uint quad = THREAD_INDEX;
    if (4 * quad >= value_count) return;
    // Tested by bits, since a compiler may assume that floats are not NaN.
    uvec4 exponents = floatBitsToUint(values[quad]) & 0x7f800000u;
    [[unroll]] for (uint i = 0; i < 4; ++i) {
        uint at = 4 * quad + i;
        if (at < value_count && exponents[i] == 0x7f800000u) {
            atomicMin(first[0], at);
            return;
        }
    }
}
