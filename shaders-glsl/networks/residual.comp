#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "finite.glsl"

//! The end of a denoiser stage, one thread per value: N = I + u, R = clamp(R_0 - N, 0, 1); in the identity variant R =
//! I - u.
//!
//! Reference: `src/reference/residual.rs`.

layout(local_size_x = 256) in;
layout(constant_id = 0) const bool IDENTITY = false;  // no gradient vanishes in a clamp

layout(push_constant) uniform Params {
    uint value_count;  // 3HW
};

layout(binding = 0) readonly  buffer Render     { float render[]; };       // R_0, (3, H, W)
layout(binding = 1) readonly  buffer StageInput { float stage_input[]; };  // I, (3, H, W)
layout(binding = 2) readonly  buffer Update     { float update[]; };       // u, (3, H, W)
layout(binding = 3) writeonly buffer Denoised   { float denoised[]; };     // R, (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= value_count) return;
    if (IDENTITY) {
        denoised[i] = stage_input[i] - update[i];
        return;
    }
    float difference = render[i] - (stage_input[i] + update[i]);
    denoised[i] = within_unit(difference);
}
