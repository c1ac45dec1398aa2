#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "exposure.glsl"

//! Centres each of the EXPOSURE_WIDTH values: afterwards, its sum over the views is exactly 0.
//!
//! Values become n / QUANTA with n whole. With S the sum of n and N views, each n is reduced by floor(S / N), and the
//! first S mod N of them by one more: with integers, no rounding can drift, and the order of summation does not matter.
//! Values that are centred and within BOUND are unchanged, as is everything while status[0] is set. One subgroup per
//! value. Reference: `src/reference/exposure_center.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint view_count;
};

layout(binding = 0)           buffer Exposures { float exposures[]; };  // (views, EXPOSURE_WIDTH)
layout(binding = 1) readonly  buffer Status    { uint status[]; };

// A centred value is at most 2 BOUND; a float represents this many quanta, 2^24, exactly.
const float QUANTA = 2097152.0;
const float BOUND = 4.0;

int quanta(float x) { return int(roundEven(clamp(x, -BOUND, BOUND) * QUANTA)); }

void main() {
    uint number = gl_WorkGroupID.x;
    if (number >= EXPOSURE_WIDTH || status[0] != 0) return;
    // n = 256 h + l, 0 <= l < 256: neither sum exceeds 32 bits for fewer than 32768 views.
    ivec2 sum = ivec2(0);
    for (uint view = gl_SubgroupInvocationID; view < view_count; view += SUBGROUP_SIZE) {
        int n = quanta(exposures[view * EXPOSURE_WIDTH + number]);
        sum += ivec2(n >> 8, n & 255);
    }
    sum = subgroupAdd(sum);
    int count = int(view_count);
    // Rounds down, not towards 0: the remainder is not negative.
    int high = sum.x >= 0 ? sum.x / count : -((count - 1 - sum.x) / count);
    int left = 256 * (sum.x - high * count) + sum.y;
    int mean = 256 * high + left / count;
    uint rest = uint(left % count);
    for (uint view = gl_SubgroupInvocationID; view < view_count; view += SUBGROUP_SIZE) {
        uint at = view * EXPOSURE_WIDTH + number;
        int centred = quanta(exposures[at]) - mean - (view < rest ? 1 : 0);
        exposures[at] = float(centred) * (1.0 / QUANTA);
    }
}
