//! Steps of an edit that look at one Gaussian at a time: what they do to a model they do to its parts.

use glam::{DQuat, DVec3};
use nightsplat_core::{Error, Result};

use super::operation::{Region, Span};
use crate::gaussians::Gaussians;

/// A step, with numbers in place of what it was measured from.
#[derive(Clone, Debug)]
pub enum Step {
    /// Keeps what is in a box or a sphere.
    Crop(Region),
    /// Removes Gaussians by their numbers in the model; the spans are in order and do not overlap.
    Delete(Vec<(usize, usize)>),
    /// Removes Gaussians of a lower opacity.
    OpacityMin(f64),
    /// Removes Gaussians that have an infinity or NaN.
    Finite,
    /// Drops coefficients, or adds zeros.
    ShDegree(u32),
    /// Rotates the world about its origin.
    Rotate(DQuat),
    /// Scales the world about its origin.
    Scale(f64),
    /// Moves the world.
    Move {
        /// How far.
        by: DVec3,
        /// Whether by the origin, as f32 means would lose precision.
        is_far: bool,
    },
}

impl Step {
    /// A removal by number from `count` Gaussians.
    pub fn delete(spans: &[Span], count: usize) -> Result<Self> {
        let mut ranges = vec![];
        for span in spans {
            let (first, last) = match *span {
                Span::One(index) => (index, index),
                Span::Range(first, last) => (first, last),
            };
            if first > last || last >= count {
                let problem = format!("delete names Gaussians {first} to {last} of {count}");
                return Err(Error::Usage(problem));
            }
            ranges.push((first, last));
        }
        ranges.sort_unstable();
        Ok(Self::Delete(ranges))
    }

    /// Whether it may remove Gaussians.
    pub fn removes(&self) -> bool {
        matches!(self, Self::Crop(_) | Self::Delete(_) | Self::OpacityMin(_) | Self::Finite)
    }

    /// Changes a part of a model whose first Gaussian has the number `first`.
    pub fn apply(&self, first: usize, part: &mut Gaussians) {
        let count = part.count;
        match self {
            Self::Crop(region) => {
                let is_kept = |index| region.contains(part.position(index));
                let keep: Vec<bool> = (0..count).map(is_kept).collect();
                part.retain(&keep);
            }
            Self::Delete(ranges) => {
                let mut keep = vec![true; count];
                for &(from, to) in ranges {
                    let [from, to] =
                        [from, to + 1].map(|at| at.clamp(first, first + count) - first);
                    keep[from..to].fill(false);
                }
                part.retain(&keep);
            }
            Self::OpacityMin(least) => {
                let keep: Vec<bool> = part.opacities().map(|opacity| opacity >= *least).collect();
                part.retain(&keep);
            }
            Self::Finite => part.retain_finite(),
            Self::ShDegree(degree) => *part = part.with_sh_degree(*degree),
            Self::Rotate(rotation) => part.rotate(*rotation),
            Self::Scale(factor) => part.scale(*factor),
            Self::Move { by, is_far } => part.translate(*by, *is_far),
        }
    }
}
