#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "packed.glsl"

//! The weights of a layer as the first factor of 16-bit matrices: packed[t, o, i] = scale weight[o, i, t], zeros
//! beyond.
//!
//! TRANSPOSED: packed[t, i, o] = scale weight[o, i, -t], which turns dL/d output into dL/d input. A thread writes eight
//! adjacent ones. `pack_map` states the rounding error. Reference: `src/reference/pack_weights.rs`.

layout(local_size_x = 256) in;
layout(constant_id = 0) const bool TRANSPOSED = false;

layout(push_constant) uniform Params {
    uint in_channels;
    uint out_channels;
    uint offset;        // of the layer in `values`: weights (out, in, 3, 3)
};

layout(binding = 0) readonly  buffer Bound   { uint bound[]; };   // of the weights
layout(binding = 1) readonly  buffer Values  { float values[]; };
layout(binding = 2) writeonly buffer Packed  { uvec4 packed[]; };   // (tap, to, from), eight halves each

const uint TAPS = 9;

float weight(uint tap, uint to, uint from) {
    if (TRANSPOSED) {
        if (to >= in_channels || from >= out_channels) return 0.0;
        return values[offset + (from * in_channels + to) * TAPS + (TAPS - 1 - tap)];
    }
    if (to >= out_channels || from >= in_channels) return 0.0;
    return values[offset + (to * in_channels + from) * TAPS + tap];
}

void main() {
    uint own_in = packed_channels(in_channels), own_out = packed_channels(out_channels);
    uint to_count = own_out, from_count = own_in;
    if (TRANSPOSED) {
        to_count = own_in;
        from_count = own_out;
    }
    uint i = THREAD_INDEX, eights = from_count / 8;
    if (i >= TAPS * to_count * eights) return;
    uint first = 8 * (i % eights), to = i / eights % to_count, tap = i / (eights * to_count);
    float scale = packed_scale(packed_exponent(bound[0]));
    uvec4 words;
    [[unroll]] for (uint w = 0; w < 4; ++w)
        words[w] = packHalf2x16(scale * vec2(weight(tap, to, first + 2 * w), weight(tap, to, first + 2 * w + 1)));
    packed[i] = words;
}
