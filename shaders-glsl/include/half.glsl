// SH coefficients above degree 0 as 16-bit floats, two per word, Gaussian by Gaussian; an odd last one has its own
// word. `src/splats/packed_sh.rs` is the host side.

// Smaller 16-bit floats are subnormal, which some devices flush: only 0 is used instead.
const float SMALLEST_HALF = 6.103515625e-05;
const float LARGEST_HALF = 65504.0;

// Words for this many coefficients.
uint words_of(uint coefficients) { return (coefficients + 1) / 2; }

// Rounds to a multiple of the unit of 16-bit floats, up or down depending on `chance`, which preserves the mean: with
// rounding to nearest, steps below half a unit would have no effect.
vec4 rounded_by_chance(vec4 x, uvec4 chance) {
    uvec4 exponent = floatBitsToUint(x) & 0x7f800000u;
    uvec4 smallest = uvec4(floatBitsToUint(SMALLEST_HALF));
    vec4 unit = uintBitsToFloat(mix(exponent - (10u << 23), smallest, lessThan(exponent, smallest)));
    vec4 share = vec4(chance >> 19) / 8192.0;
    return clamp(floor(x / unit + share) * unit, -LARGEST_HALF, LARGEST_HALF);
}
