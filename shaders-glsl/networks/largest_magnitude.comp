#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The largest magnitude of some values, as bits, into a word that was 0; a subgroup processes CHUNK of them.
//! Magnitudes are ordered like their bits as integers, so the order of the threads does not matter; a NaN is larger
//! than every number.
//!
//! Reference: `src/reference/largest_magnitude.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;
layout(constant_id = 0) const uint CHUNK = 1024;

layout(push_constant) uniform Params {
    uint offset;       // of the first in `values`
    uint value_count;
};

layout(binding = 0) readonly buffer Values  { float values[]; };
layout(binding = 1)          buffer Largest { uint largest[]; };  // one

void main() {
    uint first = WORKGROUP_INDEX * CHUNK;
    uint end = min(first + CHUNK, value_count);
    uint largest_seen = 0;
    for (uint i = first + gl_SubgroupInvocationID; i < end; i += SUBGROUP_SIZE)
        largest_seen = max(largest_seen, floatBitsToUint(values[offset + i]) & 0x7fffffffu);
    largest_seen = subgroupMax(largest_seen);
    if (subgroupElect() && largest_seen > 0) atomicMax(largest[0], largest_seen);
}
