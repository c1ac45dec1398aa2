#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"
#include "norm_half.glsl"
#include "norm_channels.glsl"

//! `norm_forward` of packed maps: f' = f + relu(gamma n + beta), zeros around it.
//!
//! The bound of f' is that of f, and the most that a channel can add. Reference: `src/reference/norm_forward_half.rs`.

layout(binding = 4) readonly  buffer ShortcutBound { uint shortcut_bound[]; };
layout(binding = 5) readonly  buffer Shortcut      { uvec4 shortcut[]; };  // f, packed
layout(binding = 6) writeonly buffer TargetBound   { uint target_bound[]; };
layout(binding = 7) writeonly buffer Target        { uvec4 target[]; };    // f', packed

void main() {
    load_channels();
    float most_added = 0.0;
    for (uint channel = gl_SubgroupInvocationID; channel < channel_count; channel += SUBGROUP_SIZE) {
        precise float most = abs(values[offset + channel]) * most_normalised;
        most += abs(values[offset + channel_count + channel]);
        most_added = max(most_added, most);
    }
    uint bound = floatBitsToUint(uintBitsToFloat(shortcut_bound[0]) + subgroupMax(most_added));
    if (gl_WorkGroupID.xy == uvec2(0) && subgroupElect()) target_bound[0] = bound;
    float scale = packed_scale(packed_exponent(bound));
    float inverse = packed_inverse(packed_exponent(shortcut_bound[0]));

    uvec2 extent = packed_size(size);
    uint eights = packed_channels(channel_count) / 8, end = chunk_end(extent.x * extent.y);
    for (uint i = chunk_begin(); i < end; i += STEP) {
        uvec2 at = uvec2(i % extent.x, i / extent.x) - 1;
        uint eight = i * eights + EIGHT;
        float f[8] = float[8](0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        if (at.x < size.x && at.y < size.y) {
            float n[8] = normalised(eight);
            f = unpacked_eight(shortcut[eight], inverse);
            [[unroll]] for (uint c = 0; c < 8; ++c) f[c] += not_below_zero(gamma[c] * n[c] + beta[c]);
        }
        target[eight] = packed_eight(f, scale);
    }
}
