// A step of Adam for four numbers (Kingma and Ba 2015), however a kernel keeps them.

#include "random.glsl"

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;
// Its square is finite: an infinite second moment would freeze its parameter for good.
const float GRADIENT_BOUND = 1e18;

// The exponential means of gradients and of their squares.
struct Moments {
    vec4 first;
    vec4 second;
};

// Positive phrasing: an infinite or NaN gradient fails the test.
vec4 clamp_gradient(vec4 gradient) {
    vec4 bounded = clamp(gradient, -GRADIENT_BOUND, GRADIENT_BOUND);
    return mix(vec4(0.0), bounded, lessThan(abs(gradient), vec4(3e38)));
}

// `precise`: what is kept in fewer bits has to be rounded alike on every device.
Moments updated(Moments moments, vec4 gradient) {
    precise vec4 first = BETA1 * moments.first + (1.0 - BETA1) * gradient;
    precise vec4 second = BETA2 * moments.second + (1.0 - BETA2) * gradient * gradient;
    return Moments(first, second);
}

// What a parameter falls by.
vec4 adam_step(Moments moments, vec4 rate, float second_correction) {
    return rate * moments.first / (sqrt(moments.second) * second_correction + EPSILON);
}

// Chance for four parameters, as a hash of them, of their second moments and of the step: it follows a Gaussian
// wherever it is moved, and no two that differ share it.
uvec4 chance_of(vec4 parameter, Moments moments, uint step) {
    uvec4 key = (floatBitsToUint(parameter) ^ floatBitsToUint(moments.second)) + random_bits(step);
    return uvec4(random_bits(key.x), random_bits(key.y), random_bits(key.z), random_bits(key.w));
}

// Both moments in a word each: the upper halves of their bits (bfloat16), the first above. What is cut off decides how
// probably the rest is rounded up, so that their mean stays: to the nearest of 8 bits, a mean that moves by a
// thousandth of itself a step would not move at all.
uvec4 in_halves(Moments moments, uvec4 chance) {
    uvec4 first = floatBitsToUint(moments.first) + (chance & 0xffffu);
    uvec4 second = floatBitsToUint(moments.second) + (chance >> 16);
    return (first & 0xffff0000u) | (second >> 16);
}

Moments from_halves(uvec4 words) {
    return Moments(uintBitsToFloat(words & 0xffff0000u), uintBitsToFloat(words << 16));
}
