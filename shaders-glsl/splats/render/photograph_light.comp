#version 460
#extension GL_GOOGLE_include_directive : require
#include "kernel.glsl"
#include "tone.glsl"

//! Photograph light: a render in the values of its targets to those of the photographs, in place; one thread per pixel.
//!
//! Colours are weighted by alpha, so the colour before that is c / alpha. A curve that maps each value by itself is
//! inverted by bisection. `auto` also depends on the luminance Y of the pixel, by s(Y) / Y: for a given Y, a channel is
//! a concave curve below a toe, whose inverse Newton's method finds from the left; bracketed, it also finds the Y that
//! its own result has. Values within half a code of 8 bits of the largest that a curve gives become those of that
//! limit. The host's inverse is `src/photographs/tone/inverse.rs`.

layout(local_size_x = 64) in;

layout(push_constant, scalar) uniform Params {
    uint           pixel_count;
    ToneParameters tone;  // of the scene
};

layout(binding = 0) readonly buffer Transmittances { float transmittances[]; };  // (pixels)
layout(binding = 1)          buffer Render         { float render[]; };          // (channels, pixels); three change

const float FLAT = 0.5 / 255.0;
const float LARGEST = 65504.0;
// Of the automatic curve, whose shoulder may be long.
const float BRIGHTEST = 64.0;
// Relative precision of a solution, a few roundings, and the most trials: none takes this many.
const float PRECISION = 5e-7;
const uint TRIALS = 48;
const vec3 WEIGHTS = vec3(0.299, 0.587, 0.114);

// The target of a channel's value x, for a curve that maps each value by itself.
float target_of(float x, uint channel) {
    float curved;
    switch (TONE_CURVE) {
    // A pixel's gain is that of its luminance, up to 1e-6 of it.
    case CURVE_LUM_PRESERVE: curved = tone.gain * x; break;
    case CURVE_PER_CHANNEL:  curved = x / tone.constants[channel]; break;
    default:                 curved = tone_curve(x, tone);
    }
    float plain = min(x, 1.0);
    return tone.weight < 1.0 ? plain + tone.weight * (curved - plain) : curved;
}

float bisected(float value, uint channel) {
    float largest = min(target_of(LARGEST, channel), 1.0) - FLAT;
    value = value > largest ? largest : value;
    // Written so that a NaN is black.
    if (!(value > target_of(0.0, channel))) return 0.0;
    float low = 0.0;
    float high = min(tone.white, 1.0);
    while (high < LARGEST && target_of(high, channel) < value) {
        low = high;
        high = 2.0 * high;
    }
    for (uint trial = 0; trial < TRIALS && high - low > PRECISION * high; ++trial) {
        float middle = 0.5 * (low + high);
        if (target_of(middle, channel) < value) low = middle;
        else high = middle;
    }
    return 0.5 * (low + high);
}

// The derivative of the shoulder.
float shoulder_slope(float t) {
    float s = tone.constants[1];
    return s > 0.0 ? exp(-log_1p(s * t) / s) / (1.0 + s * t) : exp(-t);
}

// The value that the toe maps to this one: value = a s^2 + b s + c has the increasing root s.
float before_toe(float value) {
    float end = tone.constants[2];
    float weight = tone.constants[3];
    if (!(weight > 0.0 && value < end)) return value;
    float a = 0.75 * weight * end;
    float b = 0.25 * weight * end + (1.0 - weight) * (end - tone.offset);
    float c = (1.0 - weight) * tone.offset - value;
    return tone.offset - 2.0 * c / (b + sqrt(max(b * b - 4.0 * a * c, 0.0))) * (end - tone.offset);
}

// The value in units of white whose target is `value` where s(Y) / Y is `factor`, from a guess, and the slope there.
vec2 solved(float value, float factor, float t) {
    float share = tone.constants[0];
    float slope = 1.0;
    for (uint trial = 0; trial < TRIALS; ++trial) {
        float soft = (1.0 - share) * shoulder(t, tone) + share * (t * factor);
        float y = tone.offset + (1.0 - tone.offset) * soft;
        slope = (1.0 - tone.offset) * ((1.0 - share) * shoulder_slope(t) + share * factor);
        if (tone.weight < 1.0) {
            float x = t * tone.white;
            float plain = min(x, 1.0);
            y = plain + tone.weight * (y - plain);
            slope = (x < 1.0 ? (1.0 - tone.weight) * tone.white : 0.0) + tone.weight * slope;
        }
        float next = max(t + (value - y) / slope, 0.0);
        bool is_close = abs(next - t) <= PRECISION * next;
        t = next;
        if (is_close) break;
    }
    return vec2(t, slope);
}

// s(Y) / Y, and its derivative.
vec2 factor_at(float y) {
    float least = max(y, 1e-20);
    float factor = shoulder(least, tone) / least;
    // The difference cancels for dark pixels.
    float s = tone.constants[1];
    float series = (1.0 + s) * (-0.5 + (1.0 + 2.0 * s) * least * (1.0 / 3.0 - (1.0 + 3.0 * s) * least / 8.0));
    float slope = least < 0.05 ? series : (shoulder_slope(least) - factor) / least;
    return vec2(factor, slope);
}

vec3 automatic(vec3 value) {
    // The factor is 1 for black, where the result is the darkest.
    vec3 t = vec3(0.0);
    for (uint channel = 0; channel < 3; ++channel) t[channel] = solved(value[channel], 1.0, 0.0).x;
    float y = dot(WEIGHTS, t);
    float share = (1.0 - tone.offset) * tone.constants[0] * (tone.weight < 1.0 ? tone.weight : 1.0);
    // Below its solution, Y is less than the luminance of its own result.
    float low = 0.0;
    float most = LARGEST / tone.white;
    float high = most;
    for (uint trial = 0; trial < TRIALS && share > 0.0; ++trial) {
        vec2 factor = factor_at(y);
        float rise = 0.0;
        for (uint channel = 0; channel < 3; ++channel) {
            vec2 solution = solved(value[channel], factor.x, t[channel]);
            t[channel] = solution.x;
            rise -= WEIGHTS[channel] * share * solution.x * factor.y / solution.y;
        }
        float error = dot(WEIGHTS, t) - y;
        if (abs(error) <= PRECISION * y) break;
        if (error > 0.0) low = y;
        else high = y;
        // Beyond the bounds, Newton's method is replaced by bisection; without an upper one, by the result's luminance.
        float next = y + error / (1.0 - rise);
        bool is_between = next > low && next < high;
        y = is_between ? next : high < most ? 0.5 * (low + high) : y + error;
    }
    return min(t * tone.white, vec3(LARGEST));
}

void main() {
    uint at = THREAD_INDEX;
    if (at >= pixel_count) return;
    float alpha = 1.0 - transmittances[at];
    if (!(alpha > 0.0)) return;
    vec3 value = vec3(render[at], render[pixel_count + at], render[2 * pixel_count + at]) / alpha;
    vec3 light;
    if (TONE_CURVE == CURVE_AUTO) {
        // Written so that a NaN is black.
        vec3 largest = vec3(min(target_of(BRIGHTEST, 0), 1.0) - FLAT);
        value = mix(vec3(0.0), min(value, largest), greaterThan(value, vec3(0.0)));
        // The curve of no light is the black level.
        float black = tone.weight < 1.0 ? tone.weight * tone.offset : tone.offset;
        value = vec3(before_toe(value.r), before_toe(value.g), before_toe(value.b));
        light = automatic(max(value, vec3(black)));
    } else {
        light = vec3(bisected(value.r, 0), bisected(value.g, 1), bisected(value.b, 2));
    }
    light *= alpha;
    render[at] = light.r;
    render[pixel_count + at] = light.g;
    render[2 * pixel_count + at] = light.b;
}
