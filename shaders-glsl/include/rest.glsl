// SH coefficients above degree 0, for a kernel that declares `parameters` with their constants and counts.

#include "half.glsl"

// The k-th coefficient of Gaussian i, from 1; that of degree 0 is not included.
vec3 rest_coefficient(uint i, uint k) {
    uint plane = (FEATURES_COLUMN + FEATURE_COUNT) * gaussian_count;
    uint own = 3 * (sh_count(SH_DEGREE) - 1);
    uint first = 3 * (k - 1);
    if (HALF_REST) {
        uint word = plane + words_of(own) * i + first / 2;
        vec2 low = unpackHalf2x16(floatBitsToUint(parameters[word]));
        vec2 high = unpackHalf2x16(floatBitsToUint(parameters[word + 1]));
        return (first & 1) == 0 ? vec3(low, high.x) : vec3(low.y, high);
    }
    uint at = plane + own * i + first;
    return vec3(parameters[at], parameters[at + 1], parameters[at + 2]);
}
