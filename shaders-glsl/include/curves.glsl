// The shapes of the tone curves, f(t) for t >= 0: a number, a function and a case each.
// `crates/core/src/curves/catalogue.rs` has a row for each on the host, with the same formula.

const uint CURVE_NONE                = 0;
const uint CURVE_LINEAR              = 1;
const uint CURVE_ASE                 = 2;
const uint CURVE_AP3                 = 3;
const uint CURVE_FITTED_CUBIC        = 4;
const uint CURVE_EXP_PLATEAU         = 5;
const uint CURVE_POWER_SOFTEXP       = 6;
const uint CURVE_LOG_CURVE           = 7;
const uint CURVE_ACES_FILMIC         = 8;
const uint CURVE_REINHARD            = 9;
const uint CURVE_SOFTEXP_GAMMA       = 10;
const uint CURVE_RATIONAL            = 11;
const uint CURVE_POLY5_ORIGIN        = 12;
const uint CURVE_DOUBLE_EXP          = 13;
const uint CURVE_GAMMA               = 14;
const uint CURVE_SINH_RATIO          = 15;
const uint CURVE_HYBRID              = 16;
const uint CURVE_POLY3_ORIGIN        = 17;
const uint CURVE_SOFTEXP_MOD         = 18;
const uint CURVE_SQRT_BLEND          = 19;
const uint CURVE_SOFTEXP             = 20;
const uint CURVE_TANH_CURVE          = 21;
const uint CURVE_ARCTAN_CURVE        = 22;
const uint CURVE_BEZIER3             = 23;
const uint CURVE_PIECEWISE3          = 24;
const uint CURVE_HABLE               = 25;
const uint CURVE_RICHARDS            = 26;
const uint CURVE_ARCTAN_STANDARD     = 27;
const uint CURVE_BEZIER3_STANDARD    = 28;
const uint CURVE_PIECEWISE3_STANDARD = 29;
const uint CURVE_HABLE_2010          = 30;
const uint CURVE_RICHARDS_STANDARD   = 31;
const uint CURVE_TANH                = 32;
const uint CURVE_ASE_FLOOR           = 33;
const uint CURVE_P80                 = 34;
const uint CURVE_LUM_PRESERVE        = 35;
const uint CURVE_PER_CHANNEL         = 36;
const uint CURVE_TABLE               = 37;
const uint CURVE_AUTO                = 38;
const uint CURVE_PROFILE             = 39;

const uint MAX_CONSTANTS = 8;  // of a family

// t is clamped to this: powers stay finite, and every curve is within an ulp of white or of its limit.
const float LARGEST_T = 1e7;

const float HALF_PI = 1.5707963267948966;

// 1 - exp(-x) for x >= 0, without cancellation for tiny x.
float one_minus_exp(float x) {
    // Two terms beyond the linear one keep the error below an ulp up to 0.01.
    return x < 0.01 ? x * (1.0 - x * (0.5 - x * (1.0 / 6.0))) : 1.0 - exp(-x);
}

// ln(1 + x) for x >= 0, without cancellation for tiny x.
float log_1p(float x) {
    return x < 0.01 ? x * (1.0 - x * (0.5 - x * (1.0 / 3.0 - 0.25 * x))) : log(1.0 + x);
}

// x^p for x >= 0; pow(0, p) may be computed as exp2(p * -inf).
float power(float x, float p) {
    return x > 0.0 ? pow(x, p) : 0.0;
}

// The built-in function overflows for large x and cancels for tiny x.
float tanh_of(float x) {
    float q = one_minus_exp(2.0 * x);
    return q / (2.0 - q);
}

// The built-in function may be off by 4096 ulp. Halving the angle three times leaves x < 0.2 for a short series.
float arctan(float x) {
    [[unroll]] for (int halving = 0; halving < 3; ++halving) x = x / (1.0 + sqrt(1.0 + x * x));
    float z = x * x;
    return 8.0 * x * (1.0 - z * (1.0 / 3.0 - z * (1.0 / 5.0 - z * (1.0 / 7.0 - z * (1.0 / 9.0)))));
}

float ap3(float t) {
    return ((0.0720 * t - 0.4376) * t + 0.9948) * t;
}

float fitted_cubic(float t, float c[MAX_CONSTANTS]) {
    return ((c[0] * t + c[1]) * t + c[2]) * t + c[3];
}

float exp_plateau(float t, float c[MAX_CONSTANTS]) {
    return c[0] * one_minus_exp(c[1] * power(max(t, 1e-10), c[2]));
}

float power_softexp(float t, float c[MAX_CONSTANTS]) {
    return power(one_minus_exp(c[0] * t), c[1]);
}

float log_curve(float t, float c[MAX_CONSTANTS]) {
    return c[0] * log_1p(c[1] * t);
}

float aces_filmic(float t, float c[MAX_CONSTANTS]) {
    return (c[0] * t + c[1]) * t / ((c[2] * t + c[3]) * t + c[4]);
}

float reinhard(float t, float c[MAX_CONSTANTS]) {
    return c[0] * t / (t + c[1] + 1e-10);
}

float softexp_gamma(float t, float c[MAX_CONSTANTS]) {
    return c[0] * power(one_minus_exp(c[1] * t), c[2]);
}

float rational(float t, float c[MAX_CONSTANTS]) {
    return (c[0] + c[1] * t) * t / (1.0 + (c[2] + c[3] * t) * t + 1e-10);
}

float poly5_origin(float t, float c[MAX_CONSTANTS]) {
    return ((((c[0] * t + c[1]) * t + c[2]) * t + c[3]) * t + c[4]) * t;
}

float double_exp(float t, float c[MAX_CONSTANTS]) {
    return c[0] * one_minus_exp(c[1] * t) + c[2] * one_minus_exp(c[3] * t);
}

float gamma(float t, float c[MAX_CONSTANTS]) {
    return c[0] * power(max(t, 1e-10), c[1]);
}

// sinh overflows, so numerator and denominator are divided by exp(b t) / 2.
float sinh_ratio(float t, float c[MAX_CONSTANTS]) {
    float q = one_minus_exp(2.0 * c[1] * t);
    return c[0] * q / (q + 2.0 * c[2] * exp(-c[1] * t));
}

float hybrid(float t, float c[MAX_CONSTANTS]) {
    return c[0] * power(one_minus_exp(c[1] * t), c[2]) + c[3] * power(max(t, 1e-10), c[4]);
}

float poly3_origin(float t, float c[MAX_CONSTANTS]) {
    return ((c[0] * t + c[1]) * t + c[2]) * t;
}

float softexp_mod(float t, float c[MAX_CONSTANTS]) {
    return c[0] * one_minus_exp(c[1] * t) + c[2] * t;
}

float sqrt_blend(float t, float c[MAX_CONSTANTS]) {
    return c[0] * sqrt(max(t, 1e-10)) + c[1] * t;
}

float softexp(float t, float c[MAX_CONSTANTS]) {
    return one_minus_exp(c[0] * t);
}

float tanh_curve(float t, float c[MAX_CONSTANTS]) {
    return c[0] * tanh_of(c[1] * t);
}

float arctan_curve(float t, float c[MAX_CONSTANTS]) {
    return c[0] * arctan(c[1] * t) / HALF_PI;
}

float bezier3(float t, float c[MAX_CONSTANTS]) {
    float s = min(t, 1.0);
    float left = 1.0 - s;
    return s * (3.0 * left * left * c[0] * s + 3.0 * left * s * s * c[1] + s * s * s);
}

float piecewise3(float t, float c[MAX_CONSTANTS]) {
    float first = min(t, c[3]);
    float second = min(max(t - c[3], 0.0), c[4] - c[3]);
    return c[0] * first + c[1] * second + c[2] * max(t - c[4], 0.0);
}

float hable(float t, float c[MAX_CONSTANTS]) {
    return c[0] * (c[1] * t + c[2]) * t / ((c[3] * t + c[4]) * t + c[5] + 1e-10);
}

float richards(float t, float c[MAX_CONSTANTS]) {
    return c[0] * power(1.0 + c[1] * exp(-c[2] * t), -1.0 / c[3]);
}

float arctan_standard(float t, float c[MAX_CONSTANTS]) {
    return arctan(HALF_PI * c[0] * t) / HALF_PI;
}

float bezier3_standard(float t, float c[MAX_CONSTANTS]) {
    float s = min(t / c[2], 1.0);
    float left = 1.0 - s;
    return 3.0 * left * left * s * c[0] + 3.0 * left * s * s * c[1] + s * s * s;
}

float piecewise3_standard(float t, float c[MAX_CONSTANTS]) {
    float first = min(t / c[0], 1.0);
    float second = min(max(t - c[0], 0.0) / (c[2] - c[0]), 1.0);
    float third = min(max(t - c[2], 0.0) / (c[4] - c[2]), 1.0);
    return c[1] * first + (c[3] - c[1]) * second + (1.0 - c[3]) * third;
}

// Without the constant E / F on both ends, it would cancel at black.
float hable_2010_part(float t, float c[MAX_CONSTANTS]) {
    float d = c[3] * c[5];
    // (t (A t + C B) + D E) / (t (A t + B) + D F) - E / F over one denominator.
    return t * (c[0] * t * (1.0 - c[4] / c[5]) + c[1] * (c[2] - c[4] / c[5])) / ((c[0] * t + c[1]) * t + d);
}

float hable_2010(float t, float c[MAX_CONSTANTS]) {
    return hable_2010_part(t, c) / hable_2010_part(c[6], c);
}

float richards_standard(float t, float c[MAX_CONSTANTS]) {
    return c[0] * power(1.0 + c[1] * exp(-c[2] * (t - c[4])), -1.0 / c[3]);
}

// The shape of the curve `curve`, before black level, gain and clamp.
float curve_shape(uint curve, float t, float c[MAX_CONSTANTS]) {
    switch (curve) {
    case CURVE_ASE:
    case CURVE_AUTO:
    case CURVE_ASE_FLOOR:
    case CURVE_P80:                 return one_minus_exp(t);
    case CURVE_AP3:                 return ap3(t);
    case CURVE_TANH:                return tanh_of(t);
    case CURVE_FITTED_CUBIC:        return fitted_cubic(t, c);
    case CURVE_EXP_PLATEAU:         return exp_plateau(t, c);
    case CURVE_POWER_SOFTEXP:       return power_softexp(t, c);
    case CURVE_LOG_CURVE:           return log_curve(t, c);
    case CURVE_ACES_FILMIC:         return aces_filmic(t, c);
    case CURVE_REINHARD:            return reinhard(t, c);
    case CURVE_SOFTEXP_GAMMA:       return softexp_gamma(t, c);
    case CURVE_RATIONAL:            return rational(t, c);
    case CURVE_POLY5_ORIGIN:        return poly5_origin(t, c);
    case CURVE_DOUBLE_EXP:          return double_exp(t, c);
    case CURVE_GAMMA:               return gamma(t, c);
    case CURVE_SINH_RATIO:          return sinh_ratio(t, c);
    case CURVE_HYBRID:              return hybrid(t, c);
    case CURVE_POLY3_ORIGIN:        return poly3_origin(t, c);
    case CURVE_SOFTEXP_MOD:         return softexp_mod(t, c);
    case CURVE_SQRT_BLEND:          return sqrt_blend(t, c);
    case CURVE_SOFTEXP:             return softexp(t, c);
    case CURVE_TANH_CURVE:          return tanh_curve(t, c);
    case CURVE_ARCTAN_CURVE:        return arctan_curve(t, c);
    case CURVE_BEZIER3:             return bezier3(t, c);
    case CURVE_PIECEWISE3:          return piecewise3(t, c);
    case CURVE_HABLE:               return hable(t, c);
    case CURVE_RICHARDS:            return richards(t, c);
    case CURVE_ARCTAN_STANDARD:     return arctan_standard(t, c);
    case CURVE_BEZIER3_STANDARD:    return bezier3_standard(t, c);
    case CURVE_PIECEWISE3_STANDARD: return piecewise3_standard(t, c);
    case CURVE_HABLE_2010:          return hable_2010(t, c);
    case CURVE_RICHARDS_STANDARD:   return richards_standard(t, c);
    default:                        return t;
    }
}
