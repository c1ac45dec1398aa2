#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm_half.glsl"
#include "norm_channels.glsl"

//! `norm_backward_sums` of packed maps: per chunk the sums of d_y and of d_y n; and the largest magnitude of d_f', as
//! bits, into the use's word, which was 0.
//!
//! Reference: `src/reference/norm_backward_sums_half.rs`.

layout(binding = 4) readonly  buffer DTargetBound { uint d_target_bound[]; };
layout(binding = 5) readonly  buffer DTarget  { uvec4 d_target[]; };  // d_f', packed
layout(binding = 6) writeonly buffer Partials { vec2 partials[]; };   // (C, chunks)
layout(binding = 7)           buffer Largest  { uint largest[]; };    // (uses,)

void main() {
    load_channels();
    float inverse = packed_inverse(packed_exponent(d_target_bound[0]));
    uint end = chunk_end(size.x * size.y), largest_seen = 0;
    vec2 sums[8];
    [[unroll]] for (uint c = 0; c < 8; ++c) sums[c] = vec2(0.0);
    for (uint i = chunk_begin(); i < end; i += STEP) {
        uint eight = eight_of(i);
        float n[8] = normalised(eight), d[8] = unpacked_eight(d_target[eight], inverse);
        [[unroll]] for (uint c = 0; c < 8; ++c) {
            float d_y = gamma[c] * n[c] + beta[c] > 0.0 ? d[c] : 0.0;
            sums[c] += d_y * vec2(1.0, n[c]);
            largest_seen = max(largest_seen, floatBitsToUint(d[c]) & 0x7fffffffu);
        }
    }
    largest_seen = subgroupMax(largest_seen);
    if (subgroupElect() && largest_seen > 0) atomicMax(largest[slot / channel_count], largest_seen);
    [[unroll]] for (uint c = 0; c < 8; ++c) {
        vec2 sum = vec2(sum_of_pixels(sums[c].x), sum_of_pixels(sums[c].y));
        uint channel = 8 * EIGHT + c;
        if (gl_SubgroupInvocationID < PIXEL_LANES && channel < channel_count)
            partials[channel * CHUNK_COUNT + gl_WorkGroupID.x] = sum;
    }
}
