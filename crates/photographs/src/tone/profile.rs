//! Camera profiles: the colours of a camera, learned from one scene with references.

use nightsplat_core::curves::Real;
use serde::{Deserialize, Serialize};

/// Segments of a channel's curve of luminance; the kernel has the same number.
pub const SEGMENTS: u32 = 16;
/// Numbers of a channel of a profile for the kernel.
pub const PROFILE_WIDTH: u32 = 5 + SEGMENTS;

/// Limit of the weights, gains and biases of a profile.
const LARGEST: f64 = 1e3;

/// How much the sum of a channel's weights may differ from 1, due to rounding.
const ROUNDING: f64 = 1e-3;

/// A camera profile, fitted to pairs of dark and normal-light photographs, then fixed:
///
/// ```text
/// v_c = 1 - exp(-k x_c)                          k: the gain from the luminance of the photographs
/// u_c = gain_c (M v)_c + bias_c                  the rows of M sum to 1, so that grey stays grey
/// y_c = segments_c at u_c                        17 non-decreasing values, linearly interpolated, u from 0 to 1
/// ```
///
/// Its targets depend on reference images: their scores are not comparable with scores without references.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// The scene with references that it was fitted to.
    pub reference: String,
    /// The number of pairs of that scene.
    pub pairs: usize,
    /// M, by rows.
    pub matrix: [[f64; 3]; 3],
    /// Of red, green and blue.
    pub gain: [f64; 3],
    /// Of red, green and blue.
    pub bias: [f64; 3],
    /// Of red, green and blue, the values at u = 0, 1/16, .. 1.
    pub segments: [Vec<f64>; 3],
}

impl Profile {
    /// Checks the profile.
    #[doc(hidden)]
    pub fn check(&self) -> Result<(), String> {
        if self.pairs == 0 {
            return Err("it was fitted to 0 pairs; it needs at least one".to_owned());
        }
        let numbers = self.matrix.iter().flatten().chain(&self.gain).chain(&self.bias);
        // Written so that a NaN fails.
        let beyond = |number: &&f64| {
            let is_usable = number.abs() <= LARGEST;
            !is_usable
        };
        if let Some(number) = numbers.chain(self.segments.iter().flatten()).find(beyond) {
            return Err(format!(
                "it contains {number}; every number must be within {LARGEST} of 0"
            ));
        }
        for (channel, name) in ["red", "green", "blue"].into_iter().enumerate() {
            let (sum, gain) = (self.matrix[channel].iter().sum::<f64>(), self.gain[channel]);
            if (sum - 1.0).abs() > ROUNDING {
                return Err(format!(
                    "the weights of {name} in `matrix` sum to {sum:.4}; a row must sum to 1; scale with `gain`"
                ));
            }
            if gain <= 0.0 {
                return Err(format!("the gain of {name} is {gain}; it must be above 0"));
            }
            let (values, needed) = (&self.segments[channel], SEGMENTS as usize + 1);
            if values.len() != needed {
                let count = values.len();
                return Err(format!("{name} has {count} values in `segments`, not {needed}"));
            }
            if let Some(pair) = values.windows(2).find(|pair| pair[1] < pair[0]) {
                return Err(format!(
                    "the segments of {name} fall from {} to {}; they must not decrease",
                    pair[0], pair[1]
                ));
            }
            if values[0] < 0.0 || values[values.len() - 1] > 1.0 {
                return Err(format!("the segments of {name} leave the range from 0 to 1"));
            }
        }
        Ok(())
    }

    /// The label of scores with this profile.
    #[doc(hidden)]
    pub fn label(&self) -> String {
        let Self { reference, pairs, .. } = self;
        let pairs = if *pairs == 1 { "a pair".to_owned() } else { format!("{pairs} pairs") };
        format!("a camera profile of {pairs} of {reference}")
    }

    /// The colour of k x, in [0, 1] if no channel is negative.
    #[doc(hidden)]
    pub fn value(&self, t: [f64; 3]) -> [f64; 3] {
        profiled(t, &self.numbers())
    }

    /// (3, `PROFILE_WIDTH`) numbers for the kernel.
    #[doc(hidden)]
    pub fn rows(&self) -> Vec<f32> {
        self.numbers().into_iter().map(|number| number as f32).collect()
    }

    fn numbers(&self) -> Vec<f64> {
        let channel = |channel: usize| {
            let (gain, values) = (self.gain[channel], &self.segments[channel]);
            let weights = self.matrix[channel].into_iter().map(move |weight| gain * weight);
            let rises = values.windows(2).map(|pair| pair[1] - pair[0]);
            weights.chain([self.bias[channel], values[0]]).chain(rises)
        };
        (0..3).flat_map(channel).collect()
    }
}

/// The colour of t = k x under a profile, in [0, 1]; `profile` is (3, `PROFILE_WIDTH`). Negative channels add what they
/// weigh at the slope of the first segment.
pub fn profiled<T: Real>(t: [T; 3], profile: &[T]) -> [T; 3] {
    let [zero, one] = [0.0, 1.0].map(T::from_f64);
    let unit = |x: T| x.at_least(zero).at_most(one);
    let count = T::from_f64(SEGMENTS.into());
    let above = t.map(|t| t.at_least(zero).one_minus_exp());
    let below = t.map(|t| (-t).at_least(zero).one_minus_exp());
    [0, 1, 2].map(|channel| {
        let numbers = &profile[channel * PROFILE_WIDTH as usize..][..PROFILE_WIDTH as usize];
        let mixed = |v: [T; 3]| numbers[0] * v[0] + numbers[1] * v[1] + numbers[2] * v[2];
        let scaled = count * unit(mixed(above) + numbers[3]);
        let y = numbers[5..].iter().zip(0..SEGMENTS).fold(numbers[4], |y, (&rise, segment)| {
            y + rise * unit(scaled - T::from_f64(segment.into()))
        });
        (unit(y) - count * numbers[5] * mixed(below)).at_least(-one)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A profile that mixes channels a little, and bends each differently.
    fn bent() -> Profile {
        let segments = [0.8, 1.0, 1.3]
            .map(|power: f64| (0..=16).map(|i| (f64::from(i) / 16.0).powf(power)).collect());
        Profile {
            reference: "a".to_owned(),
            pairs: 3,
            matrix: [[0.8, 0.15, 0.05], [-0.1, 1.2, -0.1], [0.0, 0.3, 0.7]],
            gain: [1.1, 0.9, 1.3],
            bias: [0.02, 0.0, -0.05],
            segments,
        }
    }

    #[test]
    fn a_profile_is_linear_between_its_values_and_constant_beyond_its_ends() {
        let mut profile = bent();
        profile.matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        (profile.gain, profile.bias) = ([1.0; 3], [0.0; 3]);
        profile.check().unwrap();
        let at = |u: f64| profile.value([-(1.0 - u).ln(); 3])[2];
        let values = &profile.segments[2];
        for i in 0..16 {
            let (u, middle) = (f64::from(i as u8) / 16.0, 0.5 * (values[i] + values[i + 1]));
            assert!((at(u) - values[i]).abs() < 1e-12, "{i}");
            assert!((at(u + 1.0 / 32.0) - middle).abs() < 1e-12, "{i}");
        }
        assert_eq!(profile.value([0.0; 3]), [0.0; 3]);
        let white = profile.value([1e9; 3]);
        assert!(white.iter().all(|y| (y - 1.0).abs() < 1e-12), "{white:?}");
    }

    #[test]
    fn an_invalid_profile_is_refused_with_the_reason() {
        let refused = |change: fn(&mut Profile), part: &str| {
            let mut profile = bent();
            change(&mut profile);
            let problem = profile.check().unwrap_err();
            assert!(problem.contains(part), "no `{part}` in: {problem}");
        };
        assert_eq!(bent().check(), Ok(()));
        refused(|profile| profile.segments[1][4] = 0.9, "segments of green fall");
        refused(|profile| profile.segments[0][4] = f64::NAN, "NaN");
        refused(|profile| profile.segments[2][16] = 1.5, "blue");
        refused(|profile| profile.bias[0] = f64::INFINITY, "inf");
        refused(|profile| profile.matrix[0][0] = 0.5, "weights of red");
        refused(|profile| profile.gain[2] = -1.0, "gain of blue");
        refused(|profile| profile.pairs = 0, "0 pairs");
        refused(|profile| profile.segments[0].truncate(9), "9 values");
    }
}
