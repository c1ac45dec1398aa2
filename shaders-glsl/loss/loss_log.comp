#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "status.glsl"

//! The means of two loss terms from their partial sums, into the step's slot of the log.
//!
//! One subgroup, in a fixed order. A term that is NaN or infinite sets a sticky flag in the status word, so that later
//! steps of the recording change nothing. Reference: `src/reference/loss_log.rs`.

layout(local_size_x_id = 100) in;
layout(constant_id = 100) const uint SUBGROUP_SIZE = 8;

layout(push_constant) uniform Params {
    uint  slot;            // row of `log`
    uint  term_count;      // columns of `log`
    uvec2 terms;           // a column each
    uvec2 partial_counts;  // 0: the model lacks the term, and its column is unchanged
    vec2  mean_scales;     // 1 / (number of values in the mean)
};

layout(binding = 0) readonly  buffer FirstPartials  { float first_partials[]; };
layout(binding = 1) readonly  buffer SecondPartials { float second_partials[]; };
layout(binding = 2) writeonly buffer Log            { float log[]; };       // (slots, term_count)
layout(binding = 3) writeonly buffer Statuses       { uint statuses[]; };   // (slots,), status[0] after the step
layout(binding = 4)           buffer Status         { uint status[]; };

bool is_finite(float x) { return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u; }

// Loads in flight.
const uint AHEAD = 8;

// A lane's part of the sum of the first `count` partial sums of a term, in order.
#define SUM(partials, count, sum) \
    for (uint i = gl_LocalInvocationID.x; i < count; i += AHEAD * SUBGROUP_SIZE) { \
        float ahead[AHEAD]; \
        [[unroll]] for (uint k = 0; k < AHEAD; k++) ahead[k] = partials[min(i + k * SUBGROUP_SIZE, count - 1)]; \
        [[unroll]] for (uint k = 0; k < AHEAD; k++) sum += i + k * SUBGROUP_SIZE < count ? ahead[k] : 0.0; \
    }

void main() {
    float first = 0.0, second = 0.0;
    SUM(first_partials, partial_counts.x, first)
    SUM(second_partials, partial_counts.y, second)
    first = subgroupAdd(first) * mean_scales.x;
    second = subgroupAdd(second) * mean_scales.y;
    if (subgroupElect()) {
        if (partial_counts.x > 0) log[slot * term_count + terms.x] = first;
        if (partial_counts.y > 0) log[slot * term_count + terms.y] = second;
        uint word = status[0];
        if (!is_finite(first) || !is_finite(second)) word |= STATUS_NOT_FINITE;
        status[0] = word;
        status[3] = word;
        statuses[slot] = word;
    }
}
