#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"

//! The gradients of w_o mean sigmoid(o) + w_s mean exp(s) + w_a mean max(max s - min s - ln r, 0) with respect to the
//! raw opacities o and the logarithms s of the standard deviations, added to the existing ones, and partial sums of the
//! three terms. A frozen attribute has no gradient.
//!
//! A thread processes `GAUSSIANS_PER_THREAD` Gaussians, one subgroup apart. A weight of 0 leaves the gradients
//! unchanged. Reference: `src/reference/parameter_terms.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint GAUSSIANS_PER_THREAD = 8;

layout(push_constant) uniform Params {
    uint  gaussian_count;   // of the batch
    float opacity_scale;    // w_o / N, N the Gaussians of all batches
    float log_scale_scale;  // w_s / (3N)
    float ratio_scale;      // w_a / N
    float log_ratio;        // ln r, the logarithm of the largest ratio without a loss
};

layout(binding = 0) readonly  buffer Parameters      { float parameters[]; };        // planes of the batch
layout(binding = 1)           buffer Gradients       { float gradients[]; };         // its trained planes
layout(binding = 2) writeonly buffer OpacityPartials { float opacity_partials[]; };  // one per workgroup
layout(binding = 3) writeonly buffer ScalePartials   { float scale_partials[]; };    // one per workgroup
layout(binding = 4) writeonly buffer RatioPartials   { float ratio_partials[]; };    // one per workgroup

#include "trained.glsl"

void main() {
    uint first = WORKGROUP_INDEX * SUBGROUP_SIZE * GAUSSIANS_PER_THREAD;
    if (first >= gaussian_count) return;
    first += gl_LocalInvocationID.x;
    float opacities = 0.0, scales = 0.0, ratios = 0.0;
    for (uint k = 0; k < GAUSSIANS_PER_THREAD; ++k) {
        uint i = first + k * SUBGROUP_SIZE;
        if (i >= gaussian_count) break;
        uint at = RAW_OPACITIES_COLUMN * gaussian_count + i;
        float opacity = sigmoid(parameters[at]);
        opacities += opacity;
        if (opacity_scale > 0.0 && is_trained(RAW_OPACITIES_COLUMN)) {
            gradients[trained_place(at)] += opacity_scale * opacity * (1.0 - opacity);
        }
        uint first_axis = LOG_SCALES_COLUMN * gaussian_count + 3 * i;
        uint longest = 0, shortest = 0;
        for (uint axis = 0; axis < 3; ++axis) {
            at = first_axis + axis;
            float scale = exp(parameters[at]);
            scales += scale;
            if (log_scale_scale > 0.0 && is_trained(LOG_SCALES_COLUMN)) {
                gradients[trained_place(at)] += log_scale_scale * scale;
            }
            if (parameters[at] > parameters[first_axis + longest]) longest = axis;
            if (parameters[at] < parameters[first_axis + shortest]) shortest = axis;
        }
        float excess = parameters[first_axis + longest] - parameters[first_axis + shortest] - log_ratio;
        if (excess > 0.0) {
            ratios += excess;
            if (ratio_scale > 0.0 && is_trained(LOG_SCALES_COLUMN)) {
                gradients[trained_place(first_axis + longest)] += ratio_scale;
                gradients[trained_place(first_axis + shortest)] -= ratio_scale;
            }
        }
    }
    opacities = subgroupAdd(opacities);
    scales = subgroupAdd(scales);
    ratios = subgroupAdd(ratios);
    if (subgroupElect()) {
        opacity_partials[WORKGROUP_INDEX] = opacities;
        scale_partials[WORKGROUP_INDEX] = scales;
        ratio_partials[WORKGROUP_INDEX] = ratios;
    }
}
