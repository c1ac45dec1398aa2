#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"

//! The means of two loss terms from their partial sums, into the step's slot of the log.
//!
//! One subgroup, in a fixed order. Reference: `src/reference/loss_log.rs`.

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

#include "log_row.glsl"

void main() {
    vec2 sums = vec2(0.0);
    ADD_PARTIALS(first_partials, partial_counts.x, sums.x)
    ADD_PARTIALS(second_partials, partial_counts.y, sums.y)
    vec2 means = vec2(subgroupAdd(sums.x), subgroupAdd(sums.y)) * mean_scales;
    if (subgroupElect()) write_row(means, greaterThan(partial_counts, uvec2(0)));
}
