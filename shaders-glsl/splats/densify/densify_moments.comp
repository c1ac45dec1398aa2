#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "densify_action.glsl"

//! Densify moments: one thread per Gaussian writes the moments of its children to the new planes.
//!
//! One that stays keeps its moments, a new one begins with zero: moments inherited in the proportion of the gradient
//! were measured to cost 0.45 dB, because two halves need large steps to part. A dispatch goes from one batch of
//! Gaussians to one batch of the new. Reference: `src/reference/densify_moments.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint gaussian_count;
    uint new_gaussian_count;
    uint column_count;
    uint feature_count;
    uint first_new_gaussian;  // how many of the new lie before those of this dispatch
};

layout(binding = 0) readonly  buffer Moments    { uint moments[]; };      // planes, of whatever a word holds
layout(binding = 1) readonly  buffer Actions      { uint actions[]; };        // (gaussian_count), FATE_*
layout(binding = 2) readonly  buffer Offsets    { uint offsets[]; };      // (gaussian_count), first output
layout(binding = 3) writeonly buffer NewMoments { uint new_moments[]; };  // planes

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    uint action = actions[i];
    for (uint copy_index = 0; copy_index < child_count(action); ++copy_index) {
        // Unsigned: what lies before the batch wraps beyond its end.
        uint to = offsets[i] + copy_index - first_new_gaussian;
        if (to >= new_gaussian_count) continue;
        bool begins = is_new(action, copy_index);
        for (uint plane = 0; plane < PLANE_COUNT; ++plane) {
            uint column = plane_column(plane, feature_count, column_count);
            uint width = plane_column(plane + 1, feature_count, column_count) - column;
            uint source = column * gaussian_count + width * i;
            uint target = column * new_gaussian_count + width * to;
            for (uint k = 0; k < width; ++k) new_moments[target + k] = begins ? 0 : moments[source + k];
        }
    }
}
