//! The formulas of tone curves, a row each, and the curve that a model states. `nightsplat_photographs::tone` applies
//! them to photographs.

mod catalogue;
mod curve;
mod families;
mod real;
mod scene_law;

use std::fmt;
use std::str::FromStr;

use bytemuck::{Pod, Zeroable};

pub use self::catalogue::*;
pub use self::curve::{bounded, clamped, curve_at, mirrored, shoulder, toe, tone_curve};
pub use self::families::{Constant, Family, padded};
pub use self::real::{Dual, LARGEST_T, Real, within};
pub use self::scene_law::SceneLaw;
use crate::settings::distance;
use crate::{Error, Result};

/// A curve whose values are in a file; the curves below it are the rows of [`FAMILIES`].
pub const CURVE_TABLE: u32 = FAMILIES.len() as u32;
/// The automatic curve.
pub const CURVE_AUTO: u32 = CURVE_TABLE + 1;
/// A camera profile.
pub const CURVE_PROFILE: u32 = CURVE_TABLE + 2;

/// The most constants of a family.
pub const MAX_CONSTANTS: usize = 8;

/// The numbers of one photograph's curve, as the kernels take them (`include/tone.glsl`).
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct ToneParameters {
    /// The value that t = 1 corresponds to.
    pub white: f32,
    /// delta0, the black level of the target.
    pub offset: f32,
    /// The gain of the curve.
    pub gain: f32,
    /// The weight of the curve, relative to the unchanged photograph, 0 to 1.
    pub weight: f32,
    /// Constants of the family, zeros at the end; the first three are the white of each channel, if channels differ.
    // A literal: with the constant, rustc 1.95 stops with an internal error at a closure that copies a part of it.
    pub constants: [f32; 8],
}

const _: () = assert!(MAX_CONSTANTS == 8);

/// The name of the curve of this number in `include/curves.glsl`.
pub fn name_of(number: u32) -> &'static str {
    match number {
        CURVE_TABLE => "table",
        CURVE_AUTO => "auto",
        CURVE_PROFILE => "profile",
        family => FAMILIES[family as usize].name,
    }
}

impl ToneCurve {
    /// The formula's row in the table.
    #[doc(hidden)]
    pub fn family(self) -> &'static Family {
        &FAMILIES[self as usize]
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        self.family().name
    }

    /// The number in `include/curves.glsl`: the specialization constant `TONE_CURVE`.
    #[doc(hidden)]
    pub fn constant(self) -> u32 {
        self as u32
    }

    /// The curve at t = x / white, in [0, 1], in f64.
    ///
    /// `lum_preserve` and `per_channel` are straight lines here: they depend on more than one value.
    #[doc(hidden)]
    pub fn value(self, t: f64, offset: f64, gain: f64, constants: &[f64]) -> f64 {
        let constants = padded(constants);
        clamped(curve_at(self.constant(), t, [offset, gain], &constants))
    }

    /// The curve at the sRGB-encoded value `x`, in the arithmetic of the kernels.
    #[doc(hidden)]
    pub fn apply(self, x: f32, parameters: &ToneParameters) -> f32 {
        tone_curve(self.constant(), x, parameters)
    }

    /// All names, for help texts and errors.
    #[doc(hidden)]
    pub fn names() -> String {
        let families = Self::ALL.map(Self::name).join(", ");
        format!("{}, {families}", name_of(CURVE_AUTO))
    }
}

impl fmt::Display for ToneCurve {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for ToneCurve {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Family::find(name).map(|family| family.curve).ok_or_else(|| {
            let nearest = Self::ALL.into_iter().min_by_key(|curve| distance(name, curve.name()));
            let nearest = nearest.map_or("", Self::name);
            let names = Self::names();
            Error::Usage(format!(
                "unknown curve `{name}`; the nearest is `{nearest}`, and the curves are {names}"
            ))
        })
    }
}
