// Sums of the values of a gradient record over a subgroup.

// Space for the values of a record, an even number.
const uint RECORD_SPACE = RECORD_HEAD + MAX_CHANNELS + 1;

// From RECORD values in each lane to their sums over the lanes: lane l gets those of the values l, l + SUBGROUP_SIZE
// and so on, and zero after the last.
//
// In every round a lane keeps the values of even or odd indices, adds those of a partner, and gives it the others:
// after the first round half of the values are left, and a value takes part in about one shuffle instead of one each
// round.
void sum_record(inout float values[RECORD_SPACE]) {
    [[unroll]] for (uint turn = 0; turn < 7; turn++) {
        uint bit = 1u << turn;
        if (bit < SUBGROUP_SIZE) {
            uint count = (RECORD + bit - 1) / bit;
            bool is_odd = (gl_SubgroupInvocationID & bit) != 0;
            [[unroll]] for (uint k = 0; k < RECORD_SPACE / 2; k++) {
                if (2 * k < count) {
                    float even = values[2 * k];
                    float odd = 2 * k + 1 < count ? values[2 * k + 1] : 0.0;
                    float kept = is_odd ? odd : even;
                    float passed = is_odd ? even : odd;
                    values[k] = kept + subgroupShuffle(passed, gl_SubgroupInvocationID ^ bit);
                }
            }
        }
    }
}
