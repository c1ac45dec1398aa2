//! The shapes of the tone curves, f(t) for t >= 0, as `include/curves.glsl` has them: one function each, for any
//! [`Real`]. The constants `c` are those of `tone::Family`, in its order.

use std::f64::consts::FRAC_PI_2;

use super::real::Real;
use crate::kernels::curves::*;

/// The most constants that a family has.
pub const MAX_CONSTANTS: usize = 8;

/// The shape of the curve `curve` (a `CURVE_*`), before black level, gain and clamp.
pub fn curve_shape<T: Real>(curve: u32, t: T, c: &[T; MAX_CONSTANTS]) -> T {
    match curve {
        CURVE_ASE | CURVE_ASE_FLOOR | CURVE_P80 => t.one_minus_exp(),
        CURVE_AP3 => ap3(t),
        CURVE_TANH => t.tanh(),
        CURVE_FITTED_CUBIC => fitted_cubic(t, c),
        CURVE_EXP_PLATEAU => exp_plateau(t, c),
        CURVE_POWER_SOFTEXP => power_softexp(t, c),
        CURVE_LOG_CURVE => log_curve(t, c),
        CURVE_ACES_FILMIC => aces_filmic(t, c),
        CURVE_REINHARD => reinhard(t, c),
        CURVE_SOFTEXP_GAMMA => softexp_gamma(t, c),
        CURVE_RATIONAL => rational(t, c),
        CURVE_POLY5_ORIGIN => poly5_origin(t, c),
        CURVE_DOUBLE_EXP => double_exp(t, c),
        CURVE_GAMMA => gamma(t, c),
        CURVE_SINH_RATIO => sinh_ratio(t, c),
        CURVE_HYBRID => hybrid(t, c),
        CURVE_POLY3_ORIGIN => poly3_origin(t, c),
        CURVE_SOFTEXP_MOD => softexp_mod(t, c),
        CURVE_SQRT_BLEND => sqrt_blend(t, c),
        CURVE_SOFTEXP => softexp(t, c),
        CURVE_TANH_CURVE => tanh_curve(t, c),
        CURVE_ARCTAN_CURVE => arctan_curve(t, c),
        CURVE_BEZIER3 => bezier3(t, c),
        CURVE_PIECEWISE3 => piecewise3(t, c),
        CURVE_HABLE => hable(t, c),
        CURVE_RICHARDS => richards(t, c),
        CURVE_ARCTAN_STANDARD => arctan_standard(t, c),
        CURVE_BEZIER3_STANDARD => bezier3_standard(t, c),
        CURVE_PIECEWISE3_STANDARD => piecewise3_standard(t, c),
        CURVE_HABLE_2010 => hable_2010(t, c),
        CURVE_RICHARDS_STANDARD => richards_standard(t, c),
        _ => t,
    }
}

type Constants<T> = [T; MAX_CONSTANTS];

fn one<T: Real>() -> T {
    T::of(1.0)
}

fn ap3<T: Real>(t: T) -> T {
    ((T::of(0.0720) * t - T::of(0.4376)) * t + T::of(0.9948)) * t
}

fn fitted_cubic<T: Real>(t: T, c: &Constants<T>) -> T {
    ((c[0] * t + c[1]) * t + c[2]) * t + c[3]
}

fn exp_plateau<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t.at_least(T::of(1e-10)).power(c[2])).one_minus_exp()
}

fn power_softexp<T: Real>(t: T, c: &Constants<T>) -> T {
    (c[0] * t).one_minus_exp().power(c[1])
}

fn log_curve<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t).ln_1p()
}

fn aces_filmic<T: Real>(t: T, c: &Constants<T>) -> T {
    (c[0] * t + c[1]) * t / ((c[2] * t + c[3]) * t + c[4])
}

fn reinhard<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * t / (t + c[1] + T::of(1e-10))
}

fn softexp_gamma<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t).one_minus_exp().power(c[2])
}

fn rational<T: Real>(t: T, c: &Constants<T>) -> T {
    (c[0] + c[1] * t) * t / (one::<T>() + (c[2] + c[3] * t) * t + T::of(1e-10))
}

fn poly5_origin<T: Real>(t: T, c: &Constants<T>) -> T {
    ((((c[0] * t + c[1]) * t + c[2]) * t + c[3]) * t + c[4]) * t
}

fn double_exp<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t).one_minus_exp() + c[2] * (c[3] * t).one_minus_exp()
}

fn gamma<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * t.at_least(T::of(1e-10)).power(c[1])
}

fn sinh_ratio<T: Real>(t: T, c: &Constants<T>) -> T {
    let q = (T::of(2.0) * c[1] * t).one_minus_exp();
    c[0] * q / (q + T::of(2.0) * c[2] * (-c[1] * t).exp())
}

fn hybrid<T: Real>(t: T, c: &Constants<T>) -> T {
    let floor = t.at_least(T::of(1e-10));
    c[0] * (c[1] * t).one_minus_exp().power(c[2]) + c[3] * floor.power(c[4])
}

fn poly3_origin<T: Real>(t: T, c: &Constants<T>) -> T {
    ((c[0] * t + c[1]) * t + c[2]) * t
}

fn softexp_mod<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t).one_minus_exp() + c[2] * t
}

fn sqrt_blend<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * t.at_least(T::of(1e-10)).sqrt() + c[1] * t
}

fn softexp<T: Real>(t: T, c: &Constants<T>) -> T {
    (c[0] * t).one_minus_exp()
}

fn tanh_curve<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t).tanh()
}

fn arctan_curve<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t).atan() / T::of(FRAC_PI_2)
}

fn bezier3<T: Real>(t: T, c: &Constants<T>) -> T {
    let s = t.at_most(one());
    let (left, three) = (one::<T>() - s, T::of(3.0));
    s * (three * left * left * c[0] * s + three * left * s * s * c[1] + s * s * s)
}

fn piecewise3<T: Real>(t: T, c: &Constants<T>) -> T {
    let zero = T::of(0.0);
    let first = t.at_most(c[3]);
    let second = (t - c[3]).at_least(zero).at_most(c[4] - c[3]);
    c[0] * first + c[1] * second + c[2] * (t - c[4]).at_least(zero)
}

fn hable<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (c[1] * t + c[2]) * t / ((c[3] * t + c[4]) * t + c[5] + T::of(1e-10))
}

fn richards<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (one::<T>() + c[1] * (-c[2] * t).exp()).power(-one::<T>() / c[3])
}

fn arctan_standard<T: Real>(t: T, c: &Constants<T>) -> T {
    (T::of(FRAC_PI_2) * c[0] * t).atan() / T::of(FRAC_PI_2)
}

fn bezier3_standard<T: Real>(t: T, c: &Constants<T>) -> T {
    let s = (t / c[2]).at_most(one());
    let (left, three) = (one::<T>() - s, T::of(3.0));
    three * left * left * s * c[0] + three * left * s * s * c[1] + s * s * s
}

fn piecewise3_standard<T: Real>(t: T, c: &Constants<T>) -> T {
    let (zero, one) = (T::of(0.0), one::<T>());
    let first = (t / c[0]).at_most(one);
    let second = ((t - c[0]).at_least(zero) / (c[2] - c[0])).at_most(one);
    let third = ((t - c[2]).at_least(zero) / (c[4] - c[2])).at_most(one);
    c[1] * first + (c[3] - c[1]) * second + (one - c[3]) * third
}

/// (t (A t + C B) + D E) / (t (A t + B) + D F) - E / F, over one denominator.
fn hable_2010_part<T: Real>(t: T, c: &Constants<T>) -> T {
    let (d, toe) = (c[3] * c[5], c[4] / c[5]);
    t * (c[0] * t * (one::<T>() - toe) + c[1] * (c[2] - toe)) / ((c[0] * t + c[1]) * t + d)
}

fn hable_2010<T: Real>(t: T, c: &Constants<T>) -> T {
    hable_2010_part(t, c) / hable_2010_part(c[6], c)
}

fn richards_standard<T: Real>(t: T, c: &Constants<T>) -> T {
    c[0] * (one::<T>() + c[1] * (-c[2] * (t - c[4])).exp()).power(-one::<T>() / c[3])
}
