#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "exposure.glsl"

//! Expose: applies the exposure of a view to a render's colours, or its inverse, one thread per value.
//!
//! Like the photograph, what is brighter than its white is clipped there: e = min(gain c + bias, t) where the target t
//! is clipped. So a clipped highlight takes its brightness from views that are exposed less.
//!
//! Reference: `src/reference/expose.rs`.

layout(local_size_x = 256) in;
layout(constant_id = 0) const bool INVERSE = false;  // from the view's exposure to the model's

layout(push_constant) uniform Params {
    uint pixel_count;  // of a channel
    uint view;
};

layout(binding = 0) readonly  buffer Exposures { float exposures[]; };  // (views, EXPOSURE_WIDTH)
layout(binding = 1) readonly  buffer Whites    { float whites[]; };     // (views, 3), the target of white
layout(binding = 2) readonly  buffer Render    { float render[]; };     // (3, H, W) and more, not clamped
layout(binding = 3) readonly  buffer Target    { float target[]; };     // (3, H, W)
layout(binding = 4) writeonly buffer Exposed   { float exposed[]; };    // (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= 3 * pixel_count) return;
    uint channel = i / pixel_count;
    uint at = view * EXPOSURE_WIDTH + channel;
    float gain = exp(exposures[at]);
    float bias = BIAS_SCALE * exposures[at + 3];
    if (INVERSE) {
        exposed[i] = (render[i] - bias) / gain;
        return;
    }
    float e = gain * render[i] + bias;
    float t = target[i];
    // Written so that a NaN remains one.
    exposed[i] = e > t && is_clipped(t, whites[3 * view + channel]) ? t : e;
}
