// One Gaussian's attributes, stored as planes in one float array: all means, then all quats, and so on.
// Plane k begins at (the widths before it) * gaussian_count. `crates/models/src/attributes.rs` is the table.

const uint MEANS_COLUMN = 0;  // x, y, z in the world
const uint QUATS_COLUMN = 3;  // w, x, y, z, not normalised
const uint LOG_SCALES_COLUMN = 7;  // ln of the standard deviations
const uint RAW_OPACITIES_COLUMN = 10;  // before the sigmoid
const uint DC_COLUMN = 11;  // SH degree 0, RGB
const uint FEATURES_COLUMN = 14;  // blended values in addition to colour

// Where a plane begins; plane PLANE_COUNT is where the last ends.
const uint PLANE_COUNT = 7;
uint plane_column(uint plane, uint feature_count, uint column_count) {
    const uint COLUMNS[PLANE_COUNT - 1] = uint[](
        MEANS_COLUMN, QUATS_COLUMN, LOG_SCALES_COLUMN, RAW_OPACITIES_COLUMN, DC_COLUMN, FEATURES_COLUMN);
    if (plane < PLANE_COUNT - 1) return COLUMNS[plane];
    return plane < PLANE_COUNT ? FEATURES_COLUMN + feature_count : column_count;
}

// Reads of one Gaussian i of n from the array `parameters`, which the kernel declares.
#define LOAD_VEC3(array, column, n, i) \
    vec3(array[(column) * (n) + 3 * (i)], array[(column) * (n) + 3 * (i) + 1], array[(column) * (n) + 3 * (i) + 2])
#define LOAD_VEC4(array, column, n, i) \
    vec4(array[(column) * (n) + 4 * (i)], array[(column) * (n) + 4 * (i) + 1], \
         array[(column) * (n) + 4 * (i) + 2], array[(column) * (n) + 4 * (i) + 3])

float sigmoid(float x) { return 1.0 / (1.0 + exp(-x)); }
