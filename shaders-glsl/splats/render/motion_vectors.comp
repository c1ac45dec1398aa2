#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "moving_point.glsl"
#include "pixels.glsl"

//! Motion vectors: from each pixel to where its point was seen in the frame before, in pixels.
//!
//! The point of a pixel p is at its depth z in the view, x = ((p - c) / f z, z), or ((p - c) / f, z) of an orthographic
//! camera; before, it was at M x, and seen at p' = f' (M x).xy / (M x).z + c'. M is that of the instance of the picked
//! splat, or of the world. Where nothing is seen, the point is infinitely far, and what was behind the camera has not
//! moved.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uvec2 size;
    uint  depth_plane;     // of the render
    uint  is_mean;         // 1: the depths are weighted sums, else medians
    uint  is_orthographic;
    uint  mover_count;     // the world, and instances
    uint  storage;         // STORED_HALVES or STORED_FLOATS
    vec2  focal;
    vec2  principal_point;
    vec2  focal_before;
    vec2  principal_point_before;
};

layout(binding = 0) readonly  buffer Render { float render[]; };  // (channels, H, W)
layout(binding = 1) readonly  buffer Transmittances { float transmittances[]; };  // (H, W)
layout(binding = 2) readonly  buffer Picks  { uint picks[]; };    // (H, W, 2) of `pick_splats`, read with instances
layout(binding = 3) readonly  buffer Movers { MovingPoints movers[]; };  // (mover_count) ascending from the second on
layout(binding = 4) writeonly buffer Pixels { uint pixels[]; };   // (H, W, words)

const float NOTHING_SEEN = 3.3e38;
const uint NO_SPLAT = 0xffffffffu;

uint mover_of(uint splat) {
    if (splat == NO_SPLAT) return 0;
    uint low = 0, high = mover_count;
    while (low + 1 < high) {
        uint middle = (low + high) / 2;
        if (movers[middle].first <= splat) low = middle;
        else high = middle;
    }
    return low;
}

void main() {
    uint at = THREAD_INDEX;
    if (at >= size.x * size.y) return;
    float depth = render[depth_plane * size.x * size.y + at];
    float alpha = 1.0 - transmittances[at];
    if (is_mean != 0) depth = alpha > 0.0 ? depth / alpha : NOTHING_SEEN;
    bool is_seen = depth < NOTHING_SEEN;
    uint mover = is_seen && mover_count > 1 ? mover_of(picks[2 * at]) : 0;

    vec2 pixel = vec2(at % size.x, at / size.x) + 0.5;
    vec2 slope = (pixel - principal_point) / focal;
    vec4 point = is_seen ? vec4(slope * depth, depth, 1.0) : vec4(slope, 1.0, 0.0);
    if (is_orthographic != 0) point = vec4(slope, is_seen ? depth : 0.0, 1.0);
    vec3 before = movers[mover].before_from_now * point;
    float scale = is_orthographic != 0 ? 1.0 : before.z;
    vec2 motion = vec2(0.0);
    if (scale > 0.0) motion = focal_before * before.xy / scale + principal_point_before - pixel;
    if (storage == STORED_HALVES) {
        pixels[at] = packHalf2x16(clamp(motion, -65504.0, 65504.0));
    } else {
        pixels[2 * at] = floatBitsToUint(motion.x);
        pixels[2 * at + 1] = floatBitsToUint(motion.y);
    }
}
