// The tone curves: from an sRGB-encoded dark value, at least 0, to the pseudo-GT value in [0, 1]. The statistics in the
// parameters are measured once per view; `tone::ToneCurve` is the host side.

#include "curves.glsl"

layout(constant_id = 10) const uint TONE_CURVE = 3;

struct ToneParameters {
    float white;                     // t = x / white: p90, or the curve's replacement
    float offset;                    // delta0, the black level
    float gain;                      // g if the black level rescales, b if it is added
    float weight;                    // of the curve relative to the unchanged photograph, 0 to 1
    float constants[MAX_CONSTANTS];  // of the family
};

// Clamps to (0, LARGEST_T); a NaN counts as black.
float within(float t) {
    return t > 0.0 ? min(t, LARGEST_T) : 0.0;
}

// The shoulder of the automatic curve: 1 - exp(-u) with u = ln(1 + s t) / s, or t for s = 0. constants[1] is s.
float shoulder(float t, ToneParameters tone) {
    float s = tone.constants[1];
    return one_minus_exp(s > 0.0 ? log_1p(s * t) / s : t);
}

// The toe of the automatic curve: from the black level to 0, and from constants[2] to itself, with weight constants[3].
float toe(float value, ToneParameters tone) {
    float end = tone.constants[2];
    float weight = tone.constants[3];
    if (!(weight > 0.0 && value < end)) return value;
    float s = (value - tone.offset) / (end - tone.offset);
    // The mirror of what is above the toe.
    if (s <= -1.0) return value - 2.0 * weight * tone.offset;
    return value + weight * (end * s * (0.25 + 0.75 * abs(s)) - value);
}

float tone_curve(float x, ToneParameters tone) {
    float t = x / tone.white;
    float y;
    switch (TONE_CURVE) {
    case CURVE_NONE:
    case CURVE_LINEAR:
        y = t;
        break;
    case CURVE_AUTO:
        y = toe(tone.offset + (1.0 - tone.offset) * shoulder(t, tone), tone);
        break;
    case CURVE_ASE:
        y = tone.offset + (1.0 - tone.offset) * one_minus_exp(tone.gain * t);
        break;
    case CURVE_AP3:
        y = tone.offset + tone.gain * ap3(t);
        break;
    case CURVE_TANH:
        y = tone.offset + (1.0 - tone.offset) * tanh_of(tone.gain * within(t));
        break;
    case CURVE_ASE_FLOOR:
        float floor_share = tone.constants[0];
        float white = one_minus_exp(tone.gain);
        float scale = (1.0 - tone.offset) * white / ((1.0 - floor_share) * white + floor_share + 1e-8);
        t = within(t);
        y = tone.offset + scale * ((1.0 - floor_share) * one_minus_exp(tone.gain * t) + floor_share * t);
        break;
    default:
        y = tone.offset + tone.gain * curve_shape(TONE_CURVE, within(t), tone.constants);
    }
    // Written so that a NaN becomes black.
    return y > 0.0 ? min(y, 1.0) : 0.0;
}
