// The tone curves: sRGB-encoded dark value in, pseudo-GT value in [0, 1] out.
// The statistics behind the parameters are taken once per view; `tone::ToneCurve` is the host side.

const uint CURVE_NONE   = 0;  // the photograph as it is
const uint CURVE_LINEAR = 1;  // x theta / mean
const uint CURVE_ASE    = 2;  // adaptive SoftExp
const uint CURVE_AP3    = 3;  // adaptive cubic

layout(constant_id = 10) const uint TONE_CURVE = 3;

struct ToneParameters {
    float white;   // t = x / white: p90 for ASE and AP3, mean / theta for linear, 1 for none
    float offset;  // delta0
    float gain;    // g of ASE, b of AP3
};

// 1 - exp(-x) for x >= 0, without cancellation where x is tiny.
float one_minus_exp(float x) {
    // Two terms beyond the linear one keep the error below an ulp up to 0.01.
    return x < 0.01 ? x * (1.0 - x * (0.5 - x * (1.0 / 6.0))) : 1.0 - exp(-x);
}

float tone_curve(float x, ToneParameters tone) {
    float t = x / tone.white;
    float y = t;
    if (TONE_CURVE == CURVE_ASE) {
        y = tone.offset + (1.0 - tone.offset) * one_minus_exp(tone.gain * t);
    } else if (TONE_CURVE == CURVE_AP3) {
        y = tone.offset + tone.gain * (((0.0720 * t - 0.4376) * t + 0.9948) * t);
    }
    // Positive phrasing: a NaN becomes black.
    return y > 0.0 ? min(y, 1.0) : 0.0;
}
