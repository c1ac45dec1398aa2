// A step of Adam for four values (Kingma and Ba 2015), independent of their storage.

#include "random.glsl"

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;
// Its square is finite: an infinite second moment would freeze its parameter for good.
const float GRADIENT_BOUND = 1e18;

// Exponential moving averages of gradients and of squared gradients.
struct Moments {
    vec4 first;
    vec4 second;
};

// Written so that an infinite or NaN gradient fails.
vec4 clamp_gradient(vec4 gradient) {
    vec4 bounded = clamp(gradient, -GRADIENT_BOUND, GRADIENT_BOUND);
    return mix(vec4(0.0), bounded, lessThan(abs(gradient), vec4(3e38)));
}

// `precise`: values stored in fewer bits must be rounded equally on every device.
Moments updated(Moments moments, vec4 gradient) {
    precise vec4 first = BETA1 * moments.first + (1.0 - BETA1) * gradient;
    precise vec4 second = BETA2 * moments.second + (1.0 - BETA2) * gradient * gradient;
    return Moments(first, second);
}

// Zero in place of a subnormal number, which some devices flush by themselves.
vec4 flushed(vec4 x) {
    uvec4 bits = floatBitsToUint(x);
    return uintBitsToFloat(mix(uvec4(0), bits, notEqual(bits & 0x7f800000u, uvec4(0))));
}

Moments flushed(Moments moments) { return Moments(flushed(moments.first), flushed(moments.second)); }

// The decrement of a parameter.
vec4 adam_step(Moments moments, vec4 rate, float second_correction) {
    return rate * moments.first / (sqrt(moments.second) * second_correction + EPSILON);
}

// Random bits for four parameters, a hash of them, of their second moments and of the step: independent of the place of
// a Gaussian, and different for different ones.
uvec4 chance_of(vec4 parameter, Moments moments, uint step) {
    uvec4 key = (floatBitsToUint(parameter) ^ floatBitsToUint(moments.second)) + random_bits(step);
    return uvec4(random_bits(key.x), random_bits(key.y), random_bits(key.z), random_bits(key.w));
}

// Both moments in one word each: the upper halves of their bits (bfloat16), the first above. The truncated bits are the
// probability of rounding up, which preserves the mean: with rounding to the nearest of 8 bits, a mean that changes by
// a thousandth of itself per step would not change at all.
uvec4 in_halves(Moments moments, uvec4 chance) {
    uvec4 first = floatBitsToUint(moments.first) + (chance & 0xffffu);
    uvec4 second = floatBitsToUint(moments.second) + (chance >> 16);
    return (first & 0xffff0000u) | (second >> 16);
}

Moments from_halves(uvec4 words) {
    return Moments(uintBitsToFloat(words & 0xffff0000u), uintBitsToFloat(words << 16));
}
