#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The means of the loss terms from the partial sums of a step, into the step's slot of the log.
//!
//! One subgroup, in a fixed order. A term that is NaN or infinite raises `not_finite_flag` in the sticky status word,
//! so that the steps recorded behind this one change nothing. Reference: `src/reference/loss_log.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint  slot;                // element of `log`
    uint  l1_partial_count;    // 0: the term is not modelled and its mean is 0
    uint  ssim_partial_count;
    float mean_scale;          // 1 / (3HW)
    uint  not_finite_flag;     // bits to set in status[0]
};

struct StepLoss {
    float l1;    // mean |a - b|
    float ssim;  // mean SSIM
    uint  status;  // status[0] at the end of the loss: the step counts only if it is 0
};

layout(binding = 0) readonly  buffer L1Partials   { float l1_partials[]; };
layout(binding = 1) readonly  buffer SsimPartials { float ssim_partials[]; };
layout(binding = 2) writeonly buffer Log          { StepLoss log[]; };
layout(binding = 3)           buffer Status       { uint status[]; };

bool is_finite(float x) { return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u; }

void main() {
    float l1 = 0.0;
    for (uint i = gl_LocalInvocationID.x; i < l1_partial_count; i += SUBGROUP_SIZE) l1 += l1_partials[i];
    float ssim = 0.0;
    for (uint i = gl_LocalInvocationID.x; i < ssim_partial_count; i += SUBGROUP_SIZE) ssim += ssim_partials[i];
    StepLoss loss = StepLoss(subgroupAdd(l1) * mean_scale, subgroupAdd(ssim) * mean_scale, 0);
    if (subgroupElect()) {
        loss.status = status[0];
        if (!is_finite(loss.l1) || !is_finite(loss.ssim)) loss.status |= not_finite_flag;
        status[0] = loss.status;
        log[slot] = loss;
    }
}
