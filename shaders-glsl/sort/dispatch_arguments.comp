#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The workgroup counts of an indirect dispatch over as many items as a count on the device says.
//!
//! One thread. More than 65 535 workgroups, the most that every device takes along x, are folded into
//! rows of equal length along y; the last may be partly idle. A count beyond the capacity, left by a
//! producer that overflowed, is clamped. No items make no workgroups.

layout(local_size_x = 1) in;

layout(push_constant) uniform Params {
    uint items_per_workgroup;  // at least 1
    uint count_index;          // where in `counts` the count lives
    uint capacity;             // items
};

layout(binding = 0) readonly  buffer Counts    { uint counts[]; };
layout(binding = 1) writeonly buffer Arguments { uint arguments[][3]; };

const uint MAX_GROUPS = 65535;

void main() {
    if (THREAD_INDEX != 0) return;
    uint count = min(counts[count_index], capacity);
    uint groups = count / items_per_workgroup + uint(count % items_per_workgroup != 0);
    uint rows = groups / MAX_GROUPS + uint(groups % MAX_GROUPS != 0);
    arguments[0] = uint[3](rows == 0 ? 0 : (groups + rows - 1) / rows, rows, 1);
}
