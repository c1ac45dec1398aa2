//! The inverse of a tone curve: from the values of a target back to those of the photograph.
//!
//! Most curves map each value separately, and increase: the inverse of a value is found by bisection. The automatic
//! curve scales a part of each channel by the curve of the luminance Y, s(Y) / Y. For a given Y it increases in each
//! channel, and a larger Y gives larger values; so the Y that its own values have is found by iteration from below. A
//! target below that of black is inverted in the mirror, as the curve is continued below 0.
//! Where a curve is flat, no inverse is accurate: values within half a code of 8 bits of its maximum become those of
//! that limit, and are counted.

use std::borrow::Cow;

use nightsplat_core::curves::{
    CURVE_AUTO, CURVE_LUM_PRESERVE, CURVE_PER_CHANNEL, CURVE_TABLE, Constants, clamped, curve_at,
    mirrored, shoulder, toe,
};
use nightsplat_core::{Error, Result};

use super::{SceneLaw, Table, Tone, ToneParameters, ToneSettings};
use crate::image::{linear_from_srgb, srgb_from_linear};

/// The values of a target whose inverse the curve does not determine: half a code of 8 bits below its maximum.
const FLAT: f64 = 0.5 / 255.0;
/// The largest encoded value of a photograph: that of an EXR in half floats.
const LARGEST: f64 = 65_504.0;
/// The light at which a long shoulder of the automatic curve is too flat for an inverse.
const BRIGHTEST: f64 = 64.0;
/// Relative precision of a solution.
const PRECISION: f64 = 1e-7;
const TRIALS: usize = 60;

/// The inverse of the curve of a photograph.
#[derive(Clone, Debug)]
pub struct InverseTone {
    /// A `CURVE_*` number.
    curve: u32,
    white: f64,
    offset: f64,
    gain: f64,
    weight: f64,
    constants: Constants<f64>,
    table: Option<Table>,
    /// The largest value of a target of each channel that is inverted.
    largest: [f64; 3],
}

impl InverseTone {
    /// The inverse of this curve with the parameters of a photograph.
    pub fn new(settings: &ToneSettings, parameters: &ToneParameters) -> Result<Self> {
        let problem = match settings.curve {
            Tone::Profile(_) => {
                Some("a camera profile mixes and bends channels, and has no inverse")
            }
            Tone::External(_) => Some("targets of another program have no curve, and no inverse"),
            _ => None,
        };
        if let Some(problem) = problem {
            return Err(Error::Usage(format!("{problem}; train with a curve for linear light")));
        }
        let table = settings.table().map(Cow::into_owned);
        Ok(Self::of_curve(settings.curve.constant(), table, parameters))
    }

    /// The inverse of the law of a scene.
    pub fn of_law(law: &SceneLaw) -> Self {
        Self::of_curve(law.curve, None, &law.parameters)
    }

    /// The inverse of any curve but a camera profile, by its `CURVE_*` number.
    pub fn of_curve(curve: u32, table: Option<Table>, parameters: &ToneParameters) -> Self {
        let ToneParameters { white, offset, gain, weight, constants } = *parameters;
        let [white, offset, gain, weight] = [white, offset, gain, weight].map(f64::from);
        let (constants, largest) = (constants.map(f64::from), [1.0; 3]);
        let mut inverse = Self { curve, white, offset, gain, weight, constants, table, largest };
        // The automatic curve gets as high in every channel, through its own curve or that of the luminance.
        let most = if curve == CURVE_AUTO { BRIGHTEST } else { LARGEST };
        let factor = inverse.factor([most; 3]);
        let highest = |channel| inverse.channel(most, channel, factor).min(1.0);
        inverse.largest = [0, 1, 2].map(|channel| highest(channel) - FLAT);
        inverse
    }

    /// The target of one channel. `factor`: s(Y) / Y of the pixel's luminance, if the curve uses it.
    fn channel(&self, x: f64, channel: usize, factor: f64) -> f64 {
        mirrored(x, |x| self.channel_above_black(x, channel, factor))
    }

    fn channel_above_black(&self, x: f64, channel: usize, factor: f64) -> f64 {
        let &Self { curve, white, offset, gain, ref constants, .. } = self;
        let t = x / white;
        let curved = match curve {
            CURVE_AUTO => {
                let [share, bend, end, weight, ..] = *constants;
                let soft = (1.0 - share) * shoulder(t, bend) + share * t * factor;
                toe(offset + (1.0 - offset) * soft, offset, [end, weight])
            }
            CURVE_TABLE => self.table.as_ref().map_or(t, |table| table.value(t, channel)),
            // A pixel's gain is that of its luminance, up to 1e-6 of it.
            CURVE_LUM_PRESERVE => gain * x,
            CURVE_PER_CHANNEL => x / constants[channel],
            _ => clamped(curve_at(curve, t, [offset, gain], constants)),
        };
        if self.weight < 1.0 { x.min(1.0) + self.weight * (curved - x.min(1.0)) } else { curved }
    }

    /// The factor s(Y) / Y of the automatic curve.
    fn factor(&self, rgb: [f64; 3]) -> f64 {
        let y = (luminance(rgb).abs() / self.white).max(1e-20);
        shoulder(y, self.constants[1]) / y
    }

    /// The target of no light.
    fn black(&self, channel: usize) -> f64 {
        self.channel(0.0, channel, 0.0)
    }

    /// The value of a photograph whose target is `value`.
    fn solved(&self, value: f64, channel: usize, factor: f64) -> f64 {
        let black = self.black(channel);
        if value < black {
            // At least black, also of a curve that hardly rises.
            let mirror = (2.0 * black - value).min(self.largest[channel]).max(black);
            return -self.solved(mirror, channel, factor);
        }
        // Written so that a NaN is black.
        let is_lit = value > black;
        if !is_lit {
            return 0.0;
        }
        let (mut low, mut high) = (0.0, self.white.min(1.0));
        while high < LARGEST && self.channel(high, channel, factor) < value {
            (low, high) = (high, 2.0 * high);
        }
        for _ in 0..TRIALS {
            let middle = 0.5 * (low + high);
            if self.channel(middle, channel, factor) < value {
                low = middle;
            } else {
                high = middle;
            }
            if high - low <= PRECISION * high {
                break;
            }
        }
        0.5 * (low + high)
    }

    /// A target without light below black: what is shown is cut there. A NaN is black.
    pub fn shown(&self, target: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|channel| target[channel].max(self.black(channel)))
    }

    /// A target with at most the largest values that are inverted. Written so that a NaN stays one, and becomes black.
    pub fn bounded(&self, target: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|channel| {
            let (value, largest) = (target[channel], self.largest[channel]);
            if value > largest { largest } else { value }
        })
    }

    /// Whether the curve is flat at a target: a channel of its inverse is that of the largest value that is inverted.
    pub fn is_clipped(&self, target: [f64; 3]) -> bool {
        (0..3).any(|channel| target[channel] > self.largest[channel])
    }

    /// The colour of a photograph whose target is this one, sRGB-encoded: above 1 where the curve allows, and negative
    /// below black.
    pub fn invert(&self, target: [f64; 3]) -> [f64; 3] {
        let bounded = self.bounded(target);
        let solved =
            |factor: f64| [0, 1, 2].map(|channel| self.solved(bounded[channel], channel, factor));
        // The factor is 1 for black, where the result is the darkest.
        let darkest = solved(1.0);
        if self.curve != CURVE_AUTO || self.constants[0] == 0.0 {
            return darkest;
        }
        // Secants of Y - luminance(rgb(Y)), which is negative below the solution.
        let step = |y: f64| luminance(solved(self.factor([y; 3])));
        let mut y = luminance(darkest);
        let mut before: Option<[f64; 2]> = None;
        let [mut low, mut high] = [f64::NEG_INFINITY, f64::INFINITY];
        for _ in 0..TRIALS {
            let error = step(y) - y;
            if error.abs() <= PRECISION * y.abs() {
                break;
            }
            *(if error > 0.0 { &mut low } else { &mut high }) = y;
            let next = match before {
                Some([other, other_error]) if (other_error - error).abs() > f64::MIN_POSITIVE => {
                    y + error * (y - other) / (other_error - error)
                }
                _ => y + error,
            };
            before = Some([y, error]);
            // Where the curve is flat, the difference of two errors is that of their rounding.
            let is_between = next > low && next < high;
            y = if next * y > 0.0 && is_between { next } else { y + error };
        }
        solved(self.factor([y; 3]))
    }

    /// By how many stops linear light has to be raised for the brightness of the target: for a grey that reflects 18 %.
    pub fn stops_to_target(&self) -> f64 {
        const GREY: f32 = 0.18;
        let grey = self.invert([srgb_from_linear(GREY).into(); 3])[1] as f32;
        f64::from(GREY / linear_from_srgb(grey)).log2()
    }

    /// The target of a colour of a photograph, unclamped above.
    pub fn target(&self, rgb: [f64; 3]) -> [f64; 3] {
        let factor = self.factor(rgb);
        [0, 1, 2].map(|channel| self.channel(rgb[channel], channel, factor))
    }
}

/// The law of a scene with these parameters.
///
/// # Errors
/// [`Error::Usage`] for a curve that a model cannot state.
pub fn scene_law(settings: &ToneSettings, parameters: &ToneParameters) -> Result<SceneLaw> {
    let stops = InverseTone::new(settings, parameters)?.stops_to_target() as f32;
    if settings.curve.constant() == CURVE_TABLE {
        let problem =
            "a table of values is too long for a model to state; train with a named curve";
        return Err(Error::Usage(problem.to_owned()));
    }
    Ok(SceneLaw { curve: settings.curve.constant(), parameters: *parameters, stops })
}

/// The BT.601 luminance, as the kernels weigh it.
fn luminance([r, g, b]: [f64; 3]) -> f64 {
    0.299 * r + 0.587 * g + 0.114 * b
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_tone::SceneTone;
    use crate::tone::{MeasuredPhotograph, Profile, ToneCurve};

    /// Dark colours, and some near and above white.
    fn colours() -> Vec<[f64; 3]> {
        let value = |i: usize| 1.2 * (i as f64 / 40.0).powi(4) + 1e-4;
        let lit = |i: usize| [value(i), value((7 * i + 3) % 40), value((11 * i + 5) % 40)];
        let below = |i: usize| [-1e-3 * i as f64, -2e-3, 4e-4 * i as f64];
        (0..40).map(lit).chain((1..9).map(below)).collect()
    }

    fn inverse(settings: &ToneSettings) -> InverseTone {
        let dark: Vec<f32> = (0..3000).map(|i| 0.2 * (i as f32 / 3000.0).powi(2)).collect();
        let photograph = MeasuredPhotograph::measure(&dark);
        SceneTone::from_photographs(settings, &[photograph]).unwrap().inverse_of_scene().unwrap()
    }

    /// In stops of linear light: an eighth of a code value of the target, and what a flat curve makes of it.
    #[test]
    fn the_round_trip_through_a_curve_restores_linear_light_to_a_thousandth_of_a_stop() {
        let linear = |x: f64| f64::from(linear_from_srgb(x as f32));
        let formulas = [ToneCurve::Ase, ToneCurve::Linear, ToneCurve::None].map(Tone::Formula);
        for curve in formulas.into_iter().chain([Tone::Auto]) {
            let inverse = inverse(&ToneSettings::new(curve.clone()));
            let mut restored = 0;
            for rgb in colours() {
                let target = inverse.target(rgb);
                if inverse.is_clipped(target) {
                    continue;
                }
                restored += 1;
                for (value, back) in rgb.into_iter().zip(inverse.invert(target)) {
                    let stops = (linear(back) / linear(value)).log2().abs();
                    assert!(stops < 1e-3, "{curve}: {value} becomes {back}, {stops} stops");
                }
            }
            assert!(restored > 3, "{curve}: {restored}");
        }
    }

    #[test]
    fn a_shoulder_and_a_toe_are_inverted() {
        let constants = [1.0 / 3.0, 1.2, 0.25, 0.8, 0.0, 0.0, 0.0, 0.0];
        let parameters =
            ToneParameters { white: 0.05, offset: 0.075, gain: 1.0, weight: 1.0, constants };
        let inverse = InverseTone::of_curve(CURVE_AUTO, None, &parameters);
        for rgb in colours() {
            let target = inverse.target(rgb);
            if inverse.is_clipped(target) {
                continue;
            }
            for (value, back) in rgb.into_iter().zip(inverse.invert(target)) {
                let bound = 1e-3 * value + 1.0 / 65_535.0;
                assert!((back - value).abs() < bound, "{rgb:?}: {value} becomes {back}");
            }
        }
    }

    #[test]
    fn values_in_the_flat_part_are_counted_and_stay_finite() {
        let inverse = inverse(&ToneSettings::new(Tone::Auto));
        for flat in [[1.0; 3], [2.0, 0.3, 0.3], [0.9999, 0.1, 0.1]] {
            let rgb = inverse.invert(flat);
            assert!(inverse.is_clipped(flat) && rgb.iter().all(|x| x.is_finite()), "{rgb:?}");
        }
        let target = [f64::NAN, -1.0, 0.0];
        let dark = inverse.invert(target);
        assert!(dark[0] == 0.0 && dark[1] < dark[2] && !inverse.is_clipped(target), "{dark:?}");
    }

    #[test]
    fn a_camera_profile_has_no_inverse() {
        let bent: Vec<f64> = (0..=16).map(|i| f64::from(i) / 16.0).collect();
        let profile = Profile {
            reference: "a scene".to_owned(),
            pairs: 1,
            matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            gain: [1.0; 3],
            bias: [0.0; 3],
            segments: [bent.clone(), bent.clone(), bent],
        };
        let settings = ToneSettings::new(Tone::Profile(profile));
        let parameters = ToneParameters::default();
        let refused = InverseTone::new(&settings, &parameters).unwrap_err().to_string();
        assert!(refused.contains("has no inverse"), "{refused}");
    }

    #[test]
    fn a_table_is_too_long_to_state() {
        let table = Table { x: vec![0.0, 1.0], y: vec![vec![0.0, 1.0]], ..Default::default() };
        let settings = ToneSettings::new(Tone::Table(table));
        let parameters =
            ToneParameters { white: 1.0, gain: 1.0, weight: 1.0, ..Default::default() };
        let refused = scene_law(&settings, &parameters).unwrap_err().to_string();
        assert!(
            refused.contains("a table of values") && refused.contains("named curve"),
            "{refused}"
        );
    }
}
