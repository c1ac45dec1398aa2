//! Floaters: Gaussians that the training views contradict, and those that no view sees and that stand alone or before a
//! camera.
//!
//! Floaters hide each other and what is correct. So all opacities first follow the squared error of the views together:
//! in every round, each Gaussian takes a part of the step that would be best for it alone, and none becomes more opaque
//! than it was. Those that have faded are candidates, and are rendered so faintly that they do not hide each other. A
//! candidate is a floater if the views fit worse with it, by more than chance and by what it adds itself: then it is
//! not rendered any more, and the others are seen without what it added. All others come back.

use std::cell::Cell;

use glam::DVec3;
use nightsplat_core::Result;

use crate::gaussians::Gaussians;

/// The most rounds in which opacities follow the error.
const FADE_ROUNDS: usize = 40;
/// They end once the error falls by less than this part of it.
const LEAST_GAIN: f64 = 0.01;
/// The part of its best step that a Gaussian takes in a round, at first and at last: halved where steps together
/// overshoot.
const STEPS: [f64; 2] = [0.3, 0.05];
/// The most that a round adds to a share of an opacity, and the largest best step in shares of what there is.
const GROWTH: [f64; 2] = [0.3, 6.0];
/// The least share of an opacity, from which it can return.
const LEAST_SHARE: f64 = 0.02;
/// A Gaussian below this share of its opacity is a candidate.
const FADED: f64 = 0.5;
/// Standard deviations of the views' error, over what a Gaussian adds, that are no chance.
const DEVIATIONS: f64 = 4.0;
/// The most rounds in which candidates come back or are removed.
const SETTLING_ROUNDS: usize = 12;
/// Opacities follow the error this many times: what many floaters hid is seen when those are gone.
const PASSES: usize = 2;
/// The share of its opacity at which a candidate is rendered, and one at which nothing is.
const FAINT: f64 = 0.1;
const ABSENT: f64 = 1e-6;
/// The standard deviations by which the views fit worse with a floater; lower, as faint candidates add to the error.
const RETURN_DEVIATIONS: f64 = 3.0;
/// The first rounds decide on the surest floaters: by this many times the deviations, which is halved in every round.
const SUREST: f64 = 32.0;
/// The squared light below which no view sees a Gaussian: a hundredth of one value of one pixel.
const UNSEEN: f64 = 1e-4;
/// An unseen Gaussian stands alone from this many times the median distance to its neighbours.
const ALONE: f64 = 6.0;

/// What the training views say of each Gaussian, summed over them; d is what it adds to a render.
#[derive(Clone, Debug)]
pub struct Evidence {
    /// <render - target, 2 d>.
    pub product: Vec<f64>,
    /// |d|^2.
    pub square: Vec<f64>,
    /// The mean squared error of a value of the views.
    pub error: f64,
}

/// The training cameras.
#[derive(Clone, Debug)]
pub struct CameraPositions {
    /// In the world of the Gaussians.
    pub positions: Vec<DVec3>,
    /// The distance before a camera at which nothing is.
    pub near: f64,
}

/// The Gaussians that are no floaters, and how many are.
#[derive(Clone, Debug)]
pub struct Floaters {
    /// False for a floater.
    pub keep: Vec<bool>,
    /// Those that the training views contradict.
    pub contradicted: usize,
    /// Those that no training view sees, alone or before a camera.
    pub unseen: usize,
}

/// Finds the floaters of Gaussians by what `measured` says of them and of some of them. `observe` is called with the
/// number of every round, and the most.
pub fn find(
    gaussians: &Gaussians,
    cameras: &CameraPositions,
    measured: impl Fn(&Gaussians) -> Result<Evidence>,
    observe: &dyn Fn(usize, usize),
) -> Result<Floaters> {
    let rounds = Cell::new(0);
    let evidence_of = |shares: &[f64]| {
        rounds.set(rounds.get() + 1);
        observe(rounds.get(), PASSES * (FADE_ROUNDS + SETTLING_ROUNDS));
        measured(&faded(gaussians, shares))
    };
    let mut keep = vec![true; gaussians.count];
    for _ in 0..PASSES {
        let shares = fade(&keep, evidence_of)?;
        let before = std::mem::replace(&mut keep, settled(&shares, evidence_of)?);
        if keep == before {
            break;
        }
    }
    let contradicted = keep.iter().filter(|keep| !**keep).count();
    let unseen = drop_unseen(gaussians, &mut keep, cameras, measured)?;
    Ok(Floaters { keep, contradicted, unseen })
}

/// Lets opacities of what is kept follow the error; returns the share of each that is left.
fn fade(keep: &[bool], evidence_of: impl Fn(&[f64]) -> Result<Evidence>) -> Result<Vec<f64>> {
    let mut shares: Vec<f64> = keep.iter().map(|keep| if *keep { 1.0 } else { ABSENT }).collect();
    let first = shares.clone();
    let mut best: Option<(Vec<f64>, Evidence)> = None;
    let [mut step, least_step] = STEPS;
    for round in 0..FADE_ROUNDS {
        let evidence = evidence_of(&shares)?;
        let least = best.as_ref().map_or(f64::INFINITY, |(_, best)| best.error);
        tracing::debug!("fade {round}: error {:.6}, step {step}", evidence.error);
        if evidence.error < least {
            let gain = 1.0 - evidence.error / least;
            best = Some((shares, evidence));
            if gain < LEAST_GAIN {
                break;
            }
        } else {
            step *= 0.5;
            if step < least_step {
                break;
            }
        }
        let Some((from, evidence)) = &best else { break };
        let stepped = |(index, share): (usize, &f64)| {
            if !keep[index] {
                return *share;
            }
            let [most, longest] = GROWTH;
            let change = step * share * evidence.best_step(index, longest);
            (share - change.max(-most)).clamp(LEAST_SHARE, 1.0)
        };
        shares = from.iter().enumerate().map(stepped).collect();
    }
    Ok(best.map_or(first, |(shares, _)| shares))
}

/// What is known of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Verdict {
    /// It has not faded.
    Supported,
    Candidate,
    /// A candidate that came back.
    Returned,
    Floater,
}

/// Decides on what has faded; returns which Gaussians are no floaters.
fn settled(shares: &[f64], evidence_of: impl Fn(&[f64]) -> Result<Evidence>) -> Result<Vec<bool>> {
    let first = |share: &f64| match *share {
        share if share < LEAST_SHARE => Verdict::Floater,
        share if share < FADED => Verdict::Candidate,
        _ => Verdict::Supported,
    };
    let mut verdicts: Vec<Verdict> = shares.iter().map(first).collect();
    let mut surest = SUREST;
    for round in 0..SETTLING_ROUNDS {
        let share = |verdict: &Verdict| match verdict {
            Verdict::Supported | Verdict::Returned => 1.0,
            Verdict::Candidate => FAINT,
            Verdict::Floater => ABSENT,
        };
        let shares: Vec<f64> = verdicts.iter().map(share).collect();
        let evidence = evidence_of(&shares)?;
        let next: Vec<Verdict> = (0..)
            .zip(&verdicts)
            .map(|(index, verdict)| match verdict {
                Verdict::Candidate => evidence.of_candidate(index, surest),
                Verdict::Returned if evidence.contradicts(index) => Verdict::Floater,
                verdict => *verdict,
            })
            .collect();
        let count = |verdict: Verdict| next.iter().filter(|found| **found == verdict).count();
        let [candidates, floaters] = [Verdict::Candidate, Verdict::Floater].map(count);
        let error = evidence.error;
        tracing::debug!("round {round}: {candidates} open, {floaters} floaters, error {error:.6}");
        if std::mem::replace(&mut verdicts, next) == verdicts && surest <= 1.0 {
            break;
        }
        surest = (surest / 2.0).max(1.0);
    }
    // What is refused to the end is a floater, whatever else adds to the error there.
    let stays = |verdict: &Verdict| matches!(verdict, Verdict::Supported | Verdict::Returned);
    Ok(verdicts.iter().map(stays).collect())
}

impl Evidence {
    /// The part of a Gaussian's opacity that the views would take away if it were the only one, at most 1 and at least
    /// `-longest`: the minimum of a parabola. 0 where it is chance.
    fn best_step(&self, index: usize, longest: f64) -> f64 {
        let [product, square] = [self.product[index], self.square[index]];
        let chance = DEVIATIONS * 2.0 * (self.error * square).sqrt();
        if square > 0.0 && product.abs() > chance {
            (product / (2.0 * square)).clamp(-longest, 1.0)
        } else {
            0.0
        }
    }

    /// What the views say of a candidate, which was rendered at [`FAINT`], if only the surest floaters are decided on.
    fn of_candidate(&self, index: usize, surest: f64) -> Verdict {
        let [product, square] = [self.product[index] / FAINT, self.square[index] / (FAINT * FAINT)];
        let chance = RETURN_DEVIATIONS * 2.0 * (self.error * square).sqrt();
        if product + square <= chance {
            return Verdict::Returned;
        }
        // More than all of it would have to go: others cause that, which may be floaters themselves.
        let is_caused_by_others = product > 2.0 * square;
        if is_caused_by_others || product + square <= surest * chance {
            return Verdict::Candidate;
        }
        Verdict::Floater
    }

    /// Whether the views would fit better without a Gaussian, and without just about all of it.
    fn contradicts(&self, index: usize) -> bool {
        let [product, square] = [self.product[index], self.square[index]];
        let is_whole = product > square && product < 3.0 * square;
        is_whole && product - square > DEVIATIONS * 2.0 * (self.error * square).sqrt()
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
    cameras: &CameraPositions,
    evidence: impl Fn(&Gaussians) -> Result<Evidence>,
) -> Result<usize> {
    let indices: Vec<usize> = (0..keep.len()).filter(|&index| keep[index]).collect();
    let mut kept = gaussians.clone();
    kept.retain(keep);
    let (evidence, are_alone) = (evidence(&kept)?, are_alone(&kept));
    let mut unseen = 0;
    for (kept_index, &index) in indices.iter().enumerate() {
        let position = gaussians.position(index);
        let is_near = |camera: &DVec3| camera.distance(position) < cameras.near;
        let is_before = || cameras.positions.iter().any(is_near);
        if evidence.square[kept_index] < UNSEEN && (are_alone[kept_index] || is_before()) {
            keep[index] = false;
            unseen += 1;
        }
    }
    Ok(unseen)
}

/// Which Gaussians are far from others.
fn are_alone(gaussians: &Gaussians) -> Vec<bool> {
    let distances = gaussians.distances_to_nearest();
    let mut sorted = distances.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or_default();
    distances.into_iter().map(|distance| distance > ALONE * median).collect()
}
