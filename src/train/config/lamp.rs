//! Settings of a lamp that moves with the camera.

use std::ops::Bound;

use nightsplat_core::settings;
use nightsplat_core::settings::Rule;

use crate::kernels::lamp::LAMP_LARGEST_EXPONENT;

settings! {
"lamp."
/// A lamp that moves with the camera, from which its learning begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LampConfig {
    /// The power of the distance by which its light falls: 2 for a point in clear air, less for a wide source, more in
    /// water.
    exponent: f64 = 2.0 => Rule::from_to(0.0, LAMP_LARGEST_EXPONENT);
    /// The light that does not move with the camera, as a share of all light on the axis at the reference distance.
    ambient: f64 = 0.05 => Rule::Number(Bound::Included(0.0), Bound::Excluded(1.0));
    /// The fall of its light away from its axis, with u = 1 - cos of the angle: by exp(-falloff u), and by the square
    /// of u as well.
    falloff: f64 = 0.0 => Rule::from_to(0.0, 1000.0);
    /// The part of the fall with the square of u.
    falloff_squared: f64 = 0.0 => Rule::from_to(0.0, 1000.0);
}
sections {
    /// Adam's learning rate.
    rates: LampRates;
}
}

settings! {
"lamp.rates."
/// Adam's learning rate of the lamp's numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LampRates {
    /// Adam's rate of the lamp's numbers at the start.
    initial: f64 = 0.03 => Rule::POSITIVE;
    /// Adam's rate of the lamp's numbers from the end of its exponential decay on.
    last: f64 = 0.003 => Rule::POSITIVE;
    /// The steps of the decay.
    steps: u64 = 1000 => Rule::COUNT, in "steps";
    /// The steps before the first one that changes the lamp, in which colours settle.
    after: u64 = 100 => Rule::COUNT, in "steps";
}
}

impl LampRates {
    /// The rate of a step, counted from 1.
    pub(in crate::train) fn at(&self, step: u64) -> f64 {
        let done = (step as f64 / self.steps.max(1) as f64).min(1.0);
        self.initial * (self.last / self.initial).powf(done)
    }
}
