//! The lamp of `include/lamp_falloff.glsl`, in f64, from the numbers of the device.

use glam::DVec3;

use super::gaussian::sigmoid;
use super::rounding::UNIT;
use crate::kernels::lamp::{
    LAMP_AMBIENT, LAMP_BLACK, LAMP_EXPONENT, LAMP_FALLOFF_STEP, LAMP_FALLOFFS, LAMP_FARTHEST,
    LAMP_KNEE, LAMP_LARGEST_EXPONENT, LAMP_LEAST_AMBIENT, LAMP_LEFT, LAMP_NEAREST, LAMP_NUMBERS,
    LAMP_REACH, LAMP_REFERENCE_DISTANCE, LAMP_SLOPE, LAMP_STEP, LAMP_WIDTH,
};

/// The learned numbers of the device.
pub const WIDTH: usize = LAMP_WIDTH as usize;

/// A lamp, from the numbers of the device.
#[derive(Clone, Copy, Debug)]
pub struct ReferenceLamp {
    numbers: [f64; LAMP_NUMBERS as usize],
    position: DVec3,
    /// (x, y, 1)
    tangents: DVec3,
    ambient: f64,
    exponent: f64,
    falloffs: [f64; 2],
    reference_distance: f64,
    slope: f64,
    black: f64,
    reach: f64,
}

/// The numbers that factor and gradient of a point have in common.
struct LampPoint {
    axis: DVec3,
    towards: DVec3,
    length: f64,
    distance: f64,
    away: f64,
    beam: f64,
    light: f64,
}

impl ReferenceLamp {
    /// The lamp of these numbers, (`LAMP_NUMBERS`).
    pub fn from_numbers<T: Copy + Into<f64>>(numbers: &[T]) -> Self {
        let numbers: [f64; LAMP_NUMBERS as usize] = std::array::from_fn(|n| numbers[n].into());
        let at = |n: u32| numbers[n as usize];
        let softplus = |x: f64| x.max(0.0) + (-x.abs()).exp().ln_1p();
        let reference_distance = at(LAMP_REFERENCE_DISTANCE);
        Self {
            position: LAMP_STEP * reference_distance * DVec3::from_slice(&numbers),
            tangents: DVec3::new(LAMP_STEP * at(3), LAMP_STEP * at(4), 1.0),
            ambient: LAMP_LEAST_AMBIENT + (1.0 - LAMP_LEAST_AMBIENT) * sigmoid(at(LAMP_AMBIENT)),
            exponent: LAMP_LARGEST_EXPONENT * sigmoid(at(LAMP_EXPONENT)),
            falloffs: [0, 1].map(|k| LAMP_FALLOFF_STEP * softplus(at(LAMP_FALLOFFS + k))),
            reference_distance,
            slope: at(LAMP_SLOPE),
            black: at(LAMP_BLACK),
            reach: at(LAMP_REACH),
            numbers,
        }
    }

    fn at(&self, point: DVec3) -> LampPoint {
        let offset = point - self.position;
        let length = offset.length();
        let bounded = (length / self.reference_distance).clamp(LAMP_NEAREST, LAMP_FARTHEST);
        let distance = self.reference_distance * bounded;
        let axis = self.tangents.normalize();
        let towards = offset / distance;
        let away = 1.0 - towards.dot(axis).clamp(-1.0, 1.0);
        let [first, second] = self.falloffs;
        let beam = (-self.exponent * bounded.ln() - (first + second * away) * away).exp();
        let light = self.ambient + (1.0 - self.ambient) * beam;
        LampPoint { axis, towards, length, distance, away, beam, light }
    }

    /// light^slope at a point in view space: the factor on the argument of the tone law.
    pub fn factor(&self, point: DVec3) -> f64 {
        self.at(point).light.powf(self.slope)
    }

    /// The colour at a point in view space, before it is clamped.
    pub fn lit(&self, color: DVec3, point: DVec3) -> DVec3 {
        let factor = self.factor(point);
        color.map(|value| self.black + self.tone(factor * self.tone_inverse(value - self.black)))
    }

    fn tone(&self, x: f64) -> f64 {
        let bent = x / self.reach;
        if self.reach == 0.0 || bent < 0.0 {
            return x;
        }
        let line = 1.0 - LAMP_LEFT + LAMP_LEFT * (bent - LAMP_KNEE);
        self.reach * if bent < LAMP_KNEE { -(-bent).exp_m1() } else { line }
    }

    fn tone_inverse(&self, above: f64) -> f64 {
        let share = above / self.reach;
        if self.reach == 0.0 || share < 0.0 {
            return above;
        }
        let line = LAMP_KNEE + (share - (1.0 - LAMP_LEFT)) / LAMP_LEFT;
        self.reach * if share < 1.0 - LAMP_LEFT { -(-share).ln_1p() } else { line }
    }

    fn tone_slope(&self, x: f64) -> f64 {
        if self.reach == 0.0 || x < 0.0 { 1.0 } else { (-(x / self.reach).min(LAMP_KNEE)).exp() }
    }

    /// From the gradient of a lit colour to those of the colour without the lamp and of ln factor.
    pub fn lit_backward(&self, lit: DVec3, d_lit: DVec3, point: DVec3) -> (DVec3, f64) {
        let factor = self.factor(point);
        let x = lit.map(|value| self.tone_inverse(value - self.black));
        let d_x = d_lit * x.map(|x| self.tone_slope(x));
        (factor * d_x / (x / factor).map(|x| self.tone_slope(x)), d_x.dot(x))
    }

    /// The gradient of ln factor, from that of the colour without the lamp.
    pub fn log_factor_gradient(&self, lit: DVec3, d_color: DVec3, point: DVec3) -> f64 {
        let x = lit.map(|value| self.tone_inverse(value - self.black)) / self.factor(point);
        d_color.dot(x * x.map(|x| self.tone_slope(x)))
    }

    /// A bound of the relative change of a lit colour, and of its gradient, over that of the colour.
    pub(super) fn steepness(&self) -> f64 {
        if self.reach == 0.0 { 1.0 } else { 1.0 / LAMP_LEFT }
    }

    /// The relative rounding error of the factor: exponentials and logarithms have errors of a few units in the last
    /// place, and of their arguments, which are sums of these magnitudes.
    pub(super) fn factor_error(&self, point: DVec3) -> f64 {
        let at = self.at(point);
        let [first, second] = self.falloffs;
        let magnitude = self.exponent * (1.0 + (at.distance / self.reference_distance).ln().abs())
            + 4.0 * first
            + 8.0 * second;
        64.0 * UNIT * (1.0 + self.slope * (1.0 + magnitude + at.light.ln().abs()))
    }

    fn share(&self, at: &LampPoint) -> f64 {
        (1.0 - self.ambient) * at.beam / at.light
    }

    fn turn(&self, at: &LampPoint) -> f64 {
        self.falloffs[0] + 2.0 * self.falloffs[1] * at.away
    }

    /// The gradient of ln factor with respect to the point.
    pub fn point_gradient(&self, point: DVec3) -> DVec3 {
        let at = self.at(point);
        if at.length > LAMP_FARTHEST * self.reference_distance {
            return DVec3::ZERO;
        }
        let turn = self.turn(&at);
        let mut gradient = turn * at.axis;
        if at.length >= LAMP_NEAREST * self.reference_distance {
            gradient -= (self.exponent + turn * at.towards.dot(at.axis)) * at.towards;
        }
        self.slope * self.share(&at) / at.distance * gradient
    }

    /// The rounding error of [`ReferenceLamp::point_gradient`], whose terms can cancel.
    pub(super) fn point_gradient_error(&self, point: DVec3) -> f64 {
        let at = self.at(point);
        let terms = self.exponent + 2.0 * self.falloffs[0] + 8.0 * self.falloffs[1];
        (256.0 * UNIT + self.factor_error(point)) * self.slope * self.share(&at) * terms
            / at.distance
    }

    /// The gradient of ln factor with respect to the learned numbers.
    pub fn gradient(&self, point: DVec3) -> [f64; WIDTH] {
        let at = self.at(point);
        let share = self.slope * self.share(&at);
        let d_position = -LAMP_STEP * self.reference_distance * self.point_gradient(point);
        let is_far = at.length > LAMP_FARTHEST * self.reference_distance;
        let d_axis = if is_far { DVec3::ZERO } else { share * self.turn(&at) * at.towards };
        let d_tangents =
            LAMP_STEP * (d_axis - at.axis * at.axis.dot(d_axis)) / self.tangents.length();
        let of_share = |n: u32| {
            let share = sigmoid(self.numbers[n as usize]);
            share * (1.0 - share)
        };
        let rising = |n: u32| sigmoid(self.numbers[n as usize]);
        let decades = (at.distance / self.reference_distance).ln();
        [
            d_position.x,
            d_position.y,
            d_position.z,
            d_tangents.x,
            d_tangents.y,
            self.slope * (1.0 - at.beam) / at.light
                * (1.0 - LAMP_LEAST_AMBIENT)
                * of_share(LAMP_AMBIENT),
            -share * decades * LAMP_LARGEST_EXPONENT * of_share(LAMP_EXPONENT),
            -share * at.away * LAMP_FALLOFF_STEP * rising(LAMP_FALLOFFS),
            -share * at.away * at.away * LAMP_FALLOFF_STEP * rising(LAMP_FALLOFFS + 1),
        ]
    }
}
