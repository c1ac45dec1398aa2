//! A lamp that moves with the camera, on the host; `include/lamp.glsl` has its formula.

use glam::DVec3;
use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::kernels::lamp::{
    LAMP_AMBIENT, LAMP_BLACK, LAMP_EXPONENT, LAMP_FALLOFF_STEP, LAMP_FALLOFFS, LAMP_FARTHEST,
    LAMP_LARGEST_EXPONENT, LAMP_LEAST_AMBIENT, LAMP_NEAREST, LAMP_NUMBERS, LAMP_REACH,
    LAMP_REFERENCE_DISTANCE, LAMP_SLOPE, LAMP_STEP,
};
use crate::kernels::lamp::{LAMP_KNEE, LAMP_LEFT};
use crate::{Error, Result};

/// The largest magnitude of the number of a share that is 0 or 1, which no number is exactly.
const FARTHEST_NUMBER: f64 = 12.0;

/// A lamp that moves with the camera, in view space: x points right, y down, z forward.
///
/// The light at a point at r from it, with d = |r| and u = 1 - cos of the angle between r and its axis, is
///
/// ```text
/// ambient + (1 - ambient) (reference_distance / d)^exponent exp(-falloffs[0] u - falloffs[1] u^2)
/// ```
///
/// and the colour of a Gaussian is black + tone(light^slope tone^-1(colour - black)), with the saturating tone curve
/// tone(x) = reach (1 - exp(-x / reach)), a line below 0 and near its reach; x for a reach of 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lamp {
    /// World units.
    pub position: [f64; 3],
    /// The axis is the direction of (x, y, 1).
    pub axis: [f64; 2],
    /// 0 to 1.
    pub ambient: f64,
    /// 0 to 4; 2 is a point without absorption.
    pub exponent: f64,
    /// Not negative.
    pub falloffs: [f64; 2],
    /// The distance at which the light on the axis is 1, that of evenly lit colours; world units.
    pub reference_distance: f64,
    /// The slope of the tone curve near black: d ln(target - black) / d ln linear light.
    pub slope: f64,
    /// The target of no light.
    #[serde(default)]
    pub black: f64,
    /// The target above black to which the tone curve saturates; 0: it does not.
    #[serde(default)]
    pub reach: f64,
}

impl Lamp {
    /// A lamp at the camera that shines ahead in all directions alike.
    pub const AT_CAMERA: Self = Self {
        position: [0.0; 3],
        axis: [0.0; 2],
        ambient: 0.05,
        exponent: 2.0,
        falloffs: [0.0; 2],
        reference_distance: 1.0,
        slope: 1.0 / 2.2,
        black: 0.0,
        reach: 0.0,
    };

    /// The numbers of the device with which the light is 1 everywhere.
    pub(crate) fn even_numbers(&self) -> [f32; LAMP_NUMBERS as usize] {
        /// Sigmoid and softplus of this are 0 next to 1.
        const NONE: f32 = -80.0;
        let mut numbers = self.numbers();
        numbers[LAMP_EXPONENT as usize..LAMP_REFERENCE_DISTANCE as usize].fill(NONE);
        numbers
    }

    /// A point in view space, seen from the lamp.
    pub(crate) fn at(&self, point: DVec3) -> LampPoint {
        let offset = point - DVec3::from(self.position);
        let length = offset.length() / self.reference_distance;
        let distance = length.clamp(LAMP_NEAREST, LAMP_FARTHEST);
        let towards = offset / (distance * self.reference_distance);
        let axis = self.tangents().normalize();
        let away = 1.0 - towards.dot(axis).clamp(-1.0, 1.0);
        let [first, second] = self.falloffs;
        let beam = distance.powf(-self.exponent) * (-(first + second * away) * away).exp();
        let light = self.ambient + (1.0 - self.ambient) * beam;
        LampPoint { axis, towards, length, distance, away, beam, light }
    }

    /// (x, y, 1) along the axis.
    pub(crate) fn tangents(&self) -> DVec3 {
        let [x, y] = self.axis;
        DVec3::new(x, y, 1.0)
    }

    /// The light at a point in view space.
    pub fn light(&self, point: DVec3) -> f64 {
        self.at(point).light
    }

    /// light^slope at a point in view space: the factor on the argument of the tone curve.
    pub fn factor(&self, point: DVec3) -> f64 {
        self.light(point).powf(self.slope)
    }

    /// The colour of a Gaussian without the light at a point in view space.
    pub(crate) fn unlit(&self, color: Vec3, point: DVec3) -> Vec3 {
        let factor = self.factor(point);
        let unlit =
            color.to_array().map(|value| self.tone(self.tone_inverse(value.into()) / factor));
        Vec3::from_array(unlit.map(|value| value as f32))
    }

    /// The colour of the tone curve's argument `x`, which is in proportion to light^slope.
    pub(crate) fn tone(&self, x: f64) -> f64 {
        let bent = x / self.reach;
        if self.reach == 0.0 || bent < 0.0 {
            return self.black + x;
        }
        let line = 1.0 - LAMP_LEFT + LAMP_LEFT * (bent - LAMP_KNEE);
        self.black + self.reach * if bent < LAMP_KNEE { -(-bent).exp_m1() } else { line }
    }

    /// The argument of the tone curve for a colour: the inverse of [`Lamp::tone`].
    pub(crate) fn tone_inverse(&self, value: f64) -> f64 {
        let above = value - self.black;
        let share = above / self.reach;
        if self.reach == 0.0 || share < 0.0 {
            return above;
        }
        let line = LAMP_KNEE + (share - (1.0 - LAMP_LEFT)) / LAMP_LEFT;
        self.reach * if share < 1.0 - LAMP_LEFT { -(-share).ln_1p() } else { line }
    }

    /// The same lamp with this light as the unit, and the distance where it is on the axis as the reference distance;
    /// unchanged if that is farther off than a factor of four, or nowhere.
    #[must_use]
    pub(crate) fn in_units_of(&self, light: f64) -> Self {
        let ambient = self.ambient / light;
        let farther = ((1.0 - self.ambient) / (light - self.ambient)).powf(1.0 / self.exponent);
        if ambient < 1.0 && (0.25..=4.0).contains(&farther) {
            return Self {
                ambient,
                reference_distance: farther * self.reference_distance,
                ..*self
            };
        }
        *self
    }

    /// The same lamp where a world unit is `scale` units.
    #[must_use]
    pub fn scaled(&self, scale: f64) -> Self {
        Self {
            position: self.position.map(|x| scale * x),
            reference_distance: scale * self.reference_distance,
            ..*self
        }
    }

    /// Refuses numbers out of range.
    #[doc(hidden)]
    pub fn check(&self) -> Result<()> {
        let Self { position, axis, ambient, exponent, falloffs, .. } = *self;
        let Self { reference_distance, slope, black, reach, .. } = *self;
        let is_finite = position.iter().chain(&axis).all(|x| x.abs() < 1e9);
        for (name, is_valid, rule) in [
            ("position or axis", is_finite, "finite"),
            ("ambient", (0.0..1.0).contains(&ambient), "at least 0 and below 1"),
            ("exponent", (0.0..=LAMP_LARGEST_EXPONENT).contains(&exponent), "0 to 4"),
            ("falloffs", falloffs.iter().all(|x| (0.0..1e6).contains(x)), "at least 0 and finite"),
            (
                "reference_distance",
                reference_distance.is_normal() && (1e-30..1e30).contains(&reference_distance),
                "above 0 and finite",
            ),
            ("slope", slope > 0.0 && slope <= 8.0, "above 0 and at most 8"),
            ("black", (-1.0..=1.0).contains(&black), "-1 to 1"),
            ("reach", reach == 0.0 || (1e-3..=1e3).contains(&reach), "0, or 0.001 to 1000"),
        ] {
            if !is_valid {
                return Err(Error::Usage(format!("the lamp's {name} must be {rule}: {self:?}")));
            }
        }
        Ok(())
    }

    /// The numbers of the device; ambient, exponent and falloffs at a bound are next to it.
    #[doc(hidden)]
    pub fn numbers(&self) -> [f32; LAMP_NUMBERS as usize] {
        let mut numbers = [0.0; LAMP_NUMBERS as usize];
        let position = self.position.map(|x| x / (LAMP_STEP * self.reference_distance));
        numbers[..3].copy_from_slice(&position);
        numbers[3..5].copy_from_slice(&self.axis.map(|x| x / LAMP_STEP));
        let ambient = (self.ambient - LAMP_LEAST_AMBIENT) / (1.0 - LAMP_LEAST_AMBIENT);
        numbers[LAMP_AMBIENT as usize] = logit(ambient);
        numbers[LAMP_EXPONENT as usize] = logit(self.exponent / LAMP_LARGEST_EXPONENT);
        for (number, falloff) in numbers[LAMP_FALLOFFS as usize..].iter_mut().zip(self.falloffs) {
            // The inverse of ln(1 + e^x).
            let falloff = falloff / LAMP_FALLOFF_STEP;
            *number = (falloff + (-(-falloff).exp()).ln_1p()).max(-FARTHEST_NUMBER);
        }
        numbers[LAMP_REFERENCE_DISTANCE as usize] = self.reference_distance;
        numbers[LAMP_SLOPE as usize] = self.slope;
        numbers[LAMP_BLACK as usize] = self.black;
        numbers[LAMP_REACH as usize] = self.reach;
        numbers.map(|number| number as f32)
    }

    /// The lamp of the device's numbers.
    pub(crate) fn of_numbers<T: Copy + Into<f64>>(numbers: &[T]) -> Self {
        let at = |n: u32| -> f64 { numbers[n as usize].into() };
        let reference_distance = at(LAMP_REFERENCE_DISTANCE);
        let share = sigmoid(at(LAMP_AMBIENT));
        let softplus = |x: f64| x.max(0.0) + (-x.abs()).exp().ln_1p();
        Self {
            position: [0, 1, 2].map(|n| LAMP_STEP * reference_distance * at(n)),
            axis: [3, 4].map(|n| LAMP_STEP * at(n)),
            ambient: LAMP_LEAST_AMBIENT + (1.0 - LAMP_LEAST_AMBIENT) * share,
            exponent: LAMP_LARGEST_EXPONENT * sigmoid(at(LAMP_EXPONENT)),
            falloffs: [LAMP_FALLOFFS, LAMP_FALLOFFS + 1]
                .map(|n| LAMP_FALLOFF_STEP * softplus(at(n))),
            reference_distance,
            slope: at(LAMP_SLOPE),
            black: at(LAMP_BLACK),
            reach: at(LAMP_REACH),
        }
    }
}

/// What the light at a point, and its gradient, have in common.
pub(crate) struct LampPoint {
    /// The direction of the lamp.
    pub(crate) axis: DVec3,
    /// From the lamp to the point; of length 1 but beyond the bounds of the distance.
    pub(crate) towards: DVec3,
    /// The distance in reference distances.
    pub(crate) length: f64,
    /// The same within its bounds.
    pub(crate) distance: f64,
    /// 1 - cos of the angle between both directions.
    pub(crate) away: f64,
    /// The lamp's own light, without the ambient one.
    pub(crate) beam: f64,
    pub(crate) light: f64,
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// The inverse of the sigmoid, bounded.
fn logit(share: f64) -> f64 {
    (share / (1.0 - share)).max(0.0).ln().clamp(-FARTHEST_NUMBER, FARTHEST_NUMBER)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lamp() -> Lamp {
        Lamp {
            position: [0.1, -0.2, 0.05],
            axis: [0.1, 0.2],
            ambient: 0.1,
            exponent: 1.7,
            falloffs: [3.0, 0.5],
            reference_distance: 1.5,
            ..Lamp::AT_CAMERA
        }
    }

    #[test]
    fn the_light_is_1_on_the_axis_at_the_reference_distance() {
        let lamp = lamp();
        let axis = DVec3::new(0.1, 0.2, 1.0).normalize();
        let at = |distance: f64| lamp.light(DVec3::from(lamp.position) + distance * axis);
        assert!((at(1.5) - 1.0).abs() < 1e-12);
        assert!((at(3.0) - (0.1 + 0.9 * 0.5_f64.powf(1.7))).abs() < 1e-12);
    }

    #[test]
    fn the_light_is_finite_and_positive_at_the_lamp_and_far_away() {
        let lamp =
            Lamp { ambient: LAMP_LEAST_AMBIENT, exponent: 4.0, falloffs: [50.0; 2], ..lamp() };
        let position = DVec3::from(lamp.position);
        for point in [position, position - 1e-30, DVec3::NEG_Z, DVec3::splat(1e25), DVec3::Z * 1e30]
        {
            let light = lamp.light(point);
            assert!(light >= LAMP_LEAST_AMBIENT && light <= 16_f64.powi(4), "{point}: {light}");
        }
    }

    #[test]
    fn the_numbers_of_the_device_are_those_of_the_lamp() {
        let lamp = lamp();
        let back = Lamp::of_numbers(&lamp.numbers());
        for point in [DVec3::Z, DVec3::new(0.5, -0.3, 2.0), DVec3::new(-1.0, 0.3, 0.4)] {
            assert!((back.light(point) / lamp.light(point) - 1.0).abs() < 1e-5);
        }
        let bounds = Lamp { ambient: 0.0, exponent: 0.0, falloffs: [0.0; 2], ..lamp };
        let back = Lamp::of_numbers(&bounds.numbers());
        back.check().unwrap();
        assert!(back.exponent < 1e-4 && back.ambient < 2e-4 && back.falloffs[0] < 1e-4);
    }

    #[test]
    fn another_unit_of_light_changes_no_ratio() {
        let other = lamp().in_units_of(0.6);
        for point in [DVec3::Z, DVec3::new(0.5, -0.3, 2.0), DVec3::new(-1.0, 0.3, 0.4)] {
            assert!((0.6 * other.light(point) / lamp().light(point) - 1.0).abs() < 1e-12);
        }
        for light in [0.05, 1e-9] {
            assert_eq!(lamp().in_units_of(light), lamp(), "the ambient light is 0.1");
        }
    }

    #[test]
    fn the_tone_curve_has_an_inverse_on_both_sides_of_black_and_of_its_knee() {
        for reach in [0.0, 0.5, 0.9] {
            let lamp = Lamp { black: 0.07, reach, ..lamp() };
            for value in [-0.3, 0.07, 0.08, 0.4, 0.53, 0.95, 1.5] {
                let back = lamp.tone(lamp.tone_inverse(value));
                assert!((back - value).abs() < 1e-6, "reach {reach}: {value} became {back}");
            }
        }
        let power = Lamp { reach: 0.0, ..lamp() };
        let nearly = Lamp { reach: 1e3, ..lamp() };
        assert!((power.tone(0.5) - nearly.tone(0.5)).abs() < 2e-4);
    }

    #[test]
    fn a_number_out_of_range_is_refused_by_its_name() {
        for (wrong, name) in [
            (Lamp { exponent: 5.0, ..lamp() }, "exponent"),
            (Lamp { ambient: 1.0, ..lamp() }, "ambient"),
            (Lamp { falloffs: [-1.0, 0.0], ..lamp() }, "falloffs"),
            (Lamp { reference_distance: 0.0, ..lamp() }, "reference_distance"),
            (Lamp { position: [f64::NAN; 3], ..lamp() }, "position"),
            (Lamp { reach: -1.0, ..lamp() }, "reach"),
            (Lamp { slope: f64::INFINITY, ..lamp() }, "slope"),
        ] {
            let refused = wrong.check().unwrap_err().to_string();
            assert!(refused.contains(name), "{refused}");
        }
    }
}
