//! The table of all curves: numbers, names, formulas, constants, properties and sources.
//!
//! A curve is a row here and a function in `include/curves.glsl`. The command line, the help texts, `nightsplat tone
//! list`, TOML files and fitting all read this table; a row's formula is also the reference of the kernels.

use std::borrow::Cow;
use std::f64::consts::FRAC_PI_2;

use super::real::Real;
use super::{Constant, Family, MAX_CONSTANTS};

const CODE: &str =
    "adaptive tone curves for 3DGS, the appendix's leaderboard, constants of its code";
const MODE: &str = "adaptive tone curves for 3DGS, a mode of its code";

/// A curve of the leaderboard.
const FITTED: Family = Family {
    curve: ToneCurve::None,
    name: "",
    aliases: &[],
    formula: "t",
    source: CODE,
    constants: &[],
    domain: [0.0, f64::INFINITY],
    monotone: true,
    bounded: false,
    identifiable: true,
    is_rescaled: false,
    is_of_t: true,
    alpha: 0.0,
    gain_c: 0.0,
};

/// The constants of a family, padded with zeros for the kernels.
pub type Constants<T> = [T; MAX_CONSTANTS];

/// Rows of `Variant = NUMBER: "name", "formula", [constants] { differences from a fitted curve }, |t| shape;`.
///
/// A constant is `name = default in low..high`. The bounds are those of a fit, which starts at the default or, if that
/// is the result of a failed fit, at the value after `from`.
macro_rules! families {
    (@start $default:literal) => { $default };
    (@start $default:literal $start:literal) => { $start };
    ($(
        $variant:ident = $number:ident: $name:literal, $formula:literal,
        [$($constant:ident = $default:literal $(from $start:literal)? in $low:literal..$high:literal),* $(,)?]
        $({ $($field:ident: $value:expr),* $(,)? })?,
        |$t:ident| $shape:expr;
    )*) => {
        /// The formula of a tone curve, by its number in `include/curves.glsl`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[repr(u32)]
        pub enum ToneCurve {
            $(#[doc = $formula] $variant,)*
        }

        $(
            #[doc = concat!("`", $name, "`")]
            pub const $number: u32 = ToneCurve::$variant as u32;
        )*

        const COUNT: usize = [$(ToneCurve::$variant),*].len();

        /// Every family, by its number; curves from files and the automatic curve are not families.
        pub static FAMILIES: [Family; COUNT] = [$(Family {
            curve: ToneCurve::$variant,
            name: $name,
            formula: $formula,
            constants: &[$(Constant {
                name: Cow::Borrowed(stringify!($constant)),
                default: $default,
                start: families!(@start $default $($start)?),
                bounds: [$low, $high],
            }),*],
            $($($field: $value,)*)?
            ..FITTED
        }),*];

        impl ToneCurve {
            /// Every named curve, in the table's order.
            pub const ALL: [Self; COUNT] = [$(Self::$variant),*];
        }

        /// The shape of the curve `curve` (a `CURVE_*`) at t >= 0, before black level, gain and clamp.
        #[allow(unused_variables, reason = "not every shape takes every constant")]
        pub fn curve_shape<T: Real>(curve: u32, t: T, constants: &Constants<T>) -> T {
            match curve {
                $($number => {
                    let [$($constant,)* ..] = *constants;
                    let $t = t;
                    $shape
                })*
                _ => t,
            }
        }
    };
}

families! {
    None = CURVE_NONE: "none",
        "x: the photograph as it is",
        [] { source: "no curve at all, for comparison", is_of_t: false },
        |t| t;

    Linear = CURVE_LINEAR: "linear",
        "x theta / mean(x)",
        [] {
            aliases: &["mean_hard"],
            source: "the paper's linear baseline",
            is_of_t: false,
        },
        |t| t;

    Ase = CURVE_ASE: "ase",
        "delta0 + (1 - delta0) (1 - exp(-g t)), g = g0 + c Y",
        [] {
            aliases: &["adaptive_softexp_v2"],
            source: "the paper's adaptive soft exponential",
            bounded: true,
            is_rescaled: true,
            alpha: 0.12,
            gain_c: 3.0,
        },
        |t| t.one_minus_exp();

    Ap3 = CURVE_AP3: "ap3",
        "delta0 + b (0.0720 t^3 - 0.4376 t^2 + 0.9948 t), b = 1 + c Y",
        [] {
            aliases: &["adaptive_poly3"],
            source: "the paper's adaptive cubic",
            alpha: 0.12,
            gain_c: 1.0,
        },
        |t| ((T::from_f64(0.0720) * t - T::from_f64(0.4376)) * t + T::from_f64(0.9948)) * t;

    FittedCubic = CURVE_FITTED_CUBIC: "fitted_cubic",
        "a t^3 + b t^2 + c t + d",
        [
            a = 0.0720 in -2.0..2.0,
            b = -0.4376 in -5.0..5.0,
            c = 0.9948 in -5.0..5.0,
            d = 0.1032 in 0.0..0.5,
        ] { aliases: &["poly3_free", "cubic"] },
        |t| ((a * t + b) * t + c) * t + d;

    ExpPlateau = CURVE_EXP_PLATEAU: "exp_plateau",
        "a (1 - exp(-b max(t, 1e-10)^c))",
        [a = 1.0799 in 0.1..5.0, b = 1.1150 in 0.01..10.0, c = 0.8076 in 0.1..3.0],
        |t| a * (b * t.at_least(T::from_f64(1e-10)).power(c)).one_minus_exp();

    PowerSoftexp = CURVE_POWER_SOFTEXP: "power_softexp",
        "(1 - exp(-a t))^b",
        [a = 1.0916 in 0.01..10.0, b = 0.7771 in 0.1..3.0] { bounded: true },
        |t| (a * t).one_minus_exp().power(b);

    LogCurve = CURVE_LOG_CURVE: "log_curve",
        "a ln(1 + b t)",
        [a = 0.3812 in 0.01..5.0, b = 5.5936 in 0.01..100.0],
        |t| a * (b * t).ln_1p();

    AcesFilmic = CURVE_ACES_FILMIC: "aces_filmic",
        "(a t^2 + b t) / (c t^2 + d t + e)",
        [
            a = 4.1542 in 0.0..20.0,
            b = 0.1109 in 0.0..5.0,
            c = 3.1762 in 0.0..20.0,
            d = 2.7073 in 0.0..20.0,
            e = 0.0001 in 1e-6..5.0,
        ] {
            // A common factor cancels.
            identifiable: false,
        },
        |t| (a * t + b) * t / ((c * t + d) * t + e);

    Reinhard = CURVE_REINHARD: "reinhard",
        "a t / (t + b + 1e-10)",
        [a = 1.2180 in 0.1..5.0, b = 0.6763 in 0.01..10.0],
        |t| a * t / (t + b + T::from_f64(1e-10));

    SoftexpGamma = CURVE_SOFTEXP_GAMMA: "softexp_gamma",
        "a (1 - exp(-b t))^c",
        [a = 1.0348 in 0.1..5.0, b = 0.9861 in 0.01..10.0, c = 0.7543 in 0.1..3.0],
        |t| a * (b * t).one_minus_exp().power(c);

    Rational = CURVE_RATIONAL: "rational",
        "(a t + b t^2) / (1 + c t + d t^2 + 1e-10)",
        [
            a = 3.4053 in 0.0..50.0,
            b = 50.0 in 0.0..200.0,
            c = 34.8493 in 0.0..200.0,
            d = 37.8681 in 0.0..200.0,
        ],
        |t| (a + b * t) * t / (T::from_f64(1.0) + (c + d * t) * t + T::from_f64(1e-10));

    Poly5Origin = CURVE_POLY5_ORIGIN: "poly5_origin",
        "a t^5 + b t^4 + c t^3 + d t^2 + e t",
        [
            a = 0.2331 in -5.0..5.0,
            b = -1.2710 in -10.0..10.0,
            c = 2.6300 in -10.0..10.0,
            d = -2.7450 in -10.0..10.0,
            e = 1.8784 in 0.0..10.0,
        ],
        |t| ((((a * t + b) * t + c) * t + d) * t + e) * t;

    DoubleExp = CURVE_DOUBLE_EXP: "double_exp",
        "a (1 - exp(-b t)) + c (1 - exp(-d t))",
        [
            a = 0.9233 in -5.0..5.0,
            b = 1.6887 in 0.01..10.0,
            c = -0.0076 from 0.1 in -5.0..5.0,
            d = 1.6900 from 6.0 in 0.01..50.0,
        ] {
            bounded: true,
            // The two terms can swap places and, if their rates are equal, weights.
            identifiable: false,
        },
        |t| a * (b * t).one_minus_exp() + c * (d * t).one_minus_exp();

    Gamma = CURVE_GAMMA: "gamma",
        "a max(t, 1e-10)^b",
        [a = 0.7199 in 0.05..5.0, b = 0.5617 in 0.1..3.0],
        |t| a * t.at_least(T::from_f64(1e-10)).power(b);

    SinhRatio = CURVE_SINH_RATIO: "sinh_ratio",
        "a sinh(b t) / (sinh(b t) + c)",
        [a = 1.0067 in 0.1..5.0, b = 1.3673 in 0.01..10.0, c = 0.7115 in 0.01..10.0],
        |t| {
            let q = (T::from_f64(2.0) * b * t).one_minus_exp();
            a * q / (q + T::from_f64(2.0) * c * (-b * t).exp())
        };

    Hybrid = CURVE_HYBRID: "hybrid",
        "a (1 - exp(-b t))^c + d max(t, 1e-10)^e",
        [
            a = 0.6643 in 0.0..5.0,
            b = 1.4166 in 0.01..10.0,
            c = 0.9383 in 0.1..3.0,
            d = 0.2156 in 0.0..5.0,
            e = 0.4584 in 0.1..3.0,
        ],
        |t| {
            let floor = t.at_least(T::from_f64(1e-10));
            a * (b * t).one_minus_exp().power(c) + d * floor.power(e)
        };

    Poly3Origin = CURVE_POLY3_ORIGIN: "poly3_origin",
        "a t^3 + b t^2 + c t",
        [a = 0.3515 in -2.0..2.0, b = -1.1996 in -5.0..5.0, c = 1.5639 in 0.0..5.0],
        |t| ((a * t + b) * t + c) * t;

    SoftexpMod = CURVE_SOFTEXP_MOD: "softexp_mod",
        "a (1 - exp(-b t)) + c t",
        [a = 0.5075 in 0.0..5.0, b = 3.1321 in 0.01..20.0, c = 0.2293 in 0.0..5.0],
        |t| a * (b * t).one_minus_exp() + c * t;

    SqrtBlend = CURVE_SQRT_BLEND: "sqrt_blend",
        "a sqrt(max(t, 1e-10)) + b t",
        [a = 0.6186 in 0.0..5.0, b = 0.0970 in 0.0..5.0],
        |t| a * t.at_least(T::from_f64(1e-10)).sqrt() + b * t;

    Softexp = CURVE_SOFTEXP: "softexp",
        "1 - exp(-a t)",
        [a = 1.609_437_912_434_100_3 in 0.01..10.0] {
            aliases: &["adaptive_softexp"],
            source: "the leaderboard's baseline, in its code 1 - exp(-ln 5 x / p90): f(1) = 0.8",
            bounded: true,
        },
        |t| (a * t).one_minus_exp();

    TanhCurve = CURVE_TANH_CURVE: "tanh_curve",
        "a tanh(b t)",
        [a = 0.8473 in 0.1..5.0, b = 1.4749 in 0.01..10.0] { bounded: true },
        |t| a * (b * t).tanh();

    ArctanCurve = CURVE_ARCTAN_CURVE: "arctan_curve",
        "a atan(b t) / (pi / 2)",
        [
            a = 0.6527 from 1.0 in 0.1..5.0,
            b = 2.1182 from 2.39 in 0.01..20.0,
        ] { aliases: &["arctan"], bounded: true },
        |t| a * (b * t).atan() / T::from_f64(FRAC_PI_2);

    Bezier3 = CURVE_BEZIER3: "bezier3",
        "s (3 (1 - s)^2 a s + 3 (1 - s) s^2 b + s^3), s = min(t, 1)",
        [a = 0.5561 in 0.0..3.0, b = 0.9430 in 0.0..3.0] { domain: [0.0, 1.0], bounded: true },
        |t| {
            let s = t.at_most(T::from_f64(1.0));
            let (left, three) = (T::from_f64(1.0) - s, T::from_f64(3.0));
            s * (three * left * left * a * s + three * left * s * s * b + s * s * s)
        };

    Piecewise3 = CURVE_PIECEWISE3: "piecewise3",
        "slopes a to t = d, b to t = e, then c; continuous, through 0",
        [
            a = 0.5473 from 1.37 in 0.0..10.0,
            b = 0.2111 from 0.46 in 0.0..10.0,
            c = 1.4447 from 0.1 in 0.0..10.0,
            d = 0.2513 from 0.3 in 0.01..1.0,
            e = 0.8845 from 1.2 in 0.1..4.0,
        ],
        |t| {
            let zero = T::from_f64(0.0);
            let first = t.at_most(d);
            let second = (t - d).at_least(zero).at_most(e - d);
            a * first + b * second + c * (t - e).at_least(zero)
        };

    Hable = CURVE_HABLE: "hable",
        "a (b t^2 + c t) / (d t^2 + e t + f + 1e-10)",
        [
            a = 0.9797 in 0.1..5.0,
            b = 0.0001 from 1.2 in 0.0..10.0,
            c = 0.3171 from 0.4 in 0.0..10.0,
            d = 1.2181 from 1.0 in 0.0..10.0,
            e = 0.2189 from 1.0 in 0.0..10.0,
            f = 0.0001 from 0.1 in 1e-6..10.0,
        ] { monotone: false, identifiable: false },
        |t| a * (b * t + c) * t / ((d * t + e) * t + f + T::from_f64(1e-10));

    Richards = CURVE_RICHARDS: "richards",
        "a (1 + b exp(-c t))^(-1 / d)",
        [
            a = 5.0 from 1.0 in 0.1..5.0,
            b = 0.1 from 7.4 in 0.0..100.0,
            c = 1.9246 from 4.0 in 0.01..20.0,
            d = 0.4813 from 1.0 in 0.05..5.0,
        ],
        |t| a * (T::from_f64(1.0) + b * (-c * t).exp()).power(-T::from_f64(1.0) / d);

    ArctanStandard = CURVE_ARCTAN_STANDARD: "arctan-standard",
        "(2 / pi) atan((pi / 2) a t)",
        [a = 1.52 in 0.01..20.0] {
            source: "the arctangent sigmoid with slope a at 0 and limit 1; a fitted to power_softexp on [0, 3]",
            bounded: true,
        },
        |t| (T::from_f64(FRAC_PI_2) * a * t).atan() / T::from_f64(FRAC_PI_2);

    Bezier3Standard = CURVE_BEZIER3_STANDARD: "bezier3-standard",
        "3 (1 - s)^2 s p1 + 3 (1 - s) s^2 p2 + s^3, s = min(t / end, 1)",
        [p1 = 1.15 in 0.0..2.0, p2 = 0.74 in 0.0..2.0, end = 2.7 in 0.1..10.0] {
            source: "a cubic Bezier curve (Bernstein form) from 0 to 1; constants fitted to power_softexp on [0, 3]",
            domain: [0.0, 2.7],
            bounded: true,
        },
        |t| {
            let s = (t / end).at_most(T::from_f64(1.0));
            let (left, three) = (T::from_f64(1.0) - s, T::from_f64(3.0));
            three * left * left * s * p1 + three * left * s * s * p2 + s * s * s
        };

    Piecewise3Standard = CURVE_PIECEWISE3_STANDARD: "piecewise3-standard",
        "straight lines through (0, 0), (t1, y1), (t2, y2), (t3, 1), then 1",
        [
            t1 = 0.3 in 0.01..1.0,
            y1 = 0.41 in 0.0..1.0,
            t2 = 1.2 in 0.1..3.0,
            y2 = 0.82 in 0.0..1.0,
            t3 = 3.0 in 0.5..10.0,
        ] {
            source: "linear interpolation between knots; knots fitted to power_softexp on [0, 3]",
            domain: [0.0, 3.0],
            bounded: true,
        },
        |t| {
            let (zero, one) = (T::from_f64(0.0), T::from_f64(1.0));
            let first = (t / t1).at_most(one);
            let second = ((t - t1).at_least(zero) / (t2 - t1)).at_most(one);
            let third = ((t - t2).at_least(zero) / (t3 - t2)).at_most(one);
            y1 * first + (y2 - y1) * second + (one - y2) * third
        };

    Hable2010 = CURVE_HABLE_2010: "hable-2010",
        "u(t) / u(w), u(t) = (t (a t + c b) + d e) / (t (a t + b) + d f) - e / f",
        [
            a = 0.15 in 0.01..2.0,
            b = 0.50 in 0.01..2.0,
            c = 0.10 in 0.0..2.0,
            d = 0.20 in 0.01..2.0,
            e = 0.02 in 0.0..1.0,
            f = 0.30 in 0.01..2.0,
            w = 11.2 in 0.5..20.0,
        ] {
            aliases: &["hable-standard"],
            source: "Hable 2010, Filmic tonemapping operators, without its exposure bias",
            identifiable: false,
        },
        |t| {
            let toe = e / f;
            let part = |t: T| {
                t * (a * t * (T::from_f64(1.0) - toe) + b * (c - toe)) / ((a * t + b) * t + d * f)
            };
            part(t) / part(w)
        };

    RichardsStandard = CURVE_RICHARDS_STANDARD: "richards-standard",
        "l / (1 + q exp(-k (t - t0)))^(1 / nu)",
        [
            l = 1.0 in 0.1..5.0,
            q = 1.0 in 0.01..10.0,
            k = 4.0 in 0.01..20.0,
            nu = 1.0 in 0.05..5.0,
            t0 = 0.5 in -5.0..5.0,
        ] {
            source: "Richards 1959, A flexible growth function; the constants make a logistic curve",
            bounded: true,
            // q and t0 have the same effect on the curve.
            identifiable: false,
        },
        |t| l * (T::from_f64(1.0) + q * (-k * (t - t0)).exp()).power(-T::from_f64(1.0) / nu);

    Tanh = CURVE_TANH: "tanh",
        "delta0 + (1 - delta0) tanh(g t), g = g0 + c Y",
        [] {
            aliases: &["adaptive_sigmoid"],
            source: MODE,
            bounded: true,
            is_rescaled: true,
            alpha: 0.12,
        },
        |t| t.tanh();

    AseFloor = CURVE_ASE_FLOOR: "ase_floor",
        "delta0 + A ((1 - a) (1 - exp(-g t)) + a t), A such that t = 1 maps as with ASE",
        [a = 0.1 in 0.0..1.0] {
            aliases: &["v4_floor", "adaptive_softexp_v4_floor"],
            source: "adaptive tone curves for 3DGS, a mode of its code; the share a of the straight line is our \
                 choice, 0 is ASE",
            is_rescaled: true,
            alpha: 0.12,
            gain_c: 3.0,
        },
        |t| t.one_minus_exp();

    P80 = CURVE_P80: "p80",
        "1 - exp(-gain x), gain = theta / p80 from 1 to 6",
        [] {
            aliases: &["p80_softexp"],
            source: MODE,
            bounded: true,
            is_of_t: false,
        },
        |t| t.one_minus_exp();

    LumPreserve = CURVE_LUM_PRESERVE: "lum_preserve",
        "x (Y gain) / (Y + 1e-6), gain = theta / mean(Y) from 1 to 6, Y the pixel's luminance",
        [] { source: MODE, is_of_t: false },
        |t| t;

    PerChannel = CURVE_PER_CHANNEL: "per_channel",
        "x theta / (mean(x) + 1e-6), each channel by its own mean",
        [] { source: MODE, is_of_t: false },
        |t| t;
}
