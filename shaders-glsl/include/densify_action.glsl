// The action of density control on a Gaussian, and its constants.

const uint ACTION_PRUNE = 0;  // the Gaussian is removed
const uint ACTION_KEEP  = 1;  // unchanged
const uint ACTION_CLONE = 2;  // kept, with a copy at a random position within it
const uint ACTION_SPLIT = 3;  // replaced by two smaller ones

// The number of Gaussians after an action.
uint child_count(uint action) { return min(action, 2u); }

// Whether a copy is another Gaussian than its parent.
bool is_new(uint action, uint copy_index) { return action == ACTION_SPLIT || copy_index > 0; }

// Keys sort candidates by decreasing gradient, then Gaussians to keep, then Gaussians to prune.
const uint KEY_TOP   = 0x7f800000;  // the bits of an infinite gradient: a candidate's key is this minus its own bits
const uint KEY_KEEP  = 0x80000000;
const uint KEY_PRUNE = 0x80000001;

// Indices of the counters of a round.
const uint COUNTER_CANDIDATES = 0;
const uint COUNTER_PRUNED     = 1;
const uint COUNTER_CLONED     = 2;
const uint COUNTER_SPLIT      = 3;
const uint COUNTER_WORDS      = 4;

// The paper's split: 1 / 1.6 of the scale (Kerbl et al. 2023).
const float PAPER_LOG_SPLIT_FACTOR = 0.47000362924573558;  // ln 1.6

// The conserving split along the longest axis, for opacity o and in standard deviations of the parent: centres at
// +-OFFSET; scales and opacity are constants + slopes times o, the opacity as a fraction of o. Fitted by least squares
// of the composited alpha over all viewing directions (docs/measurements.md).
const float SPLIT_OFFSET        = 0.5;
const float SPLIT_ALONG         = 0.866;  // sqrt(1 - OFFSET^2): the pair keeps the parent's variance for small o
const float SPLIT_ALONG_SLOPE   = -0.105;
const float SPLIT_ACROSS        = 0.993;
const float SPLIT_ACROSS_SLOPE  = -0.063;
const float SPLIT_OPACITY       = 0.565;
const float SPLIT_OPACITY_SLOPE = 0.2;

// The axis of a conserving split: the longest, the first of equally long ones.
uint longest_axis(vec3 log_scales) {
    float longest = max(log_scales.x, max(log_scales.y, log_scales.z));
    return log_scales.x == longest ? 0 : log_scales.y == longest ? 1 : 2;
}

// A column by choices between names: an index that is no constant moves the matrix to memory.
vec3 axis_of(mat3 axes, uint axis) {
    vec3 last_two = axis == 1 ? axes[1] : axes[2];
    return axis == 0 ? axes[0] : last_two;
}
