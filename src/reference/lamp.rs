//! The gradients of the lamp of `include/lamp_falloff.glsl`, in f64, from the numbers of the device.

use glam::DVec3;

use super::gaussian::sigmoid;
use super::rounding::UNIT;
use crate::kernels::lamp::{
    LAMP_AMBIENT, LAMP_EXPONENT, LAMP_FALLOFF_STEP, LAMP_FALLOFFS, LAMP_FARTHEST, LAMP_KNEE,
    LAMP_LARGEST_EXPONENT, LAMP_LEAST_AMBIENT, LAMP_LEFT, LAMP_NEAREST, LAMP_NUMBERS, LAMP_STEP,
    LAMP_WIDTH,
};
use crate::splats::lamp::{Lamp, LampPoint};

/// The learned numbers of the device.
pub const WIDTH: usize = LAMP_WIDTH as usize;

/// A lamp, from the numbers of the device.
#[derive(Clone, Copy, Debug)]
pub struct ReferenceLamp {
    lamp: Lamp,
    numbers: [f64; LAMP_NUMBERS as usize],
}

impl ReferenceLamp {
    /// The lamp of these numbers, (`LAMP_NUMBERS`).
    pub fn from_numbers<T: Copy + Into<f64>>(numbers: &[T]) -> Self {
        let numbers: [f64; LAMP_NUMBERS as usize] = std::array::from_fn(|n| numbers[n].into());
        Self { lamp: Lamp::of_numbers(&numbers), numbers }
    }

    /// The colour at a point in view space, before it is clamped.
    pub fn lit(&self, color: DVec3, point: DVec3) -> DVec3 {
        let factor = self.lamp.factor(point);
        color.map(|value| self.lamp.tone(factor * self.lamp.tone_inverse(value)))
    }

    fn tone_slope(&self, x: f64) -> f64 {
        let reach = self.lamp.reach;
        if reach == 0.0 || x < 0.0 { 1.0 } else { (-(x / reach).min(LAMP_KNEE)).exp() }
    }

    /// From the gradient of a lit colour to those of the colour without the lamp and of the point.
    pub fn lit_backward(&self, lit: DVec3, d_lit: DVec3, point: DVec3) -> (DVec3, DVec3) {
        let factor = self.lamp.factor(point);
        let x = lit.map(|value| self.lamp.tone_inverse(value));
        let d_x = d_lit * x.map(|x| self.tone_slope(x));
        let d_color = factor * d_x / (x / factor).map(|x| self.tone_slope(x));
        (d_color, d_x.dot(x) * self.point_gradient(point))
    }

    /// A bound of the relative change of a lit colour, and of its gradient, over that of the colour.
    fn steepness(&self) -> f64 {
        if self.lamp.reach == 0.0 { 1.0 } else { 1.0 / LAMP_LEFT }
    }

    /// The rounding error of a lit colour, given that of the colour, in units of one rounding.
    pub(super) fn lit_error(&self, error: f64, point: DVec3) -> f64 {
        let relative = 1.0 + self.factor_error(point) / UNIT;
        self.steepness() * self.lamp.factor(point) * relative * error
    }

    /// The rounding errors of the gradient of the point, and of that of the colour, relative.
    pub(super) fn lit_backward_error(&self, lit: DVec3, d_lit: DVec3, point: DVec3) -> [f64; 2] {
        let x = lit.map(|value| self.lamp.tone_inverse(value));
        let d_log_factor = d_lit.abs().dot(x * x.map(|x| self.tone_slope(x)));
        let rounded = self.steepness() * d_lit.abs().dot(DVec3::ONE + lit.abs());
        let error = (d_log_factor.abs() + rounded) * self.point_gradient_error(point);
        [error, self.steepness() * self.factor_error(point)]
    }

    /// The relative rounding error of the factor: exponentials and logarithms have errors of a few units in the last
    /// place, and of their arguments, which are sums of these magnitudes.
    pub(super) fn factor_error(&self, point: DVec3) -> f64 {
        let at = self.lamp.at(point);
        let Lamp { exponent, falloffs: [first, second], slope, .. } = self.lamp;
        let magnitude = exponent * (1.0 + at.distance.ln().abs()) + 4.0 * first + 8.0 * second;
        64.0 * UNIT * (1.0 + slope * (1.0 + magnitude + at.light.ln().abs()))
    }

    fn share(&self, at: &LampPoint) -> f64 {
        (1.0 - self.lamp.ambient) * at.beam / at.light
    }

    fn turn(&self, at: &LampPoint) -> f64 {
        let [first, second] = self.lamp.falloffs;
        first + 2.0 * second * at.away
    }

    /// The gradient of ln factor with respect to the point.
    fn point_gradient(&self, point: DVec3) -> DVec3 {
        let at = self.lamp.at(point);
        let Lamp { exponent, reference_distance, slope, .. } = self.lamp;
        if at.length > LAMP_FARTHEST {
            return DVec3::ZERO;
        }
        let turn = self.turn(&at);
        let mut gradient = turn * at.axis;
        if at.length >= LAMP_NEAREST {
            gradient -= (exponent + turn * at.towards.dot(at.axis)) * at.towards;
        }
        slope * self.share(&at) / (at.distance * reference_distance) * gradient
    }

    /// The rounding error of [`ReferenceLamp::point_gradient`], whose terms can cancel.
    fn point_gradient_error(&self, point: DVec3) -> f64 {
        let at = self.lamp.at(point);
        let Lamp { exponent, falloffs: [first, second], reference_distance, slope, .. } = self.lamp;
        let terms = exponent + 2.0 * first + 8.0 * second;
        (256.0 * UNIT + self.factor_error(point)) * slope * self.share(&at) * terms
            / (at.distance * reference_distance)
    }

    /// The gradient of the learned numbers, from that of the colour without the lamp.
    pub fn gradient(&self, lit: DVec3, d_color: DVec3, point: DVec3) -> [f64; WIDTH] {
        let x = lit.map(|value| self.lamp.tone_inverse(value)) / self.lamp.factor(point);
        let d_log_factor = d_color.dot(x * x.map(|x| self.tone_slope(x)));
        let (lamp, at) = (&self.lamp, self.lamp.at(point));
        let share = lamp.slope * self.share(&at);
        let d_position = -LAMP_STEP * lamp.reference_distance * self.point_gradient(point);
        let is_far = at.length > LAMP_FARTHEST;
        let d_axis = if is_far { DVec3::ZERO } else { share * self.turn(&at) * at.towards };
        let d_tangents =
            LAMP_STEP * (d_axis - at.axis * at.axis.dot(d_axis)) / lamp.tangents().length();
        let of_share = |n: u32| {
            let share = sigmoid(self.numbers[n as usize]);
            share * (1.0 - share)
        };
        let rising = |n: u32| sigmoid(self.numbers[n as usize]);
        [
            d_position.x,
            d_position.y,
            d_position.z,
            d_tangents.x,
            d_tangents.y,
            lamp.slope * (1.0 - at.beam) / at.light
                * (1.0 - LAMP_LEAST_AMBIENT)
                * of_share(LAMP_AMBIENT),
            -share * at.distance.ln() * LAMP_LARGEST_EXPONENT * of_share(LAMP_EXPONENT),
            -share * at.away * LAMP_FALLOFF_STEP * rising(LAMP_FALLOFFS),
            -share * at.away * at.away * LAMP_FALLOFF_STEP * rising(LAMP_FALLOFFS + 1),
        ]
        .map(|number| d_log_factor * number)
    }
}
