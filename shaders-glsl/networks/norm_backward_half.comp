#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "norm_half.glsl"
#include "norm_channels.glsl"

//! `norm_backward` of packed maps: d_z = gamma / deviation (d_y - mean of d_y - n mean of d_y n), zeros around it.
//!
//! Neither mean exceeds the largest d, which bounds d_z. Reference: `src/reference/norm_backward_half.rs`.

layout(binding = 4) readonly  buffer Sums         { vec2 sums[]; };     // (C,): of d_y and of d_y n
layout(binding = 5) readonly  buffer Largest      { uint largest[]; };  // (uses,): of d_f'
layout(binding = 6) readonly  buffer DTargetBound { uint d_target_bound[]; };
layout(binding = 7) readonly  buffer DTarget      { uvec4 d_target[]; };  // d_f', packed
layout(binding = 8) writeonly buffer DSourceBound { uint d_source_bound[]; };
layout(binding = 9) writeonly buffer DSource      { uvec4 d_source[]; };  // d_z, packed

void main() {
    load_channels();
    float largest_factor = 0.0;
    for (uint channel = gl_SubgroupInvocationID; channel < channel_count; channel += SUBGROUP_SIZE) {
        float factor = values[offset + channel] * statistics[slot + channel].inverse_deviation;
        largest_factor = max(largest_factor, abs(factor));
    }
    precise float most = subgroupMax(largest_factor) * (2.0 + most_normalised);
    most *= uintBitsToFloat(largest[slot / channel_count]);
    uint bound = floatBitsToUint(most);
    if (gl_WorkGroupID.xy == uvec2(0) && subgroupElect()) d_source_bound[0] = bound;
    float scale = packed_scale(packed_exponent(bound));
    float inverse = packed_inverse(packed_exponent(d_target_bound[0]));
    vec2 means[8];
    [[unroll]] for (uint c = 0; c < 8; ++c) {
        uint channel = min(8 * EIGHT + c, channel_count - 1);
        means[c] = sums[channel] / float(size.x * size.y);
    }

    uvec2 extent = packed_size(size);
    uint eights = packed_channels(channel_count) / 8, end = chunk_end(extent.x * extent.y);
    for (uint i = chunk_begin(); i < end; i += STEP) {
        uvec2 at = uvec2(i % extent.x, i / extent.x) - 1;
        uint eight = i * eights + EIGHT;
        float d_z[8] = float[8](0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        if (at.x < size.x && at.y < size.y) {
            float n[8] = normalised(eight), d[8] = unpacked_eight(d_target[eight], inverse);
            [[unroll]] for (uint c = 0; c < 8; ++c) {
                float d_y = gamma[c] * n[c] + beta[c] > 0.0 ? d[c] : 0.0;
                d_z[c] = gamma[c] * inverse_deviation[c] * (d_y - means[c].x - n[c] * means[c].y);
            }
        }
        d_source[eight] = packed_eight(d_z, scale);
    }
}
