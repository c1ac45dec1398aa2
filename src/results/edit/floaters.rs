//! Floaters: Gaussians that the training views contradict, and those that no view sees and that stand alone or before a
//! camera.
//!
//! Floaters hide each other and what is correct. So all opacities first follow the squared error of the views together:
//! in every round, each Gaussian takes a part of the step that would be best for it alone, and none becomes more opaque
//! than it was. Those that have faded are candidates. A candidate is a floater if the views fit worse with it, by more
//! than chance; for that, it is rendered so faintly that candidates do not hide each other. All others come back.

use glam::DVec3;

use super::evidence::{Evidence, Measured};
use crate::Result;
use crate::photographs::image::Image;
use crate::splats::scene::Gaussians;

/// Rounds in which opacities follow the error.
const FADE_ROUNDS: usize = 15;
/// The part of its best step that a Gaussian takes in a round.
const STEP: f64 = 0.3;
/// A Gaussian below this share of its opacity is a candidate.
const FADED: f64 = 0.5;
/// Standard deviations of the views' error, over what a Gaussian adds, that are no chance.
const DEVIATIONS: f64 = 4.0;
/// Rounds in which candidates come back.
const RETURN_ROUNDS: usize = 6;
/// The share of its opacity at which a candidate is rendered.
const FAINT: f64 = 0.1;
/// The standard deviations by which the views fit worse with a floater; lower, as faint candidates add to the error.
const RETURN_DEVIATIONS: f64 = 3.0;
/// The squared light below which no view sees a Gaussian: a hundredth of one value of one pixel.
const UNSEEN: f64 = 1e-4;
/// An unseen Gaussian stands alone from this many times the median distance to its neighbours.
const ALONE: f64 = 6.0;

/// The Gaussians that are no floaters, and how many are.
pub(super) struct Found {
    pub(super) keep: Vec<bool>,
    /// Those that the training views contradict.
    pub(super) contradicted: usize,
    /// Those that no training view sees, alone or before a camera.
    pub(super) unseen: usize,
}

/// Finds the floaters of Gaussians; `cameras` are the positions of the training cameras, and `near` the distance before
/// them at which nothing is, in the same units.
///
/// # Errors
/// The device is out of memory or lost.
pub(super) fn found<'a>(
    gaussians: &Gaussians,
    targets: &[Option<Image>],
    (cameras, near): (&[DVec3], f64),
    measured: impl Fn(&Gaussians) -> Measured<'a>,
) -> Result<Found> {
    let evidence_of = |shares: &[f64]| measured(&faded(gaussians, shares)).evidence(targets);
    let mut shares = vec![1.0; gaussians.count];
    let (mut before, mut least_error) = (shares.clone(), f64::INFINITY);
    for _ in 0..FADE_ROUNDS {
        let evidence = evidence_of(&shares)?;
        // Steps together overshoot where there is no more to gain.
        if evidence.error >= least_error {
            shares = before;
            break;
        }
        least_error = evidence.error;
        before.clone_from(&shares);
        let steps: Vec<f64> = (0..shares.len()).map(|index| evidence.best_step(index)).collect();
        for (share, step) in shares.iter_mut().zip(steps) {
            *share = (*share * (1.0 - STEP * step)).min(1.0);
        }
    }
    let mut keep: Vec<bool> = shares.iter().map(|share| *share >= FADED).collect();
    for _ in 0..RETURN_ROUNDS {
        let shares: Vec<f64> = keep.iter().map(|keep| if *keep { 1.0 } else { FAINT }).collect();
        let evidence = evidence_of(&shares)?;
        let returns = |index: &usize| !keep[*index] && !evidence.refuses(*index);
        let returning: Vec<usize> = (0..keep.len()).filter(returns).collect();
        if returning.is_empty() {
            break;
        }
        returning.iter().for_each(|&index| keep[index] = true);
    }
    let contradicted = keep.iter().filter(|keep| !**keep).count();
    let unseen = drop_unseen(gaussians, &mut keep, (cameras, near), |rest| {
        measured(rest).evidence(targets)
    })?;
    Ok(Found { keep, contradicted, unseen })
}

impl Evidence {
    /// The part of a Gaussian's opacity that the views would take away if it were the only one, -1 to 1: the minimum of
    /// a parabola. 0 where it is chance.
    fn best_step(&self, index: usize) -> f64 {
        let [product, square] = [self.product[index], self.square[index]];
        let chance = DEVIATIONS * 2.0 * (self.error * square).sqrt();
        if square > 0.0 && product.abs() > chance {
            (product / (2.0 * square)).clamp(-1.0, 1.0)
        } else {
            0.0
        }
    }

    /// Whether the views fit worse with a candidate, which was rendered at [`FAINT`].
    fn refuses(&self, index: usize) -> bool {
        let [product, square] = [self.product[index] / FAINT, self.square[index] / (FAINT * FAINT)];
        product + square > RETURN_DEVIATIONS * 2.0 * (self.error * square).sqrt()
    }
}

/// The Gaussians with these shares of their opacities, at most 1.
fn faded(gaussians: &Gaussians, shares: &[f64]) -> Gaussians {
    let mut faded = gaussians.clone();
    for (raw, share) in faded.raw_opacities_mut().iter_mut().zip(shares) {
        if *share < 1.0 {
            let opacity = share / (1.0 + (-f64::from(*raw)).exp());
            *raw = (opacity / (1.0 - opacity)).ln() as f32;
        }
    }
    faded
}

/// Drops what no training view sees and stands alone or before a camera; returns how many.
fn drop_unseen(
    gaussians: &Gaussians,
    keep: &mut [bool],
    (cameras, near): (&[DVec3], f64),
    evidence: impl Fn(&Gaussians) -> Result<Evidence>,
) -> Result<usize> {
    let left: Vec<usize> = (0..keep.len()).filter(|&index| keep[index]).collect();
    let mut rest = gaussians.clone();
    rest.retain(keep);
    let (evidence, alone) = (evidence(&rest)?, alone(&rest));
    let mut unseen = 0;
    for (number, &index) in left.iter().enumerate() {
        let position = gaussians.position(index);
        let is_before = || cameras.iter().any(|camera| camera.distance(position) < near);
        if evidence.square[number] < UNSEEN && (alone[number] || is_before()) {
            keep[index] = false;
            unseen += 1;
        }
    }
    Ok(unseen)
}

/// Which Gaussians are far from others.
fn alone(gaussians: &Gaussians) -> Vec<bool> {
    let distances = gaussians.distances_to_nearest();
    let mut sorted = distances.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or_default();
    distances.into_iter().map(|distance| distance > ALONE * median).collect()
}
