//! A camera profile from pairs of photographs: [`Profile`], by robust least squares on colours.
//!
//! The channels of a profile are independent. For each of them, until convergence:
//!
//! ```text
//! segments    non-negative least squares of the 16 rises, given u = a v + b, with a light penalty on curvature
//! a, b        a damped Gauss-Newton step, given the segments; u is then rescaled to [0, 1]
//! weights     Huber's, from the residuals of both
//! ```
//!
//! Dark values are normalised to one exposure first: v = 1 - exp(-k x), where k is the gain of the automatic curve for
//! the photograph ([`Exposure`]). v is within [0, 1], so all segments of equal width are used; with t = x / p90
//! instead, the same fit scored 0.6 dB less on its own scene and on others.

use std::path::{Path, PathBuf};

use nalgebra::{SMatrix, SVector};
use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::{ColourCounts, Image, ImageFile};
use nightsplat_photographs::tone::{
    Exposure, LuminanceHistogram, Profile, SEGMENTS, measurable, soft,
};
use rayon::prelude::*;
use serde::Serialize;

use super::pairs::{PairScene, check_sizes, files_of, name_of};
use super::validate::{HeldOutPairs, all_except, split};

const KNOTS: usize = SEGMENTS as usize + 1;

/// The number of colours in a fit, over all photographs.
const COLOURS: usize = 200_000;
/// Rounds of segments, weights and mixing.
const ROUNDS: usize = 30;
/// Sweeps of the coordinate descent.
const SWEEPS: usize = 400;
/// The weight of the squared curvature of the segments relative to the mean squared residual: segments without colours
/// continue straight.
const BEND: f64 = 1e-5;
/// The share of a channel's u below 0 and above 1.
const CUT: f64 = 1e-3;
/// The smallest scale of the residuals, as for curves.
const MIN_SCALE: f64 = 0.25 / 255.0;
/// Units of the file's 4 decimals, a fortieth of a code value. 8-bit references do not determine more.
const UNITS: f64 = 1e4;

/// The pairs of a scene as colours, normalised to one exposure.
pub type ColourScene = PairScene<ColourPair>;

/// Dark colours of a photograph times its gain, and the colours of its reference.
#[derive(Clone, Debug)]
pub struct ColourPair {
    /// The dark photograph.
    pub path: PathBuf,
    /// k x, and the reference.
    pub colours: Vec<[[f32; 3]; 2]>,
}

/// The mean PSNR of pairs over all channels, dB, for a profile and for the automatic curve, which needs no reference.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProfileScores {
    /// The profile.
    pub profile: f64,
    /// The automatic curve, lambda = 0.
    pub auto: f64,
}

/// A scene, or a part of one, that a profile was not fitted to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ProfileFold {
    /// The scene's name, or that of the part.
    pub name: String,
    /// Its number of pairs.
    pub pairs: usize,
    /// Scores of a profile fitted to all other pairs.
    pub scores: ProfileScores,
}

impl ColourScene {
    /// The pairs that [`super::FitScene::load`] finds.
    pub fn load(folder: &Path, normal: Option<&Path>) -> Result<Self> {
        let (files, dark) = files_of(folder, normal)?;
        let share = (COLOURS / files.len()).max(1);
        let colours = ColourCounts::default();
        let load = |(dark, reference): &(PathBuf, PathBuf)| {
            let [image, bright] = [dark, reference].map(|path| Image::load_counted(path, &colours));
            sampled(dark, &image?, &bright?, share)
        };
        let photographs = files.par_iter().map(load).collect::<Result<Vec<_>>>()?;
        colours.log();
        let Some(exposure) = Exposure::measure(photographs.iter().map(|(_, y)| y), None) else {
            let problem = "every photograph is almost black: a profile needs at least one pair";
            return Err(Error::input(dark, problem));
        };
        let mut pairs = vec![];
        for (mut pair, luminance) in photographs {
            if nightsplat_photographs::tone::is_black(&luminance) {
                tracing::warn!("left out: {} is almost black", pair.path.display());
                continue;
            }
            let gain = exposure.gain_of(&luminance, None) as f32;
            pair.colours.iter_mut().for_each(|[dark, _]| *dark = dark.map(|x| gain * x));
            pairs.push(pair);
        }
        Ok(Self { name: name_of(folder), pairs })
    }
}

/// About `count` colours of a pair, evenly spaced, and the luminance of the whole dark photograph.
fn sampled(
    path: &Path,
    dark: &Image,
    reference: &Image,
    count: usize,
) -> Result<(ColourPair, LuminanceHistogram)> {
    check_sizes(path, dark, reference)?;
    let pixels = dark.pixel_count();
    let colour = |image: &Image, i: usize| {
        [0, 1, 2].map(|channel| measurable(image.data[channel * pixels + i]))
    };
    // An odd step changes its column from row to row.
    let step = (pixels / count).max(1) | 1;
    let both = |i| [colour(dark, i), colour(reference, i).map(|y| y.min(1.0))];
    let colours = (0..pixels).step_by(step).map(both).collect();
    let luminance = LuminanceHistogram::new(&dark.data);
    Ok((ColourPair { path: path.to_owned(), colours }, luminance))
}

/// Fits a profile to all pairs; residuals beyond `huber` times their scale are weighted down.
pub fn fit_profile(scenes: &[(&str, Vec<&ColourPair>)], huber: f64) -> Result<Profile> {
    let pairs: Vec<&ColourPair> = scenes.iter().flat_map(|(_, pairs)| pairs).copied().collect();
    let Some(first) = pairs.first() else {
        return Err(Error::Usage("there are no pairs: a profile needs at least one".to_owned()));
    };
    // Written so that a NaN fails.
    let is_positive = huber > 0.0;
    if !is_positive {
        return Err(Error::Usage(format!("huber is {huber}; it must be above 0")));
    }
    let colours = || pairs.iter().flat_map(|pair| &pair.colours);
    let v = |t: f32| 1.0 - (-f64::from(t)).exp();
    let inputs: Vec<SVector<f64, 4>> = colours()
        .map(|[dark, _]| SVector::from([v(dark[0]), v(dark[1]), v(dark[2]), 1.0]))
        .collect();
    let fitted = (0..3).into_par_iter().map(|channel| {
        let outputs: Vec<f64> = colours().map(|[_, light]| light[channel].into()).collect();
        Channel::fit(channel, &inputs, &outputs, huber)
    });
    let fitted = fitted.collect::<Option<Vec<Channel>>>().ok_or_else(|| {
        let problem = "has a single colour, as all pairs do: there is nothing to fit a profile to";
        Error::input(&first.path, problem)
    })?;
    let rounded = |x: f64| (UNITS * x).round() / UNITS;
    let of = |channel: usize| {
        let Channel { mix, values } = &fitted[channel];
        let gain = mix.fixed_rows::<3>(0).sum();
        // The last weight absorbs the rounding, so that the row still sums to 1.
        let [r, g] = [0, 1].map(|from| rounded(mix[from] / gain));
        let values: Vec<f64> = values.iter().map(|y| rounded(y.clamp(0.0, 1.0))).collect();
        ([r, g, rounded(1.0 - r - g)], rounded(gain), rounded(mix[3]), values)
    };
    let [red, green, blue] = [of(0), of(1), of(2)];
    let mut names: Vec<&str> = scenes.iter().map(|(name, _)| *name).collect();
    names.dedup();
    let profile = Profile {
        reference: names.join(", "),
        pairs: pairs.len(),
        matrix: [red.0, green.0, blue.0],
        gain: [red.1, green.1, blue.1],
        bias: [red.2, green.2, blue.2],
        segments: [red.3, green.3, blue.3],
    };
    profile.check().map_err(Error::Usage)?;
    Ok(profile)
}

/// One channel of a profile.
struct Channel {
    /// Weights of the channels, and the bias.
    mix: SVector<f64, 4>,
    /// At the knots.
    values: [f64; KNOTS],
}

impl Channel {
    /// `None` if u has no range.
    fn fit(
        channel: usize,
        inputs: &[SVector<f64, 4>],
        outputs: &[f64],
        huber: f64,
    ) -> Option<Self> {
        let mut mix = SVector::zeros();
        mix[channel] = 1.0;
        let mut fitted = Self { mix: stretched(mix, inputs)?, values: [0.0; KNOTS] };
        let (mut weights, mut damping) = (vec![1.0; outputs.len()], 1e-3);
        for round in 0..ROUNDS {
            fitted.fit_segments(inputs, outputs, &weights);
            let mut sizes: Vec<f64> = fitted.residuals(inputs, outputs).map(f64::abs).collect();
            let middle = sizes.len() / 2;
            let median = *sizes.select_nth_unstable_by(middle, f64::total_cmp).1;
            let limit = huber * (1.4826 * median).max(MIN_SCALE);
            weights =
                fitted.residuals(inputs, outputs).map(|r| (limit / r.abs()).min(1.0)).collect();
            if round + 1 < ROUNDS {
                damping = fitted.step(inputs, outputs, &weights, damping)?;
            }
        }
        Some(fitted)
    }

    /// The segment of u, and the position of u within it.
    fn segment(&self, input: &SVector<f64, 4>) -> (usize, f64) {
        let position = f64::from(SEGMENTS) * self.mix.dot(input).clamp(0.0, 1.0);
        let segment = (position as usize).min(KNOTS - 2);
        (segment, position - segment as f64)
    }

    fn residuals(&self, inputs: &[SVector<f64, 4>], outputs: &[f64]) -> impl Iterator<Item = f64> {
        inputs.iter().zip(outputs).map(|(input, y)| {
            let (segment, along) = self.segment(input);
            let [low, high] = [segment, segment + 1].map(|knot| self.values[knot]);
            y - (low + along * (high - low))
        })
    }

    /// The value at 0 and the non-negative rises, by coordinate descent on the normal equations.
    fn fit_segments(&mut self, inputs: &[SVector<f64, 4>], outputs: &[f64], weights: &[f64]) {
        type Square = SMatrix<f64, KNOTS, KNOTS>;
        let (mut normal, mut right) = (Square::zeros(), SVector::<f64, KNOTS>::zeros());
        for ((input, y), weight) in inputs.iter().zip(outputs).zip(weights) {
            let (low, along) = self.segment(input);
            let hats = [(low, 1.0 - along), (low + 1, along)];
            for (i, a) in hats {
                right[i] += weight * a * y;
                for (j, b) in hats {
                    normal[(i, j)] += weight * a * b;
                }
            }
        }
        let bend = BEND * weights.iter().sum::<f64>();
        for i in 1..KNOTS - 1 {
            let second = [(i - 1, 1.0), (i, -2.0), (i + 1, 1.0)];
            for (i, a) in second {
                for (j, b) in second {
                    normal[(i, j)] += bend * a * b * f64::from(SEGMENTS);
                }
            }
        }
        // The value at a knot is the sum of the rises up to it.
        let sums = Square::from_fn(|row, column| f64::from(u8::from(column <= row)));
        let (normal, right) = (sums.transpose() * normal * sums, sums.transpose() * right);
        let mut rises = SVector::<f64, KNOTS>::from_fn(|i, _| match i {
            0 => self.values[0],
            _ => self.values[i] - self.values[i - 1],
        });
        for _ in 0..SWEEPS {
            for i in 0..KNOTS {
                let slope = right[i] - normal.row(i).transpose().dot(&rises);
                rises[i] = (rises[i] + slope / normal[(i, i)]).max(0.0);
            }
        }
        let values = sums * rises;
        self.values = std::array::from_fn(|i| values[i]);
    }

    /// A step of weights and bias, taken only if it helps; returns the next damping, or `None` if u has no range left.
    fn step(
        &mut self,
        inputs: &[SVector<f64, 4>],
        outputs: &[f64],
        weights: &[f64],
        damping: f64,
    ) -> Option<f64> {
        let (mut normal, mut right) = (SMatrix::<f64, 4, 4>::zeros(), SVector::<f64, 4>::zeros());
        let residuals = self.residuals(inputs, outputs);
        for ((input, residual), weight) in inputs.iter().zip(residuals).zip(weights) {
            let u = self.mix.dot(input);
            if !(0.0..=1.0).contains(&u) {
                continue;
            }
            let (segment, _) = self.segment(input);
            let slope = f64::from(SEGMENTS) * (self.values[segment + 1] - self.values[segment]);
            normal += weight * slope * slope * input * input.transpose();
            right += weight * slope * residual * input;
        }
        let loss = |channel: &Self| -> f64 {
            let residuals = channel.residuals(inputs, outputs).zip(weights);
            residuals.map(|(residual, weight)| weight * residual * residual).sum()
        };
        let scale = normal.trace().max(f64::MIN_POSITIVE);
        let damped = normal + SMatrix::identity() * (damping * scale);
        let moved = damped
            .lu()
            .solve(&right)
            .map(|step| Self { mix: self.mix + step, values: self.values });
        // Grey must become brighter with more light.
        let helps =
            |moved: &Self| moved.mix.fixed_rows::<3>(0).sum() > 0.05 && loss(moved) < loss(self);
        match moved.filter(helps) {
            Some(moved) => {
                self.mix = stretched(moved.mix, inputs)?;
                Some((0.3 * damping).max(1e-9))
            }
            None => Some(10.0 * damping),
        }
    }
}

/// The mix that maps the inputs to u from 0 to 1, except for a share of [`CUT`]; `None` if all are equal.
fn stretched(mix: SVector<f64, 4>, inputs: &[SVector<f64, 4>]) -> Option<SVector<f64, 4>> {
    let mut u: Vec<f64> = inputs.iter().map(|input| mix.dot(input)).collect();
    let last = u.len() - 1;
    let mut at = |share: f64| {
        let rank = (share * last as f64) as usize;
        *u.select_nth_unstable_by(rank, f64::total_cmp).1
    };
    let [low, high] = [at(0.5 * CUT), at(1.0 - 0.5 * CUT)];
    let mut stretched = mix / (high - low);
    stretched[3] -= low / (high - low);
    (high - low > 1e-6).then_some(stretched)
}

/// Scores of a profile and of the automatic curve on pairs.
pub fn profile_scores(profile: &Profile, pairs: &[&ColourPair]) -> ProfileScores {
    let mean = |map: &(dyn Fn([f64; 3]) -> [f64; 3] + Sync)| {
        let psnr = |pair: &&ColourPair| {
            let squares = pair.colours.iter().flat_map(|[dark, light]| {
                let mapped = map(dark.map(f64::from));
                [0, 1, 2].map(|channel| (mapped[channel] - f64::from(light[channel])).powi(2))
            });
            -10.0 * (squares.sum::<f64>() / (3 * pair.colours.len()) as f64).log10()
        };
        // In order, since a sum of floats depends on it.
        let scores: Vec<f64> = pairs.par_iter().map(psnr).collect();
        scores.iter().sum::<f64>() / pairs.len() as f64
    };
    ProfileScores { profile: mean(&|t| profile.value(t)), auto: mean(&|t| t.map(|t| soft(t, 1.0))) }
}

/// Leaves out each scene in turn (of a single scene, every `folds`-th pair), and scores a profile of the others on it.
pub fn cross_validate_profile(
    scenes: &[ColourScene],
    folds: usize,
    huber: f64,
) -> Result<Vec<ProfileFold>> {
    let parts = split(scenes, folds)?;
    let held_out = |(index, part): (usize, &HeldOutPairs<'_, ColourPair>)| {
        let others = all_except(&parts, index);
        let others: Vec<_> = others.map(|part| (part.scene, part.pairs.clone())).collect();
        let profile = fit_profile(&others, huber)?;
        let scores = profile_scores(&profile, &part.pairs);
        Ok(ProfileFold { name: part.name.clone(), pairs: part.pairs.len(), scores })
    };
    parts.iter().enumerate().map(held_out).collect()
}
