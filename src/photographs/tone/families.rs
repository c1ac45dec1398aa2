//! What a row of the table of curves holds, and the values, derivatives and gradients it gives.

mod catalogue;

use super::real::{Dual, Real, within};

pub(crate) use catalogue::{Constants, curve_shape};
pub use catalogue::{FAMILIES, ToneCurve};

/// How black level and gain join a curve's shape f.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OffsetMode {
    /// delta0 + b f(t), b = 1 + c Y: AP3's.
    Added,
    /// delta0 + (1 - delta0) f(g t), g = g0 + c Y: ASE's.
    Rescaled,
}

/// The value that t = 1 stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum White {
    /// 1: the photograph as stored.
    One,
    /// The mean over all channels, divided by theta.
    Mean,
    /// The 90th percentile of the luminance.
    P90,
    /// 1 / gain with the gain theta / p80, from 1 to 6.
    P80,
    /// One gain for the luminance, theta over its mean, from 1 to 6.
    MeanLuminance,
    /// Each channel's mean divided by theta.
    ChannelMeans,
}

/// A constant of a family.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Constant {
    /// Its name in the formula and in TOML files.
    pub name: &'static str,
    /// Its value where none is given.
    pub default: f64,
    /// Where a fit begins.
    pub start: f64,
    /// The least and the greatest value that a fit may try.
    pub bounds: [f64; 2],
}

/// A family of curves.
#[derive(Clone, Copy, Debug)]
pub struct Family {
    /// The row's curve.
    pub curve: ToneCurve,
    /// The name on the command line, in files and on plots.
    pub name: &'static str,
    /// Other names that are understood.
    pub aliases: &'static [&'static str],
    /// The value in terms of t and the constants, before it is clamped to [0, 1].
    pub formula: &'static str,
    /// Where formula and constants come from.
    pub source: &'static str,
    /// The constants in the formula's order.
    pub constants: &'static [Constant],
    /// The values of t between which the formula acts; beyond, the curve is constant.
    #[cfg_attr(not(feature = "testing"), expect(dead_code, reason = "what tests hold a curve to"))]
    pub domain: [f64; 2],
    /// With its default constants the clamped curve never falls.
    pub monotone: bool,
    /// With its default constants the curve never passes 1, so nothing clips.
    pub bounded: bool,
    /// Data determine the constants one by one; otherwise a fit finds one of many that are alike.
    #[cfg_attr(not(feature = "testing"), expect(dead_code, reason = "what tests hold a curve to"))]
    pub identifiable: bool,
    /// How black level and gain join the shape.
    pub law: OffsetMode,
    /// The value that t = 1 stands for.
    pub white: White,
    /// alpha where none is given: the highest black level.
    pub alpha: f64,
    /// c where none is given: the gain per mean luminance.
    pub gain_c: f64,
}

impl Family {
    /// The constants where none are given.
    pub fn defaults(&self) -> Vec<f64> {
        self.constants.iter().map(|constant| constant.default).collect()
    }

    /// The shape f(t) without black level, gain and clamp; t outside [0, 1e7], or no number, counts as the end it is at.
    pub fn shape(&self, t: f64, constants: &[f64]) -> f64 {
        curve_shape(self.curve as u32, within(t), &padded(constants))
    }

    /// df/dt, exact; at a knee that of one of the sides.
    #[cfg(feature = "testing")]
    pub fn derivative(&self, t: f64, constants: &[f64]) -> f64 {
        let constants = padded(constants).map(Dual::of);
        curve_shape(self.curve as u32, within(Dual::variable(t)), &constants).derivative
    }

    /// df/dc of every constant, exact.
    #[cfg(feature = "testing")]
    pub fn gradient(&self, t: f64, constants: &[f64]) -> Vec<f64> {
        let derivative = |index: usize| {
            let mut constants = padded(constants).map(Dual::of);
            constants[index].derivative = 1.0;
            curve_shape(self.curve as u32, Dual::of(within(t)), &constants).derivative
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

/// The constants as the kernels hold them.
pub(super) fn padded(constants: &[f64]) -> Constants<f64> {
    std::array::from_fn(|index| constants.get(index).copied().unwrap_or(0.0))
}
