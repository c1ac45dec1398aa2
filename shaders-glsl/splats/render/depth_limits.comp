#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "pixels.glsl"

//! Depth limits: converts a host's depth image to the depths in the view beyond which everything is hidden.
//!
//! With e = d where depth is reversed and 1 - d else: z = near far / (near + e (far - near)), and z = near / e before
//! an infinite far plane. An orthographic camera has z = far - e (far - near). At e = 0 the host drew nothing, and
//! nothing is hidden.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uint  pixel_count;
    uint  format;       // DEPTH_*
    uint  is_reversed;
    uint  is_linear;    // 1: the values are depths in the view
    uint  is_orthographic;
    float near;         // world units
    float far;          // 0: infinite
};

layout(binding = 0) readonly  buffer Words  { uint words[]; };
layout(binding = 1) writeonly buffer Limits { float limits[]; };

const float NO_DEPTH = 3.4e38;

float stored_depth(uint at) {
    if (format == DEPTH_16) return float(words[at / 2] >> 16 * (at % 2) & 0xffffu) / 65535.0;
    if (format == DEPTH_24) return float(words[at] & 0xffffffu) / 16777215.0;
    return uintBitsToFloat(words[at]);
}

void main() {
    uint at = THREAD_INDEX;
    if (at >= pixel_count) return;
    float depth = stored_depth(at);
    if (is_linear != 0) {
        limits[at] = depth;
        return;
    }
    float e = is_reversed != 0 ? depth : 1.0 - depth;
    float z = far > 0.0 ? near * far / (near + e * (far - near)) : near / e;
    if (is_orthographic != 0) z = far - e * (far - near);
    // Positive phrasing: a NaN hides nothing.
    limits[at] = e > 0.0 ? z : NO_DEPTH;
}
