#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The gradient of `residual` and of the sigmoid before it: d_R_0 = -d_I = d_R where 0 <= R_0 - N <= 1, else 0.
//!
//! d_v = d_I u (1 - u) is that of the sigmoid's input. In the identity variant d_I = -d_u = d_R, without a sigmoid.
//! Reference: `src/reference/residual_backward.rs`.

layout(local_size_x = 256) in;
layout(constant_id = 0) const bool IDENTITY = false;

layout(push_constant) uniform Params {
    uint value_count;  // 3HW
};

layout(binding = 0) readonly  buffer Render      { float render[]; };         // R_0, (3, H, W)
layout(binding = 1) readonly  buffer StageInput  { float stage_input[]; };    // I, (3, H, W)
layout(binding = 2) readonly  buffer Update      { float update[]; };         // u, (3, H, W)
layout(binding = 3) readonly  buffer DDenoised   { float d_denoised[]; };     // d_R, (3, H, W)
layout(binding = 4) writeonly buffer DUpdate     { float d_update[]; };       // d_v or d_u, (3, H, W)
layout(binding = 5) writeonly buffer DStageInput { float d_stage_input[]; };  // d_I of this path, (3, H, W)
layout(binding = 6)           buffer DRender     { float d_render[]; };       // d_R_0, added to, (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= value_count) return;
    float d = d_denoised[i];
    if (IDENTITY) {
        d_update[i] = -d;
        d_stage_input[i] = d;
        return;
    }
    float u = update[i];
    float difference = render[i] - (stage_input[i] + u);
    d = difference >= 0.0 && difference <= 1.0 ? d : 0.0;
    d_update[i] = -d * u * (1.0 - u);
    d_stage_input[i] = -d;
    d_render[i] += d;
}
