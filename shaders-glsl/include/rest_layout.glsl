// How the plane of the SH coefficients above degree 0, the last one, is stored. `src/splats/batches.rs` has the rule.

// Word by word, each for all Gaussians, so that neighbouring lanes access neighbouring words; else Gaussian by
// Gaussian.
layout(constant_id = 12) const bool REST_BY_COLUMN = false;

// Word k of Gaussian i of n, with `width` words each, in the plane that begins with column `column`.
uint rest_word(uint column, uint width, uint n, uint i, uint k) {
    return REST_BY_COLUMN ? (column + k) * n + i : column * n + width * i + k;
}

// The same for any plane of include/gaussian.glsl.
uint plane_word(uint plane, uint column, uint width, uint n, uint i, uint k) {
    return plane + 1 == PLANE_COUNT ? rest_word(column, width, n, i, k) : column * n + width * i + k;
}
