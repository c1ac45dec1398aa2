// Sums of the values of a gradient record over a subgroup: by shuffles, or some records at a time in shared memory.

// Space for the values of a record, an even number.
const uint RECORD_SPACE = RECORD_HEAD + MAX_CHANNELS;

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

// 1: in shared memory, for splats that wait there; 0: by shuffles.
layout(constant_id = 16) const uint SUMS_IN_SHARED_MEMORY = 0;
// Records that are summed at a time: a lane sums one value of one of them, or several of a record that has more values
// than a subgroup has lanes.
const uint FITTING_ROWS = SUBGROUP_SIZE / RECORD;
const uint ROWS = FITTING_ROWS + 1 / (FITTING_ROWS + 1);
// The values of all lanes, and four more words, so that eight lanes that load sixteen bytes each use all banks.
const uint ROW_VECTORS = SUBGROUP_SIZE / 4 + 1;
// (parts, ROWS, RECORD, ROW_VECTORS)
shared vec4 record_rows[SUMS_IN_SHARED_MEMORY * SUBGROUPS_PER_TILE * ROWS * RECORD * ROW_VECTORS + 1];

// `value` counts those of all rows.
uint row_at(uint value) { return (gl_SubgroupID * ROWS * RECORD + value) * ROW_VECTORS; }

void put_row(uint row, float values[RECORD_SPACE]) {
    uint lane = gl_SubgroupInvocationID;
    [[unroll]] for (uint i = 0; i < RECORD; i++) record_rows[row_at(row * RECORD + i) + lane / 4][lane % 4] = values[i];
}

// The sum over the lanes, in a fixed order.
float row_sum(uint value) {
    uint at = row_at(value);
    vec4 sum = record_rows[at];
    [[unroll]] for (uint k = 1; k < SUBGROUP_SIZE / 4; k++) sum += record_rows[at + k];
    return (sum.x + sum.y) + (sum.z + sum.w);
}
