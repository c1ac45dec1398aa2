#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! Decode: one thread per word of codes looks up the values that they stand for.
//!
//! A look-up and no division, which a device may round as it likes: what is decoded has the bits that were encoded.

layout(local_size_x = 256) in;

layout(constant_id = 0) const uint CODE_BITS = 8;  // 8 or 16

layout(push_constant) uniform Params { uint value_count; };

layout(binding = 0) readonly  buffer Codes   { uint codes[]; };     // the lowest bits first
layout(binding = 1) readonly  buffer Values  { float values[]; };   // one per code
layout(binding = 2) writeonly buffer Decoded { float decoded[]; };

void main() {
    const uint PER_WORD = 32 / CODE_BITS;
    uint word = THREAD_INDEX;
    if (word * PER_WORD >= value_count) return;
    uint left = codes[word];
    uint end = min((word + 1) * PER_WORD, value_count);
    for (uint i = word * PER_WORD; i < end; ++i) {
        decoded[i] = values[left & ((1u << CODE_BITS) - 1)];
        left >>= CODE_BITS;
    }
}
