// Bounds that keep a NaN. A compiler may assume that no float is NaN, and NVIDIA's does: it turns `x < 0.0 ? 0.0 : x`
// into a maximum, which hides one. A test of the bits is not its to simplify.

bool is_nan(float x) { return (floatBitsToUint(x) & 0x7fffffffu) > 0x7f800000u; }

float not_below_zero(float x) { return is_nan(x) ? x : x < 0.0 ? 0.0 : x; }

float within_unit(float x) { return is_nan(x) ? x : x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }
