// What density control does with a Gaussian.

const uint FATE_PRUNE = 0;  // it goes
const uint FATE_KEEP  = 1;  // it stays as it is
const uint FATE_CLONE = 2;  // it stays, and a copy appears at a position drawn from it
const uint FATE_SPLIT = 3;  // two smaller ones at positions drawn from it take its place

// How many Gaussians come of one.
uint offspring(uint fate) { return min(fate, 2u); }

const uint PLANE_COUNT = 7;  // of include/gaussian.glsl

// Where the planes begin, and where the last ends.
uint plane_column(uint plane, uint feature_count, uint column_count) {
    const uint COLUMNS[PLANE_COUNT - 1] = uint[](
        MEANS_COLUMN, QUATS_COLUMN, LOG_SCALES_COLUMN, RAW_OPACITIES_COLUMN, DC_COLUMN, FEATURES_COLUMN
    );
    if (plane < PLANE_COUNT - 1) return COLUMNS[plane];
    return plane < PLANE_COUNT ? FEATURES_COLUMN + feature_count : column_count;
}
