// SH coefficients above degree 0 as 16-bit floats, two in a word: a Gaussian's follow each other, and where their
// number is odd, the last is alone. `src/splats/packed_sh.rs` is the host's.

// Below it a 16-bit float is subnormal, which some devices flush: of these there is none but 0.
const float SMALLEST_HALF = 6.103515625e-05;
const float LARGEST_HALF = 65504.0;

// Words of this many coefficients.
uint words_of(uint coefficients) { return (coefficients + 1) / 2; }

// A multiple of the unit of 16-bit floats, up or down as `chance` has it, so that the mean stays: to the nearest, steps
// of less than half a unit would lead nowhere.
vec4 rounded_by_chance(vec4 x, uvec4 chance) {
    uvec4 exponent = floatBitsToUint(x) & 0x7f800000u;
    uvec4 smallest = uvec4(floatBitsToUint(SMALLEST_HALF));
    vec4 unit = uintBitsToFloat(mix(exponent - (10u << 23), smallest, lessThan(exponent, smallest)));
    vec4 share = vec4(chance >> 19) / 8192.0;
    return clamp(floor(x / unit + share) * unit, -LARGEST_HALF, LARGEST_HALF);
}
