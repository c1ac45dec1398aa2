#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "random.glsl"

//! The regions in which depths are correlated in one step: the view, and random boxes of one size.
//!
//! One thread per region. A box's corner is uniform in [0, width - side) x [0, height - side); the same key gives the
//! same boxes. Reference: `src/reference/depth_boxes.rs`.

layout(local_size_x = 64) in;

layout(push_constant) uniform Params {
    uvec2 size;       // of the view, pixels
    uint  side;       // of a box, pixels
    uint  box_count;
    uint  key;        // of the step
};

// (1 + box_count,), first column and row, width, height
layout(binding = 0) writeonly buffer Regions { uvec4 regions[]; };

// Uniform in [0, range), 0 for an empty range.
uint draw(uint at, uint range) {
    uint high, low;
    umulExtended(random_bits(key + at), range, high, low);
    return high;
}

void main() {
    uint i = THREAD_INDEX;
    if (i > box_count) return;
    regions[i] = i == 0 ? uvec4(0, 0, size) : uvec4(draw(2 * i, size.x - side), draw(2 * i + 1, size.y - side),
        side, side);
}
