#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "status.glsl"

//! Check capacity: one thread; more intersections than the buffers hold raise a flag that stays.
//!
//! The step then renders nothing and updates nothing; the host grows the buffers, lowers the flag and redoes it.

layout(local_size_x = 1) in;

layout(push_constant) uniform Params { uint capacity; };

layout(binding = 0) readonly buffer Total  { uint total[]; };   // [0]: intersections of all Gaussians
layout(binding = 1) writeonly buffer Counts { uint counts[]; }; // [0]: intersections to blend
layout(binding = 2) buffer Status { uint status[]; };  // [0]: not zero once something failed; [1]: most intersections

void main() {
    bool fits = total[0] <= capacity;
    counts[0] = fits ? total[0] : 0;
    if (!fits) status[0] |= STATUS_OVERFLOWED;
    status[1] = max(status[1], total[0]);
}
