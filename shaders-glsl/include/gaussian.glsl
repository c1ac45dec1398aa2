// One Gaussian's attributes, stored as planes in one float array: all means, then all quats, and so on.
// Plane k begins at (the widths before it) * gaussian_count. `src/splats/attributes.rs` is the table.

#include "attributes.glsl"

// Reads of one Gaussian i of n from the array `parameters`, which the kernel declares.
#define LOAD_VEC3(array, column, n, i) \
    vec3(array[(column) * (n) + 3 * (i)], array[(column) * (n) + 3 * (i) + 1], array[(column) * (n) + 3 * (i) + 2])
#define LOAD_VEC4(array, column, n, i) \
    vec4(array[(column) * (n) + 4 * (i)], array[(column) * (n) + 4 * (i) + 1], \
         array[(column) * (n) + 4 * (i) + 2], array[(column) * (n) + 4 * (i) + 3])

float sigmoid(float x) { return 1.0 / (1.0 + exp(-x)); }
