#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "exposure.glsl"

//! Expose: what the exposure of a view makes of a render's colours, one thread per value.
//!
//! Reference: `src/reference/expose.rs`.

layout(local_size_x = 256) in;

layout(push_constant) uniform Params {
    uint pixel_count;  // of a channel
    uint view;
};

layout(binding = 0) readonly  buffer Exposures { float exposures[]; };  // (views, EXPOSURE_WIDTH)
layout(binding = 1) readonly  buffer Render    { float render[]; };     // (3, H, W) and more, not clamped
layout(binding = 2) writeonly buffer Exposed   { float exposed[]; };    // (3, H, W)

void main() {
    uint i = THREAD_INDEX;
    if (i >= 3 * pixel_count) return;
    uint at = view * EXPOSURE_WIDTH + i / pixel_count;
    exposed[i] = (1.0 + exposures[at]) * render[i] + BIAS_SCALE * exposures[at + 3];
}
