//! Metering: the gain of a photograph's target from its luminance.
//!
//! ```text
//! soft(x; k) = delta + (1 - delta) S(k x)        delta = 0.075
//! S(t)       = 1 - exp(-u), u = ln(1 + s t) / s; u = t for s = 0
//! gain(H)    k = 0.90 / (mean W^3)^(1/3), W = min(Y, 99.9 % quantile of Y, 2.5 times the 90 % quantile)
//!            within the gains at which the mean of soft(Y; k) is 0.42 and 0.54, s = 0
//!            times exp(-0.6 (saturation - 0.30)) with a saturation of 0.175 to 0.65, at most 128
//! ```
//!
//! H is the histogram of the encoded luminance Y. A cubic mean is between average metering (power 1) and metering for
//! the highlights (infinity): a scene of high contrast gets less exposure, as a photographer would choose. Lamps make
//! it unbounded, so they are clamped, and the mean is limited (18 % grey is 0.46 when encoded). The more saturated a
//! scene, the darker are its references. Power and constants were chosen on pairs of low- and normal-light photographs
//! (LOL, LOM, `RealX3D`).
//!
//! Three kinds of scenes need more than a gain:
//! - A night sky fills a large part of the frame: the mean of the whole would turn it grey and the ground white. Pixels
//!   that would be black ([`BLACK`]) at the gain of the whole are left out of the metering, the rest is at most middle
//!   grey, and a toe keeps black pixels black.
//! - Windows and lamps are many stops brighter than the rest: a longer shoulder (s) keeps all but 2 % of the pixels
//!   below [`NEAR_WHITE`].
//! - A camera's night mode exposes some photographs longer: those are [`Exposure`](super::Exposure)'s to tell apart.

use nightsplat_core::curves::{shoulder, toe};
use serde::{Deserialize, Serialize};

use super::histogram::LuminanceHistogram;

/// The black level of the automatic curve.
pub(super) const BLACK_LEVEL: f64 = 0.075;

/// The cubic mean of the luminance times the gain.
const CUBIC_MEAN: f64 = 0.90;

/// Minimum and maximum of a target's mean luminance.
const MEANS: [f64; 2] = [0.42, 0.54];

/// A surface that reflects 18 %, encoded.
const MIDDLE_GREY: f64 = 0.46;

/// Minimum and maximum of the gain.
pub(super) const GAINS: [f64; 2] = [1e-3, MAX_GAIN];
/// The largest gain.
pub const MAX_GAIN: f64 = 128.0;

/// ln k falls by this per saturation, from that of typical scenes on, within the saturations that pairs have. Noise
/// feigns higher ones.
const PER_SATURATION: f64 = 0.6;
const TYPICAL_SATURATION: f64 = 0.30;
const SATURATIONS: [f64; 2] = [0.175, 0.65];

/// k Y below which a pixel of the whole counts as black.
const BLACK: f64 = 0.2;

/// Up to the first share of such pixels, all take part in the metering; from the second on, none of them. As many as
/// are between [`BLACK`] and twice that are shadows and do not count. Rooms have 0 to 0.2, a night sky its share of the
/// frame.
const BLACK_SHARES: [f64; 2] = [0.25, 0.35];

/// From this share on, the model leaves the sky open. The target of black is then at most half of the black level.
pub const BLACK_SKY: f64 = 0.3;

/// The toe ends at this multiple of the luminance below which pixels count as black.
const TOE: f64 = 2.0;

/// From this value on, detail is lost to the eye.
pub const NEAR_WHITE: f64 = 0.94;

/// The largest share of the targets' pixels that is near white, in addition to that of the photographs.
const MOST_NEAR_WHITE: f64 = 0.02;

/// The largest shoulder: light of 100 / k is near white.
const LONGEST_SHOULDER: f64 = 2.0;

/// The ends of the automatic curve: how it reaches white and leaves black.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CurveEnds {
    /// s: 0 for an exponential shoulder; 1 for Reinhard's, t / (1 + t).
    pub shoulder: f64,
    /// The value of the target below which the toe darkens.
    pub toe: f64,
    /// The weight of the toe, 0 to 1.
    pub toe_weight: f64,
}

impl CurveEnds {
    /// soft(x; k) with this shoulder and toe.
    pub fn soft(&self, x: f64, gain: f64) -> f64 {
        let value = BLACK_LEVEL + (1.0 - BLACK_LEVEL) * shoulder(gain * x, self.shoulder);
        toe(value, BLACK_LEVEL, [self.toe, self.toe_weight])
    }
}

/// delta + (1 - delta) (1 - exp(-k x)): the curve to which the rule applies.
pub fn soft(x: f64, gain: f64) -> f64 {
    CurveEnds::default().soft(x, gain)
}

/// How the gains of a scene's photographs are chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Metering {
    /// The requested mean luminance of the targets, in place of the rule's.
    pub(super) brightness: Option<f64>,
    /// A factor on each gain: from the rule's brightness to that of photographs that are well lit.
    pub(super) ln_factor: f64,
    /// The luminance below which pixels of the whole scene count as black, and the luminance of its highlights.
    black: f64,
    highlights: f64,
    /// The mean share of a photograph that is black and no shadow.
    pub(super) sky: f64,
}

/// The quantile of highlights, which follow the exposure of a photograph, whatever share of it is black.
const HIGHLIGHTS: f64 = 0.98;

impl Metering {
    /// The metering of the photographs of a scene, from each and all together.
    pub(super) fn new(
        views: &[&LuminanceHistogram],
        scene: &LuminanceHistogram,
        brightness: Option<f64>,
    ) -> Self {
        let (black, highlights) = (BLACK / rule(scene, MEANS), scene.quantile(HIGHLIGHTS));
        let whole = Self { brightness, black, highlights, ..Self::default() };
        // A requested brightness is that of all pixels.
        if brightness.is_some() {
            return whole;
        }
        let shares = views.iter().map(|view| {
            let black = whole.black_of(view);
            2.0 * view.fraction_below(black) - view.fraction_below(2.0 * black)
        });
        Self { sky: (shares.sum::<f64>() / views.len().max(1) as f64).max(0.0), ..whole }
    }

    /// The share of black pixels that takes no part in the metering.
    fn left_out(&self) -> f64 {
        let [none, all] = BLACK_SHARES;
        ((self.sky - none) / (all - none)).clamp(0.0, 1.0)
    }

    /// The luminance below which pixels of a photograph count as black: less than that of the scene if it is exposed
    /// for a shorter time.
    fn black_of(&self, view: &LuminanceHistogram) -> f64 {
        let exposure = view.quantile(HIGHLIGHTS) / self.highlights.max(f64::MIN_POSITIVE);
        self.black * exposure.min(1.0)
    }

    /// gain(H), or the gain at which the mean luminance is that requested.
    pub(super) fn gain_of(&self, luminance: &LuminanceHistogram) -> f64 {
        if let Some(mean) = self.brightness {
            return gain_at(luminance, mean);
        }
        let left_out = self.left_out();
        let gain = if left_out > 0.0 {
            let counted = luminance.without_below(self.black_of(luminance), left_out);
            // The ground below a night sky is at most middle grey.
            rule(&counted, [MEANS[0], MEANS[1] - left_out * (MEANS[1] - MIDDLE_GREY)])
        } else {
            rule(luminance, MEANS)
        };
        let saturation = luminance.saturation().clamp(SATURATIONS[0], SATURATIONS[1]);
        let ln_factor = self.ln_factor - PER_SATURATION * (saturation - TYPICAL_SATURATION);
        (gain * ln_factor.exp()).clamp(GAINS[0], GAINS[1])
    }

    /// The ends of the curve of a scene with this gain.
    pub(super) fn ends(&self, scene: &LuminanceHistogram, gain: f64) -> CurveEnds {
        // A requested mean is that of the plain curve.
        if self.brightness.is_some() {
            return CurveEnds::default();
        }
        let toe_weight = self.left_out();
        let toe = if toe_weight > 0.0 { soft(TOE * self.black, gain) } else { 0.0 };
        CurveEnds { shoulder: shoulder_below(scene, gain), toe, toe_weight }
    }
}

/// The gain of the cubic mean, within those of the lowest and highest mean.
fn rule(luminance: &LuminanceHistogram, [low, high]: [f64; 2]) -> f64 {
    let gain = (CUBIC_MEAN / luminance.cubic_mean()).clamp(GAINS[0], GAINS[1]);
    match mean_of_soft(luminance, gain) {
        mean if mean < low => gain_at(luminance, low),
        mean if mean > high => gain_at(luminance, high),
        _ => gain,
    }
}

/// The shortest shoulder at which few pixels are near white.
fn shoulder_below(scene: &LuminanceHistogram, gain: f64) -> f64 {
    let near_white = 1.0 - scene.fraction_below(NEAR_WHITE);
    let bright = scene.quantile((1.0 - near_white - MOST_NEAR_WHITE).max(0.0));
    let is_white =
        |shoulder| CurveEnds { shoulder, ..CurveEnds::default() }.soft(bright, gain) > NEAR_WHITE;
    if is_white(0.0) { solved([1e-3, LONGEST_SHOULDER], is_white) } else { 0.0 }
}

pub(super) fn mean_of_soft(luminance: &LuminanceHistogram, gain: f64) -> f64 {
    luminance.mean_of(|y| soft(y, gain))
}

/// The gain at which the mean of the curve is `mean`.
pub(super) fn gain_at(luminance: &LuminanceHistogram, mean: f64) -> f64 {
    solved(GAINS, |gain| mean_of_soft(luminance, gain) < mean)
}

/// The first strength within bounds that is not too low, by bisection of its logarithm; a bound if there is none.
pub(super) fn solved(bounds: [f64; 2], is_low: impl Fn(f64) -> bool) -> f64 {
    let [mut low, mut high] = bounds.map(f64::ln);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        *(if is_low(middle.exp()) { &mut low } else { &mut high }) = middle;
    }
    (0.5 * (low + high)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shoulder_is_from_exponential_to_reinhard_and_the_toe_continuous() {
        for t in [0.0, 1e-6, 0.1, 1.0, 30.0] {
            assert!((shoulder(t, 1e-6) - (1.0 - f64::exp(-t))).abs() < 1e-5, "{t}");
            // 1 - exp(-ln(1 + t)).
            assert!((shoulder(t, 1.0) - t / (1.0 + t)).abs() < 1e-12, "{t}");
        }
        for weight in [0.0, 0.4, 1.0] {
            let of = |value: f64| toe(value, 0.075, [0.25, weight]);
            assert!((of(0.075) - (1.0 - weight) * 0.075).abs() < 1e-12);
            assert!((of(0.25) - 0.25).abs() < 1e-12 && (of(0.249_999) - 0.25).abs() < 1e-5);
            let values: Vec<f64> = (0..100).map(|i| of(0.075 + 0.002 * f64::from(i))).collect();
            assert!(values.is_sorted_by(|a, b| a < b), "{weight}");
        }
    }

    #[test]
    fn a_set_of_lamps_and_black_has_a_finite_gain() {
        for lamps in [0, 1, 50, 1000] {
            let plane: Vec<f32> = (0..1000).map(|i| f32::from(u8::from(i < lamps))).collect();
            let found = LuminanceHistogram::new(&plane.repeat(3));
            let metering = Metering::new(&[&found], &found, None);
            let gain = metering.gain_of(&found);
            let ends = metering.ends(&found, gain);
            assert!((GAINS[0]..=GAINS[1]).contains(&gain), "{lamps}: {gain}");
            assert!(ends.soft(0.0, gain).is_finite() && ends.soft(1.0, gain) <= 1.0, "{ends:?}");
        }
    }
}
