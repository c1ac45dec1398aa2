//! Rows of the table of curves: values, derivatives and gradients.

use std::borrow::Cow;

use super::real::{Dual, Real, within};

use super::catalogue::{Constants, FAMILIES, ToneCurve, curve_shape};

/// A constant of a formula.
#[derive(Clone, Debug, PartialEq)]
pub struct Constant {
    /// Its name in the formula and in TOML files.
    pub name: Cow<'static, str>,
    /// Its default value.
    pub default: f64,
    /// The start of a fit.
    pub start: f64,
    /// Minimum and maximum in a fit.
    pub bounds: [f64; 2],
}

/// A family of curves.
#[derive(Clone, Copy, Debug)]
pub struct Family {
    /// The row's curve.
    pub curve: ToneCurve,
    /// The name on the command line, in files and in plots.
    pub name: &'static str,
    /// Alternative names.
    pub aliases: &'static [&'static str],
    /// The value in terms of t and the constants, before it is clamped to [0, 1].
    pub formula: &'static str,
    /// The source of formula and constants.
    pub source: &'static str,
    /// The constants in the formula's order.
    pub constants: &'static [Constant],
    /// The range of t in which the formula applies; beyond, the curve is constant.
    pub domain: [f64; 2],
    /// Whether the clamped curve never falls, with its default constants.
    pub monotone: bool,
    /// Whether the curve never exceeds 1 with its default constants, so nothing clips.
    pub bounded: bool,
    /// Whether data determine each constant; otherwise a fit finds one of many equivalent solutions.
    pub identifiable: bool,
    /// Whether black level and gain rescale the shape, delta0 + (1 - delta0) f(g t) with g = g0 + c Y as ASE; else it
    /// is delta0 + b f(t) with b = 1 + c Y, as AP3.
    pub is_rescaled: bool,
    /// Whether it is a function of t = x / p90; else its formula says what it makes of x.
    pub is_of_t: bool,
    /// alpha, the highest black level, by default.
    pub alpha: f64,
    /// c, the gain per mean luminance, by default.
    pub gain_c: f64,
}

impl Family {
    /// The default constants.
    pub fn defaults(&self) -> Vec<f64> {
        self.constants.iter().map(|constant| constant.default).collect()
    }

    /// The shape f(t) without black level, gain and clamp; t is clamped to [0, 1e7], and a NaN is 0.
    pub fn shape(&self, t: f64, constants: &[f64]) -> f64 {
        curve_shape(self.curve as u32, within(t), &padded(constants))
    }

    /// df/dt, exact; at a knee, the derivative of one side.
    pub fn derivative(&self, t: f64, constants: &[f64]) -> f64 {
        let constants = padded(constants).map(Dual::from_f64);
        curve_shape(self.curve as u32, within(Dual::variable(t)), &constants).derivative
    }

    /// df/dc of every constant, exact.
    pub fn gradient(&self, t: f64, constants: &[f64]) -> Vec<f64> {
        let derivative = |index: usize| {
            let mut constants = padded(constants).map(Dual::from_f64);
            constants[index].derivative = 1.0;
            curve_shape(self.curve as u32, Dual::from_f64(within(t)), &constants).derivative
        };
        (0..self.constants.len()).map(derivative).collect()
    }

    /// The family of that name or alias.
    pub fn find(name: &str) -> Option<&'static Self> {
        FAMILIES.iter().find(|family| {
            family.name.eq_ignore_ascii_case(name)
                || family.aliases.iter().any(|alias| alias.eq_ignore_ascii_case(name))
        })
    }
}

/// The constants, padded for the kernels.
pub fn padded(constants: &[f64]) -> Constants<f64> {
    std::array::from_fn(|index| constants.get(index).copied().unwrap_or(0.0))
}
