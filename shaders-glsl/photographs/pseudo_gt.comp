#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Pseudo-GT: decodes a stored photograph and applies its curve; one thread per pixel.
//!
//! A code is looked up rather than divided, since devices may round divisions differently: decoding restores the
//! encoded bits. Most curves map each value separately. `lum_preserve` scales a pixel by the gain of its luminance,
//! `per_channel` each channel by its own white; `auto` mixes the curve of each channel with the curve of the luminance,
//! which keeps the ratios of the channels; `table` and `profile` are those of `tone::Table` and `tone::Profile`. For a
//! photograph that is hardly too dark, the curve has a partial weight: the target is x + weight (curve(x) - x), x
//! clamped to [-1, 1].
//!
//! Below 0, where noise at black is, a curve is mirrored, T(-x) = 2 T(0) - T(x): cut at black, noise would raise the
//! mean of what is dark by up to 0.4 of its standard deviation. Reference: `src/reference/pseudo_gt.rs`.

layout(local_size_x = 256) in;

layout(constant_id = 0) const uint CODE_BITS = 32;  // 8 or 16; 32: `values` are the photograph, and there are no codes
layout(constant_id = 1) const bool WITH_CURVE = true;    // else the photograph is only decoded, bit for bit

// Of a profile: segments of equal width per channel,
const uint SEGMENTS = 16;
// and the values per channel: three weights, a bias, the value at 0 and the rises.
const uint PROFILE_WIDTH = 5 + SEGMENTS;

layout(push_constant) uniform Params {
    uint pixel_count;
    uint view;        // the element of `parameters`
    uint knot_count;  // of a table, per channel, at least 2
};

layout(binding = 0) readonly  buffer Codes      { uint codes[]; };     // (3, H, W), the lowest bits of a word first
layout(binding = 1) readonly  buffer Values     { float values[]; };   // one per code, or (3, H, W); sRGB-encoded
layout(binding = 2) readonly  buffer Parameters { ToneParameters parameters[]; };
layout(binding = 3) readonly buffer Knots { float numbers[]; };  // (3, K, 3) knots x, y, slope; or (3, PROFILE_WIDTH)
layout(binding = 4) writeonly buffer Target     { float target[]; };   // (3, H, W)

float stored(uint i) {
    uint bits = CODE_BITS;
    if (bits == 32) return values[i];
    uint per_word = 32 / bits;
    return values[bitfieldExtract(codes[i / per_word], int(bits * (i % per_word)), int(bits))];
}

vec3 one_minus_exp(vec3 t) {
    return vec3(one_minus_exp(t.r), one_minus_exp(t.g), one_minus_exp(t.b));
}

// For values and the size of the luminance in units of white; constants[0] is lambda. At black, the factor of the
// luminance's curve is 1.
vec3 automatic(vec3 t, float y, ToneParameters tone) {
    float least = max(y, 1e-20);
    float factor = shoulder(least, tone) / least;
    vec3 size = abs(t);
    vec3 soft = sign(t) * vec3(shoulder(size.r, tone), shoulder(size.g, tone), shoulder(size.b, tone));
    float share = tone.constants[0];
    vec3 value = tone.offset + (1.0 - tone.offset) * ((1.0 - share) * soft + share * (t * factor));
    return vec3(toe(value.r, tone), toe(value.g, tone), toe(value.b, tone));
}

// Written so that a NaN becomes black.
vec3 bounded(vec3 rgb, float most) {
    return mix(vec3(0.0), clamp(rgb, vec3(-most), vec3(most)), greaterThan(abs(rgb), vec3(0.0)));
}

// The factors of a pixel depend on the size of its luminance, so that a pixel below black is mirrored as a whole.
vec3 mixed(vec3 rgb, ToneParameters tone) {
    uint curve = TONE_CURVE;
    vec3 known = bounded(rgb, 65504.0);
    float y = abs(0.299 * known.r + 0.587 * known.g + 0.114 * known.b);
    vec3 scale = vec3(y * tone.gain / (y + 1e-6));
    if (curve == CURVE_PER_CHANNEL) scale = 1.0 / vec3(tone.constants[0], tone.constants[1], tone.constants[2]);
    vec3 mapped = known * scale;
    if (curve == CURVE_AUTO) mapped = automatic(known / tone.white, y / tone.white, tone);
    return clamp(mapped, vec3(-1.0), vec3(1.0));
}

vec3 knot(uint at) {
    return vec3(numbers[3 * at], numbers[3 * at + 1], numbers[3 * at + 2]);
}

// The last knot from `first` on that is not above x, which is between the first and the last.
uint knot_below(uint first, float x) {
    uint low = first;
    uint high = first + knot_count - 1;
    while (high - low > 1) {
        uint middle = (low + high) / 2;
        if (numbers[3 * middle] <= x) low = middle;
        else high = middle;
    }
    return low;
}

// Monotone cubics between the knots of a channel, with slopes from the host; constant beyond its ends.
float tabled(uint channel, float x) {
    uint first = channel * knot_count;
    float low = numbers[3 * first];
    float high = numbers[3 * (first + knot_count - 1)];
    // Written so that a NaN counts as the lower end.
    x = x > low ? min(x, high) : low;
    uint at = knot_below(first, x);
    vec3 left = knot(at);
    vec3 right = knot(at + 1);
    float width = right.x - left.x;
    float s = (x - left.x) / width;
    float rise = right.y - left.y;
    float a = width * left.z - rise;
    float b = rise - width * right.z;
    float y = left.y + rise * s + s * (1.0 - s) * (a * (1.0 - s) + b * s);
    return clamp(y, 0.0, 1.0);
}

// A table that begins at 0 or above is mirrored below 0.
float signed_table(uint channel, float x) {
    bool is_mirrored = x < 0.0 && numbers[3 * channel * knot_count] >= 0.0;
    float y = tabled(channel, is_mirrored ? -x : x);
    return is_mirrored ? 2.0 * tabled(channel, 0.0) - y : y;
}

float mix_of(uint begin, vec3 v) {
    return numbers[begin] * v.r + numbers[begin + 1] * v.g + numbers[begin + 2] * v.b;
}

// v = 1 - exp(-x / white); u = a v + b, clamped to [0, 1]; y = s_0 + sum of s_i clamp(16 u - i + 1, 0, 1) over 16 rises
// s_i of equal width. The sum of ramps is continuous, so no rounding of u can jump. The values `below` black, by their
// size, take off what they weigh at the slope of the first segment.
float profiled(uint channel, vec3 v, vec3 below) {
    uint begin = PROFILE_WIDTH * channel;
    float scaled = float(SEGMENTS) * clamp(mix_of(begin, v) + numbers[begin + 3], 0.0, 1.0);
    float y = numbers[begin + 4];
    for (uint segment = 0; segment < SEGMENTS; ++segment) {
        y += numbers[begin + 5 + segment] * clamp(scaled - float(segment), 0.0, 1.0);
    }
    return max(clamp(y, 0.0, 1.0) - float(SEGMENTS) * numbers[begin + 5] * mix_of(begin, below), -1.0);
}

float signed_curve(float x, ToneParameters tone) {
    float y = tone_curve(x < 0.0 ? -x : x, tone);
    return x < 0.0 ? 2.0 * tone_curve(0.0, tone) - y : y;
}

vec3 mapped(vec3 rgb, ToneParameters tone) {
    vec3 y;
    switch (TONE_CURVE) {
    case CURVE_AUTO:
    case CURVE_LUM_PRESERVE:
    case CURVE_PER_CHANNEL:
        return mixed(rgb, tone);
    case CURVE_TABLE:
        [[unroll]] for (uint c = 0; c < 3; ++c) y[c] = signed_table(c, rgb[c] / tone.white);
        return y;
    case CURVE_PROFILE:
        vec3 t = bounded(rgb, 65504.0) / tone.white;
        vec3 v = one_minus_exp(max(t, vec3(0.0)));
        vec3 below = one_minus_exp(max(-t, vec3(0.0)));
        [[unroll]] for (uint c = 0; c < 3; ++c) y[c] = profiled(c, v, below);
        return y;
    default:
        [[unroll]] for (uint c = 0; c < 3; ++c) y[c] = signed_curve(rgb[c], tone);
        return y;
    }
}

void main() {
    uint i = THREAD_INDEX;
    if (i >= pixel_count) return;
    vec3 rgb = vec3(stored(i), stored(pixel_count + i), stored(2 * pixel_count + i));
    if (WITH_CURVE) {
        ToneParameters tone = parameters[view];
        vec3 plain = bounded(rgb, 1.0);
        vec3 curved = mapped(rgb, tone);
        // Pixels of full weight keep their bits.
        rgb = tone.weight < 1.0 ? plain + tone.weight * (curved - plain) : curved;
    }
    target[i] = rgb.r;
    target[pixel_count + i] = rgb.g;
    target[2 * pixel_count + i] = rgb.b;
}
