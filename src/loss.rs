//! The loss terms, their gradients, and their log.
//!
//! A term is one file: what it logs and weighs, its kernels, its scratch memory, what it compares a view with. [`TERMS`]
//! lists them, and the columns of train.csv, the reported loss, the checks of the weights and what a step records follow
//! from the list. Nothing is read back: each step leaves its terms in a slot of a log.

mod denoising;
mod depth;
pub mod exposure;
mod image;
mod log;
mod parameters;
mod structure;

use std::sync::Arc;

use glam::UVec2;

use crate::base::random::Stream;
use crate::base::settings::{Rule, settings};
use crate::gpu::{Buffer, Gpu, Recorder};
use crate::splats::scene::{Feature, Features};
use crate::{Error, Result};

pub use denoising::{DenoisingGradients, DenoisingInputs, DenoisingLoss, DenoisingWeights};
pub use depth::{DepthBoxes, DepthInputs, DepthLoss, DepthSettings};
pub use image::{Loss, LossInputs, LossSettings};
pub use log::{LogSlot, LossLog, LossLogDownload, StepLosses};
pub use parameters::{ParameterInputs, ParameterTerms, ParameterWeights};
pub use structure::{StructureInputs, StructureLoss};

/// Every term, in the order of the columns.
pub const TERMS: [LossSpec; 6] =
    [image::TARGET, image::DARK, structure::SPEC, depth::SPEC, denoising::SPEC, parameters::SPEC];

settings! {
"model.weights."
/// What the terms weigh beside (1 - w) L1 + w (1 - SSIM). The defaults are those of LITA-GS's code but for the total variation,
/// which blurs what holds no noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Of mean `(R_K - target)^2`, in the paper's form `(R_K - R_0)^2`.
    denoising: f64 = 1.0 => Rule::POSITIVE_OR_0;
    /// Of the total variation of R_K.
    total_variation: f64 = 0.0 => Rule::POSITIVE_OR_0;
    /// The reconstruction of the dark photograph weighs 1: (1 - w) L1 + w (1 - SSIM); this is its w.
    low_ssim: f64 = 0.2 => Rule::SHARE;
    /// Of mean |structure - edges of the target|.
    structure: f64 = 0.01 => Rule::POSITIVE_OR_0;
    /// Of 1 minus the correlation with the depth map, over the view and over boxes.
    depth: f64 = 0.1 => Rule::POSITIVE_OR_0;
}
}

impl Weights {
    /// Those of LITA-GS.
    pub(crate) fn paper() -> Self {
        Self { total_variation: 1.0, ..Self::default() }
    }
}

/// All that is to know about a term; it is on where something that it logs has a weight above 0.
#[derive(Debug)]
pub struct LossSpec {
    /// What it logs.
    pub terms: &'static [Term],
    /// What it looks at, and what builds it.
    pub on: TermOn,
}

/// What a term looks at, with what builds it.
#[derive(Clone, Copy, Debug)]
pub enum TermOn {
    /// The colours of the render. The first such term writes their gradient, every other adds to it.
    Colors(fn(&Gpu, &LossConfig, Gradient) -> Result<Box<dyn LossTerm>>),
    /// The channels of the render that show a feature, whose gradient it writes.
    Feature(Feature, fn(&Gpu, &LossConfig) -> Result<Box<dyn LossTerm>>),
    /// Outputs of the networks, with which it is built and recorded.
    Networks,
    /// The parameters of the Gaussians, to whose gradient it adds; recorded by [`ParameterTerms`].
    Parameters,
}

/// What a term of the colours does with the gradient that is there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gradient {
    /// It overwrites it.
    Written,
    /// It adds to it.
    Added,
}

/// A value that a loss term logs, and how it enters the loss.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub struct Term {
    /// Its column in train.csv.
    pub column: &'static str,
    /// What it is called in messages and tables.
    pub name: &'static str,
    /// A likeness enters the loss as 1 - value, a distance as it is.
    pub is_likeness: bool,
    /// What it weighs.
    pub(crate) weight: fn(&LossConfig) -> f64,
}

impl Term {
    /// Every term, in the order of the columns.
    pub fn all() -> impl Iterator<Item = Self> {
        TERMS.iter().flat_map(|spec| spec.terms).copied()
    }

    /// Its place among the columns.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn index(self) -> usize {
        Self::all().position(|term| term == self).unwrap_or_default()
    }
}

impl PartialEq for Term {
    fn eq(&self, other: &Self) -> bool {
        self.column == other.column
    }
}

impl std::fmt::Debug for Term {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.column)
    }
}

/// What the terms of a model are built from.
#[derive(Clone, Copy, Debug)]
pub struct LossConfig {
    /// w of (1 - w) L1 + w (1 - SSIM), in [0, 1].
    pub ssim_weight: f64,
    /// What the other terms weigh; 0 of a part that the model lacks.
    pub weights: Weights,
    /// What the reconstruction of the dark photograph weighs: 1, or 0 where the model has no tonemapper.
    pub low: f64,
    /// What the parameters of the Gaussians weigh.
    pub parameters: ParameterWeights,
    /// The side of the boxes of the local depth term, in pixels.
    pub depth_box: u32,
    /// The random numbers that place these boxes.
    pub boxes: Stream,
    /// What the Gaussians carry beside colour.
    pub features: Features,
}

impl LossConfig {
    /// The terms that the model has.
    pub fn terms(&self) -> Vec<Term> {
        self.specs().flat_map(|spec| spec.terms.iter().copied()).collect()
    }

    /// The weighted sum of a step's terms.
    pub fn total(&self, losses: &StepLosses) -> f64 {
        let of_term = |term: Term| {
            let value = f64::from(losses.get(term));
            (term.weight)(self) * if term.is_likeness { 1.0 - value } else { value }
        };
        self.terms().into_iter().map(of_term).sum()
    }

    fn specs(&self) -> impl Iterator<Item = &'static LossSpec> + '_ {
        let is_on = |spec: &&LossSpec| spec.terms.iter().any(|term| (term.weight)(self) > 0.0);
        TERMS.iter().filter(is_on)
    }
}

/// A training view as the terms see it before the first step.
#[allow(missing_debug_implementations, reason = "it holds a closure")]
pub struct ViewSource<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// Depth from elsewhere, (H, W), larger is farther.
    pub depth: Option<&'a [f32]>,
    /// Makes the pseudo-GT, (3, H, W).
    pub target: Box<dyn Fn() -> Result<Arc<Buffer<f32>>> + 'a>,
}

/// What the terms read of one step.
#[derive(Clone, Copy, Debug)]
pub struct TermInputs<'a> {
    /// Counted from 1.
    pub step: u64,
    /// The place of the view among those that the terms were prepared for.
    pub view: usize,
    /// Width and height in pixels.
    pub size: UVec2,
    /// What the render shows beside colour.
    pub features: Features,
    /// (channels, H, W), not clamped.
    pub render: &'a Buffer<f32>,
    /// What is held to the target, (3, H, W) or longer, not clamped: the colours of the render, or what the view's exposure
    /// makes of them.
    pub colors: &'a Buffer<f32>,
    /// The pseudo-GT, (3, H, W).
    pub target: &'a Buffer<f32>,
}

impl TermInputs<'_> {
    /// The first channel of the render that shows a feature, which it has.
    fn plane(&self, feature: Feature) -> u32 {
        self.features.channels_of(feature).unwrap_or_default().start as u32
    }
}

/// A term of the render.
pub trait LossTerm: std::fmt::Debug + Send {
    /// Takes scratch memory for these views, and what it compares each of them with.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()>;

    /// Records the term of a step: its part of `d_render`, (channels, H, W), and its values in the log.
    ///
    /// # Errors
    /// A buffer is shorter than the view, or the view is larger than those prepared for.
    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()>;
}

/// The terms of the render that a model has.
#[derive(Debug)]
pub struct Losses(Vec<Box<dyn LossTerm>>);

impl Losses {
    /// The terms; [`Losses::prepare`] makes them ready for views.
    ///
    /// # Errors
    /// A weight makes no sense, or the device refuses a pipeline.
    pub fn new(gpu: &Gpu, config: &LossConfig) -> Result<Self> {
        let (mut terms, mut gradient) = (vec![], Gradient::Written);
        for spec in config.specs() {
            match spec.on {
                TermOn::Colors(build) => {
                    terms.push(build(gpu, config, gradient)?);
                    gradient = Gradient::Added;
                }
                TermOn::Feature(feature, build) if config.features.has(feature) => {
                    terms.push(build(gpu, config)?);
                }
                TermOn::Feature(..) | TermOn::Networks | TermOn::Parameters => {}
            }
        }
        Ok(Self(terms))
    }

    /// Computes what stays the same of these views, and makes room for them.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        self.0.iter_mut().try_for_each(|term| term.prepare(views))
    }

    /// Records every term of a step: dL/d render, (channels, H, W), and the values in the log.
    ///
    /// # Errors
    /// As [`LossTerm::record_step`].
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        if inputs.features != Features::NONE {
            // Not every term reaches every pixel of its planes.
            pass.fill(d_render, 0);
        }
        self.0.iter_mut().try_for_each(|term| term.record_step(pass, inputs, d_render, log))
    }
}

/// The rectangle of a view whose pixels a loss counts; the others are context.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LossRegion {
    /// The first column and row.
    pub origin: UVec2,
    /// Width and height in pixels.
    pub size: UVec2,
}

impl LossRegion {
    /// All of a view.
    pub const fn whole(size: UVec2) -> Self {
        Self { origin: UVec2::ZERO, size }
    }

    /// One past the last column and row.
    fn end(self) -> UVec2 {
        self.origin + self.size
    }

    /// The values of its three channels.
    fn value_count(self) -> u32 {
        value_count(self.size)
    }

    /// Refuses an interior that is empty or reaches out of a view of `size`.
    fn check(self, size: UVec2) -> Result<()> {
        let Self { origin, size: own } = self;
        let fits = own.min_element() > 0
            && own.cmple(size).all()
            && origin.cmple(size.saturating_sub(own)).all();
        if !fits {
            return Err(Error::Usage(format!(
                "an interior of {} x {} at {}, {} does not lie in a view of {} x {}",
                own.x, own.y, origin.x, origin.y, size.x, size.y
            )));
        }
        Ok(())
    }
}

/// The values of the three channels of a view.
fn value_count(size: UVec2) -> u32 {
    pixel_count(size).saturating_mul(3)
}

fn pixel_count(size: UVec2) -> u32 {
    size.x.saturating_mul(size.y)
}

/// Refuses a buffer that is too short.
fn holds(buffer: &Buffer<f32>, values: usize) -> Result<()> {
    if buffer.len() >= values {
        return Ok(());
    }
    let (name, len) = (buffer.name(), buffer.len());
    Err(Error::Usage(format!("buffer `{name}` holds {len} values, the view has {values}")))
}

fn no_scratch(term: &str, size: UVec2) -> Error {
    let UVec2 { x, y } = size;
    Error::Usage(format!("the {term} has no scratch memory for a view of {x} x {y}"))
}

/// Refuses a weight that is negative or not finite.
fn check_weight(of: &str, weight: f64) -> Result<()> {
    if weight.is_finite() && weight >= 0.0 {
        return Ok(());
    }
    Err(Error::Usage(format!("the weight of {of} is {weight}; it must be 0 or more")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::gpu;

    /// Another plane would still train, on the wrong thing.
    #[test]
    fn a_term_reads_the_first_channel_of_its_feature() {
        let gpu = gpu();
        let image = gpu.zeros("image", 1).unwrap();
        let features = Features { depth: true, structure: true, noise: true, illumination: true };
        let inputs = TermInputs {
            step: 1,
            view: 0,
            size: UVec2::ONE,
            features,
            render: &image,
            colors: &image,
            target: &image,
        };
        let all = [Feature::Depth, Feature::Structure, Feature::Noise, Feature::Illumination];
        assert_eq!(all.map(|feature| inputs.plane(feature)), [3, 4, 5, 8]);
    }
}
