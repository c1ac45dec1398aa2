// SH coefficients above degree 0, for a kernel that declares `parameters` with their constants and counts,
// and includes include/rotation.glsl.

#include "half.glsl"
#include "rest_layout.glsl"

const uint REST_COLUMN = FEATURES_COLUMN + FEATURE_COUNT;

// Their number, all channels.
uint rest_width() { return 3 * (sh_count(SH_DEGREE) - 1); }

// The k-th coefficient of Gaussian i, from 1; that of degree 0 is not included.
vec3 rest_coefficient(uint i, uint k) {
    uint width = rest_width();
    uint first = 3 * (k - 1);
    if (HALF_REST) {
        uint words = words_of(width);
        uint low_word = rest_word(REST_COLUMN, words, gaussian_count, i, first / 2);
        uint high_word = rest_word(REST_COLUMN, words, gaussian_count, i, first / 2 + 1);
        vec2 low = unpackHalf2x16(floatBitsToUint(parameters[low_word]));
        vec2 high = unpackHalf2x16(floatBitsToUint(parameters[high_word]));
        return (first & 1) == 0 ? vec3(low, high.x) : vec3(low.y, high);
    }
    uint at = rest_word(REST_COLUMN, width, gaussian_count, i, first);
    uint stride = REST_BY_COLUMN ? gaussian_count : 1;
    return vec3(parameters[at], parameters[at + stride], parameters[at + 2 * stride]);
}

// From the camera to a Gaussian. `precise`, here and below: two kernels get the same gradients of the coefficients.
vec3 offset_from_camera(vec3 mean, mat4x3 view_from_world) {
    vec3 shift = view_from_world[3];
    precise vec3 offset;
    for (uint axis = 0; axis < 3; axis++) {
        vec3 row = view_from_world[axis];
        offset[axis] = mean[axis] + (row.x * shift.x + row.y * shift.y + row.z * shift.z);
    }
    return offset;
}

// The viewing direction of a Gaussian at `offset` from the camera, and the distance in `scale` times world units.
vec3 direction_of(vec3 offset, out float scale, out float distance) {
    scale = finite_scale(length(offset));
    precise vec3 scaled = scale * offset;
    precise float squared = scaled.x * scaled.x + scaled.y * scaled.y + scaled.z * scaled.z;
    distance = max(sqrt(squared), 1e-12);
    precise vec3 direction = scaled / distance;
    return direction;
}
