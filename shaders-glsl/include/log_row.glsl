// The row of the log for a step, for a kernel that declares `log`, `statuses` and `status`, the parameters `slot`,
// `term_count` and `terms`, and SUBGROUP_SIZE lanes.

#include "status.glsl"

bool is_finite(float x) { return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u; }

// Loads in flight.
const uint AHEAD = 8;

// Adds a lane's part of the first `count` partial sums of a term to `sum`, in order.
#define ADD_PARTIALS(partials, count, sum) \
    for (uint i = gl_LocalInvocationID.x; i < count; i += AHEAD * SUBGROUP_SIZE) { \
        float ahead[AHEAD]; \
        [[unroll]] for (uint k = 0; k < AHEAD; k++) ahead[k] = partials[min(i + k * SUBGROUP_SIZE, count - 1)]; \
        [[unroll]] for (uint k = 0; k < AHEAD; k++) sum += i + k * SUBGROUP_SIZE < count ? ahead[k] : 0.0; \
    }

// Writes the means of two terms, those that the model has. One that is NaN or infinite sets a sticky flag in the status
// word, so that later steps of the recording change nothing.
void write_row(vec2 means, bvec2 are_terms) {
    if (are_terms.x) log[slot * term_count + terms.x] = means.x;
    if (are_terms.y) log[slot * term_count + terms.y] = means.y;
    uint word = status[0];
    if (!is_finite(means.x) || !is_finite(means.y)) word |= STATUS_NOT_FINITE;
    status[0] = word;
    status[3] = word;
    statuses[slot] = word;
}
