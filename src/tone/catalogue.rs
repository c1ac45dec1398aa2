//! The one table of curves: names, formulas, constants, properties and sources.
//!
//! A curve is a row here, a function in `include/curves.glsl` and its twin in `reference/curves.rs`. The command line,
//! the help texts, `nightsplat curves`, TOML files and fitting all read this table.

use super::families::{Constant, Family, Law, ToneCurve, White};

const fn c(name: &'static str, default: f64, low: f64, high: f64) -> Constant {
    Constant { name, default, start: default, bounds: [low, high] }
}

/// Where the default is a failed fit, a fit begins elsewhere.
const fn c_from(name: &'static str, default: f64, start: f64, low: f64, high: f64) -> Constant {
    Constant { name, default, start, bounds: [low, high] }
}

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
    law: Law::Added,
    white: White::P90,
    alpha: 0.0,
    gain_c: 0.0,
};

/// Every family, by its number; the table of values a file gives is no family.
pub static FAMILIES: [Family; ToneCurve::Table as usize] = [
    Family {
        curve: ToneCurve::None,
        name: "none",
        formula: "x: the photograph as it is",
        source: "no curve at all, for comparison",
        white: White::One,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Linear,
        name: "linear",
        aliases: &["mean_hard"],
        formula: "x theta / mean(x)",
        source: "the paper's linear baseline",
        white: White::Mean,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Ase,
        name: "ase",
        aliases: &["adaptive_softexp_v2"],
        formula: "delta0 + (1 - delta0) (1 - exp(-g t)), g = g0 + c Y",
        source: "the paper's adaptive soft exponential",
        bounded: true,
        law: Law::Rescaled,
        alpha: 0.12,
        gain_c: 3.0,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Ap3,
        name: "ap3",
        aliases: &["adaptive_poly3"],
        formula: "delta0 + b (0.0720 t^3 - 0.4376 t^2 + 0.9948 t), b = 1 + c Y",
        source: "the paper's adaptive cubic",
        alpha: 0.12,
        gain_c: 1.0,
        ..FITTED
    },
    Family {
        curve: ToneCurve::FittedCubic,
        name: "fitted_cubic",
        aliases: &["poly3_free", "cubic"],
        formula: "a t^3 + b t^2 + c t + d",
        constants: &[
            c("a", 0.0720, -2.0, 2.0),
            c("b", -0.4376, -5.0, 5.0),
            c("c", 0.9948, -5.0, 5.0),
            c("d", 0.1032, 0.0, 0.5),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::ExpPlateau,
        name: "exp_plateau",
        formula: "a (1 - exp(-b max(t, 1e-10)^c))",
        constants: &[
            c("a", 1.0799, 0.1, 5.0),
            c("b", 1.1150, 0.01, 10.0),
            c("c", 0.8076, 0.1, 3.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::PowerSoftexp,
        name: "power_softexp",
        formula: "(1 - exp(-a t))^b",
        constants: &[c("a", 1.0916, 0.01, 10.0), c("b", 0.7771, 0.1, 3.0)],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::LogCurve,
        name: "log_curve",
        formula: "a ln(1 + b t)",
        constants: &[c("a", 0.3812, 0.01, 5.0), c("b", 5.5936, 0.01, 100.0)],
        ..FITTED
    },
    Family {
        curve: ToneCurve::AcesFilmic,
        name: "aces_filmic",
        formula: "(a t^2 + b t) / (c t^2 + d t + e)",
        constants: &[
            c("a", 4.1542, 0.0, 20.0),
            c("b", 0.1109, 0.0, 5.0),
            c("c", 3.1762, 0.0, 20.0),
            c("d", 2.7073, 0.0, 20.0),
            c("e", 0.0001, 1e-6, 5.0),
        ],
        // A common factor cancels.
        identifiable: false,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Reinhard,
        name: "reinhard",
        formula: "a t / (t + b + 1e-10)",
        constants: &[c("a", 1.2180, 0.1, 5.0), c("b", 0.6763, 0.01, 10.0)],
        ..FITTED
    },
    Family {
        curve: ToneCurve::SoftexpGamma,
        name: "softexp_gamma",
        formula: "a (1 - exp(-b t))^c",
        constants: &[
            c("a", 1.0348, 0.1, 5.0),
            c("b", 0.9861, 0.01, 10.0),
            c("c", 0.7543, 0.1, 3.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::Rational,
        name: "rational",
        formula: "(a t + b t^2) / (1 + c t + d t^2 + 1e-10)",
        constants: &[
            c("a", 3.4053, 0.0, 50.0),
            c("b", 50.0, 0.0, 200.0),
            c("c", 34.8493, 0.0, 200.0),
            c("d", 37.8681, 0.0, 200.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::Poly5Origin,
        name: "poly5_origin",
        formula: "a t^5 + b t^4 + c t^3 + d t^2 + e t",
        constants: &[
            c("a", 0.2331, -5.0, 5.0),
            c("b", -1.2710, -10.0, 10.0),
            c("c", 2.6300, -10.0, 10.0),
            c("d", -2.7450, -10.0, 10.0),
            c("e", 1.8784, 0.0, 10.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::DoubleExp,
        name: "double_exp",
        formula: "a (1 - exp(-b t)) + c (1 - exp(-d t))",
        constants: &[
            c("a", 0.9233, -5.0, 5.0),
            c("b", 1.6887, 0.01, 10.0),
            c_from("c", -0.0076, 0.1, -5.0, 5.0),
            c_from("d", 1.6900, 6.0, 0.01, 50.0),
        ],
        bounded: true,
        // The two terms trade places and, where their rates agree, weights.
        identifiable: false,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Gamma,
        name: "gamma",
        formula: "a max(t, 1e-10)^b",
        constants: &[c("a", 0.7199, 0.05, 5.0), c("b", 0.5617, 0.1, 3.0)],
        ..FITTED
    },
    Family {
        curve: ToneCurve::SinhRatio,
        name: "sinh_ratio",
        formula: "a sinh(b t) / (sinh(b t) + c)",
        constants: &[
            c("a", 1.0067, 0.1, 5.0),
            c("b", 1.3673, 0.01, 10.0),
            c("c", 0.7115, 0.01, 10.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::Hybrid,
        name: "hybrid",
        formula: "a (1 - exp(-b t))^c + d max(t, 1e-10)^e",
        constants: &[
            c("a", 0.6643, 0.0, 5.0),
            c("b", 1.4166, 0.01, 10.0),
            c("c", 0.9383, 0.1, 3.0),
            c("d", 0.2156, 0.0, 5.0),
            c("e", 0.4584, 0.1, 3.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::Poly3Origin,
        name: "poly3_origin",
        formula: "a t^3 + b t^2 + c t",
        constants: &[
            c("a", 0.3515, -2.0, 2.0),
            c("b", -1.1996, -5.0, 5.0),
            c("c", 1.5639, 0.0, 5.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::SoftexpMod,
        name: "softexp_mod",
        formula: "a (1 - exp(-b t)) + c t",
        constants: &[
            c("a", 0.5075, 0.0, 5.0),
            c("b", 3.1321, 0.01, 20.0),
            c("c", 0.2293, 0.0, 5.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::SqrtBlend,
        name: "sqrt_blend",
        formula: "a sqrt(max(t, 1e-10)) + b t",
        constants: &[c("a", 0.6186, 0.0, 5.0), c("b", 0.0970, 0.0, 5.0)],
        ..FITTED
    },
    Family {
        curve: ToneCurve::Softexp,
        name: "softexp",
        aliases: &["adaptive_softexp"],
        formula: "1 - exp(-a t)",
        source: "the leaderboard's baseline, in its code 1 - exp(-ln 5 x / p90): f(1) = 0.8",
        constants: &[c("a", 1.609_437_912_434_100_3, 0.01, 10.0)],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::TanhCurve,
        name: "tanh_curve",
        formula: "a tanh(b t)",
        constants: &[c("a", 0.8473, 0.1, 5.0), c("b", 1.4749, 0.01, 10.0)],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::ArctanCurve,
        name: "arctan_curve",
        aliases: &["arctan"],
        formula: "a atan(b t) / (pi / 2)",
        constants: &[c_from("a", 0.6527, 1.0, 0.1, 5.0), c_from("b", 2.1182, 2.39, 0.01, 20.0)],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Bezier3,
        name: "bezier3",
        formula: "s (3 (1 - s)^2 a s + 3 (1 - s) s^2 b + s^3), s = min(t, 1)",
        constants: &[c("a", 0.5561, 0.0, 3.0), c("b", 0.9430, 0.0, 3.0)],
        domain: [0.0, 1.0],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Piecewise3,
        name: "piecewise3",
        formula: "slopes a to t = d, b to t = e, then c; continuous, through 0",
        constants: &[
            c_from("a", 0.5473, 1.37, 0.0, 10.0),
            c_from("b", 0.2111, 0.46, 0.0, 10.0),
            c_from("c", 1.4447, 0.1, 0.0, 10.0),
            c_from("d", 0.2513, 0.3, 0.01, 1.0),
            c_from("e", 0.8845, 1.2, 0.1, 4.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::Hable,
        name: "hable",
        formula: "a (b t^2 + c t) / (d t^2 + e t + f + 1e-10)",
        constants: &[
            c("a", 0.9797, 0.1, 5.0),
            c_from("b", 0.0001, 1.2, 0.0, 10.0),
            c_from("c", 0.3171, 0.4, 0.0, 10.0),
            c_from("d", 1.2181, 1.0, 0.0, 10.0),
            c_from("e", 0.2189, 1.0, 0.0, 10.0),
            c_from("f", 0.0001, 0.1, 1e-6, 10.0),
        ],
        monotone: false,
        identifiable: false,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Richards,
        name: "richards",
        formula: "a (1 + b exp(-c t))^(-1 / d)",
        constants: &[
            c_from("a", 5.0, 1.0, 0.1, 5.0),
            c_from("b", 0.1, 7.4, 0.0, 100.0),
            c_from("c", 1.9246, 4.0, 0.01, 20.0),
            c_from("d", 0.4813, 1.0, 0.05, 5.0),
        ],
        ..FITTED
    },
    Family {
        curve: ToneCurve::ArctanStandard,
        name: "arctan-standard",
        formula: "(2 / pi) atan((pi / 2) a t)",
        source: "the arctangent sigmoid with slope a at 0 and limit 1; a fitted to power_softexp on [0, 3]",
        constants: &[c("a", 1.52, 0.01, 20.0)],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Bezier3Standard,
        name: "bezier3-standard",
        formula: "3 (1 - s)^2 s p1 + 3 (1 - s) s^2 p2 + s^3, s = min(t / end, 1)",
        source: "a cubic Bezier curve (Bernstein form) from 0 to 1; constants fitted to power_softexp on [0, 3]",
        constants: &[c("p1", 1.15, 0.0, 2.0), c("p2", 0.74, 0.0, 2.0), c("end", 2.7, 0.1, 10.0)],
        domain: [0.0, 2.7],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Piecewise3Standard,
        name: "piecewise3-standard",
        formula: "straight lines through (0, 0), (t1, y1), (t2, y2), (t3, 1), then 1",
        source: "linear interpolation between knots; knots fitted to power_softexp on [0, 3]",
        constants: &[
            c("t1", 0.3, 0.01, 1.0),
            c("y1", 0.41, 0.0, 1.0),
            c("t2", 1.2, 0.1, 3.0),
            c("y2", 0.82, 0.0, 1.0),
            c("t3", 3.0, 0.5, 10.0),
        ],
        domain: [0.0, 3.0],
        bounded: true,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Hable2010,
        name: "hable-2010",
        aliases: &["hable-standard"],
        formula: "u(t) / u(w), u(t) = (t (a t + c b) + d e) / (t (a t + b) + d f) - e / f",
        source: "Hable 2010, Filmic tonemapping operators, without its exposure bias",
        constants: &[
            c("a", 0.15, 0.01, 2.0),
            c("b", 0.50, 0.01, 2.0),
            c("c", 0.10, 0.0, 2.0),
            c("d", 0.20, 0.01, 2.0),
            c("e", 0.02, 0.0, 1.0),
            c("f", 0.30, 0.01, 2.0),
            c("w", 11.2, 0.5, 20.0),
        ],
        identifiable: false,
        ..FITTED
    },
    Family {
        curve: ToneCurve::RichardsStandard,
        name: "richards-standard",
        formula: "l / (1 + q exp(-k (t - t0)))^(1 / nu)",
        source: "Richards 1959, A flexible growth function; the constants make a logistic curve",
        constants: &[
            c("l", 1.0, 0.1, 5.0),
            c("q", 1.0, 0.01, 10.0),
            c("k", 4.0, 0.01, 20.0),
            c("nu", 1.0, 0.05, 5.0),
            c("t0", 0.5, -5.0, 5.0),
        ],
        bounded: true,
        // q and t0 move the curve alike.
        identifiable: false,
        ..FITTED
    },
    Family {
        curve: ToneCurve::Tanh,
        name: "tanh",
        aliases: &["adaptive_sigmoid"],
        formula: "delta0 + (1 - delta0) tanh(g t), g = g0 + c Y",
        source: MODE,
        bounded: true,
        law: Law::Rescaled,
        alpha: 0.12,
        ..FITTED
    },
    Family {
        curve: ToneCurve::AseFloor,
        name: "ase_floor",
        aliases: &["v4_floor", "adaptive_softexp_v4_floor"],
        formula: "delta0 + A ((1 - a) (1 - exp(-g t)) + a t), A such that t = 1 maps as with ASE",
        source: "adaptive tone curves for 3DGS, a mode of its code; the share a of the straight line is our choice, 0 is ASE",
        constants: &[c("a", 0.1, 0.0, 1.0)],
        law: Law::Rescaled,
        alpha: 0.12,
        gain_c: 3.0,
        ..FITTED
    },
    Family {
        curve: ToneCurve::P80,
        name: "p80",
        aliases: &["p80_softexp"],
        formula: "1 - exp(-gain x), gain = theta / p80 from 1 to 6",
        source: MODE,
        bounded: true,
        white: White::P80,
        ..FITTED
    },
    Family {
        curve: ToneCurve::LumPreserve,
        name: "lum_preserve",
        formula: "x (Y gain) / (Y + 1e-6), gain = theta / mean(Y) from 1 to 6, Y the pixel's luminance",
        source: MODE,
        white: White::MeanLuminance,
        ..FITTED
    },
    Family {
        curve: ToneCurve::PerChannel,
        name: "per_channel",
        formula: "x theta / (mean(x) + 1e-6), each channel by its own mean",
        source: MODE,
        white: White::ChannelMeans,
        ..FITTED
    },
];
