// One Gaussian's attributes, stored as planes in one float array: all means, then all quats, and so on.
// Plane k begins at (the widths before it) * gaussian_count. `scene::ATTRIBUTES` is the host side.

const uint MEANS_COLUMN         = 0;   // 3: x, y, z in the world
const uint QUATS_COLUMN         = 3;   // 4: w, x, y, z, not normalised
const uint LOG_SCALES_COLUMN    = 7;   // 3: ln of the standard deviations
const uint RAW_OPACITIES_COLUMN = 10;  // 1: before the sigmoid
const uint DC_COLUMN            = 11;  // 3: SH degree 0, RGB
const uint FEATURES_COLUMN      = 14;  // as many as the scene has, 0 to 8: what is blended beside colour
// Behind the features: 3 ((degree + 1)^2 - 1): SH above degree 0, coefficient-major, RGB

// Reads of one Gaussian i of n from the array `parameters`, which the kernel declares.
#define LOAD_VEC3(array, column, n, i) \
    vec3(array[(column) * (n) + 3 * (i)], array[(column) * (n) + 3 * (i) + 1], array[(column) * (n) + 3 * (i) + 2])
#define LOAD_VEC4(array, column, n, i) \
    vec4(array[(column) * (n) + 4 * (i)], array[(column) * (n) + 4 * (i) + 1], \
         array[(column) * (n) + 4 * (i) + 2], array[(column) * (n) + 4 * (i) + 3])

float sigmoid(float x) { return 1.0 / (1.0 + exp(-x)); }
