#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "gaussian.glsl"
#include "densify_action.glsl"
#include "rest_layout.glsl"

//! Densify moments: one thread per Gaussian writes the moments of its children to the new planes.
//!
//! A Gaussian that is kept keeps its moments, a new one starts with zero: inherited moments in proportion to the
//! gradient cost 0.45 dB in a measurement, because two halves need large steps to separate. A dispatch goes from one
//! batch of Gaussians to one batch of the new ones. Reference: `src/reference/densify_moments.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uint gaussian_count;
    uint new_gaussian_count;
    uint column_count;
    uint feature_count;
    uint first_new_gaussian;  // new Gaussians before those of this dispatch
};

layout(binding = 0) readonly  buffer Moments    { uint moments[]; };      // planes of words of any content
layout(binding = 1) readonly  buffer Actions      { uint actions[]; };        // (gaussian_count), ACTION_*
layout(binding = 2) readonly  buffer Offsets    { uint offsets[]; };      // (gaussian_count), first output
layout(binding = 3) writeonly buffer NewMoments { uint new_moments[]; };  // planes

void main() {
    uint i = THREAD_INDEX;
    if (i >= gaussian_count) return;
    uint action = actions[i];
    for (uint copy_index = 0; copy_index < child_count(action); ++copy_index) {
        // Unsigned: Gaussians before the batch wrap beyond its end.
        uint to = offsets[i] + copy_index - first_new_gaussian;
        if (to >= new_gaussian_count) continue;
        bool begins = is_new(action, copy_index);
        for (uint plane = 0; plane < PLANE_COUNT; ++plane) {
            uint column = plane_column(plane, feature_count, column_count);
            uint width = plane_column(plane + 1, feature_count, column_count) - column;
            for (uint k = 0; k < width; ++k) {
                uint source = plane_word(plane, column, width, gaussian_count, i, k);
                uint target = plane_word(plane, column, width, new_gaussian_count, to, k);
                new_moments[target] = begins ? 0 : moments[source];
            }
        }
    }
}
