//! The loss terms, their gradients, and their log.
//!
//! A term is one file: its columns and weights, its kernels, its scratch memory, and the target that it compares a view
//! with. [`TERMS`] lists them; the columns of train.csv, the reported loss, the checks of the weights and the recording
//! of a step follow from the list. Nothing is read back: each step writes its terms to a slot of a log.

mod denoising;
mod depth;
pub mod exposure;
mod image;
mod log;
mod normals;
mod parameters;
mod structure;

use std::sync::Arc;

use glam::UVec2;
use nightsplat_core::random::Stream;
use nightsplat_core::settings;
use nightsplat_core::settings::Rule;
use nightsplat_models::gaussians::{Feature, Features};

use crate::gpu::{Buffer, Gpu, Recorder};
use crate::kernels::Camera;
use crate::{Error, Result};
pub use denoising::DenoisingLoss;
pub use depth::{DepthBoxes, DepthLoss};
pub use image::{Loss, LossInputs};
pub use log::{LogSlot, LossLog, LossLogDownload, StepLosses};
pub use normals::NormalLoss;
pub use parameters::{ParameterTerms, ParameterWeights};
pub use structure::StructureLoss;

/// All terms, in the order of the columns.
pub const TERMS: [LossSpec; 7] = [
    image::TARGET,
    image::DARK,
    structure::SPEC,
    depth::SPEC,
    normals::SPEC,
    denoising::SPEC,
    parameters::SPEC,
];

settings! {
"model.weights."
/// The weights of the terms in addition to (1 - w) L1 + w (1 - SSIM). The defaults are those of LITA-GS's code except
/// for the total variation, which blurs images without noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Weight of mean `(R_K - target)^2`; in the paper's variant, of mean `(R_K - R_0)^2`.
    denoising: f64 = 1.0 => Rule::POSITIVE_OR_0;
    /// Weight of the total variation of R_K.
    total_variation: f64 = 0.0 => Rule::POSITIVE_OR_0;
    /// w of the reconstruction of the dark photograph, (1 - w) L1 + w (1 - SSIM), whose own weight is 1.
    low_ssim: f64 = 0.2 => Rule::SHARE;
    /// Weight of mean |structure - edges of the target|.
    structure: f64 = 0.01 => Rule::POSITIVE_OR_0;
    /// Weight of 1 minus the correlation with the depth map, over the view and over boxes.
    depth: f64 = 0.1 => Rule::POSITIVE_OR_0;
    /// Weight of 1 minus the cosine between rendered normals and those of the normal map, at the first step; it falls
    /// linearly to 0 at the last.
    normals: f64 = 0.05 => Rule::POSITIVE_OR_0;
}
}

impl Weights {
    /// The weights of LITA-GS.
    pub(crate) fn paper() -> Self {
        Self { total_variation: 1.0, ..Self::default() }
    }
}

/// The description of a term; it is on if any of its columns has a weight above 0.
#[derive(Debug)]
pub struct LossSpec {
    /// Its columns.
    pub terms: &'static [Term],
    /// What it reads, and its constructor.
    pub on: TermOn,
}

/// What a term reads, with its constructor.
#[derive(Clone, Copy, Debug)]
pub enum TermOn {
    /// The colours of the render. The first such term writes their gradient, the others add to it.
    Colors(fn(&Gpu, &LossConfig, Gradient) -> Result<Box<dyn LossTerm>>),
    /// The channels of a feature, whose gradient it writes.
    Feature(Feature, fn(&Gpu, &LossConfig) -> Result<Box<dyn LossTerm>>),
    /// The mean depth in the view, whose gradient over alpha it writes.
    ViewDepth(fn(&Gpu, &LossConfig) -> Result<Box<dyn LossTerm>>),
    /// Outputs of the networks.
    Networks,
    /// The parameters of the Gaussians, to whose gradient it adds; recorded by [`ParameterTerms`].
    Parameters,
}

/// How a term on colours updates the gradient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gradient {
    /// Overwrite.
    Written,
    /// Add.
    Added,
}

/// A column of the log, and how it enters the loss.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub struct Term {
    /// Its column in train.csv.
    pub column: &'static str,
    /// Its name in messages and tables.
    pub name: &'static str,
    /// A similarity enters the loss as 1 - value, a distance as it is.
    pub is_likeness: bool,
    /// Its weight.
    pub(crate) weight: fn(&LossConfig) -> f64,
}

impl Term {
    /// A term that enters the loss as it is.
    const fn distance(
        column: &'static str,
        name: &'static str,
        weight: fn(&LossConfig) -> f64,
    ) -> Self {
        Self { column, name, is_likeness: false, weight }
    }

    /// A term that enters the loss as 1 - value.
    const fn likeness(
        column: &'static str,
        name: &'static str,
        weight: fn(&LossConfig) -> f64,
    ) -> Self {
        Self { column, name, is_likeness: true, weight }
    }

    /// All terms, in the order of the columns.
    pub fn all() -> impl Iterator<Item = Self> {
        TERMS.iter().flat_map(|spec| spec.terms).copied()
    }

    /// Its index among the columns.
    #[doc(hidden)]
    pub fn index(self) -> usize {
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

/// The settings of the terms of a model.
#[derive(Clone, Copy, Debug)]
pub struct LossConfig {
    /// w of (1 - w) L1 + w (1 - SSIM), in [0, 1].
    pub ssim_weight: f64,
    /// The weights of the other terms; 0 for parts that the model lacks.
    pub weights: Weights,
    /// The weight of the reconstruction of the dark photograph: 1, or 0 without a tonemapper.
    pub low: f64,
    /// The weights of the terms on parameters.
    pub parameters: ParameterWeights,
    /// The side of the boxes of the local depth term, in pixels.
    pub depth_box: u32,
    /// The random numbers that place the boxes.
    pub boxes: Stream,
    /// The features of the Gaussians.
    pub features: Features,
    /// The steps of the run, over which a weight may decay.
    pub steps: u64,
}

impl LossConfig {
    /// The terms of the model.
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

/// A training view as the terms prepare for it, before the first step.
#[allow(missing_debug_implementations, reason = "it holds a closure")]
pub struct ViewSource<'a> {
    /// Width and height in pixels.
    pub size: UVec2,
    /// Its camera.
    pub camera: Camera,
    /// Estimated depth, (H, W), larger is farther.
    pub depth: Option<&'a [f32]>,
    /// Estimated normals, (H, W), as in `include/map_normal.glsl`; only of a pinhole.
    pub normals: Option<&'a [u32]>,
    /// Returns the target, (3, H, W).
    pub target: Box<dyn Fn() -> Result<Arc<Buffer<f32>>> + 'a>,
}

/// The inputs of the terms in one step.
#[derive(Clone, Copy, Debug)]
pub struct TermInputs<'a> {
    /// Counted from 1.
    pub step: u64,
    /// The index of the view among the prepared ones.
    pub view: usize,
    /// Width and height in pixels.
    pub size: UVec2,
    /// The features of the render.
    pub features: Features,
    /// (channels, H, W), not clamped.
    pub render: &'a Buffer<f32>,
    /// (H, W)
    pub transmittances: &'a Buffer<f32>,
    /// The image that is compared with the target, (3, H, W) or longer, not clamped: the colours of the render, at the
    /// view's exposure if that is learned.
    pub colors: &'a Buffer<f32>,
    /// The target, (3, H, W).
    pub target: &'a Buffer<f32>,
}

impl TermInputs<'_> {
    /// The first channel of a feature, which the render must have.
    fn plane(&self, feature: Feature) -> u32 {
        self.features.channels_of(feature).unwrap_or_default().start as u32
    }
}

/// A term of the render.
pub trait LossTerm: std::fmt::Debug + Send {
    /// Compiles every kernel that [`Self::prepare`] would compile only for views that need it.
    fn compile(&mut self) -> Result<()> {
        Ok(())
    }

    /// Allocates scratch memory for these views, and prepares the target of each.
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()>;

    /// Records the term of a step: its part of `d_render`, (channels, H, W), and its values in the log.
    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()>;
}

/// The terms on the render of a model.
#[derive(Debug)]
pub struct Losses {
    terms: Vec<Box<dyn LossTerm>>,
    /// Whether the gradient has planes in addition to colour, of which not every term writes every pixel.
    has_planes: bool,
}

impl Losses {
    /// Builds the terms; [`Losses::prepare`] prepares them for views.
    pub fn new(gpu: &Gpu, config: &LossConfig) -> Result<Self> {
        let (mut terms, mut gradient) = (vec![], Gradient::Written);
        for spec in config.specs() {
            match spec.on {
                TermOn::Colors(build) => {
                    terms.push(build(gpu, config, gradient)?);
                    gradient = Gradient::Added;
                }
                TermOn::ViewDepth(build) => terms.push(build(gpu, config)?),
                TermOn::Feature(feature, build) if config.features.has(feature) => {
                    terms.push(build(gpu, config)?);
                }
                TermOn::Feature(..) | TermOn::Networks | TermOn::Parameters => {}
            }
        }
        let has_planes = config.features != Features::NONE || config.weights.normals > 0.0;
        Ok(Self { terms, has_planes })
    }

    /// Compiles the kernels of views of any size.
    pub(crate) fn compile(&mut self) -> Result<()> {
        self.terms.iter_mut().try_for_each(|term| term.compile())
    }

    /// Prepares the data that is constant for these views, and allocates for them.
    pub fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        self.terms.iter_mut().try_for_each(|term| term.prepare(views))
    }

    /// Records every term of a step: dL/d render, (channels, H, W), and the values in the log.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        if self.has_planes {
            pass.fill(d_render, 0);
        }
        self.terms.iter_mut().try_for_each(|term| term.record_step(pass, inputs, d_render, log))
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
    /// The whole view.
    pub const fn whole(size: UVec2) -> Self {
        Self { origin: UVec2::ZERO, size }
    }

    /// One past the last column and row.
    fn end(self) -> UVec2 {
        self.origin + self.size
    }

    /// The number of values in its three channels.
    fn value_count(self) -> u32 {
        value_count(self.size)
    }

    /// Checks that the region is not empty and is inside a view of `size`.
    fn check(self, size: UVec2) -> Result<()> {
        let Self { origin, size: region } = self;
        let fits = region.min_element() > 0
            && region.cmple(size).all()
            && origin.cmple(size.saturating_sub(region)).all();
        if !fits {
            return Err(Error::Usage(format!(
                "a loss region of {} x {} at {}, {} is not inside a view of {} x {}",
                region.x, region.y, origin.x, origin.y, size.x, size.y
            )));
        }
        Ok(())
    }
}

/// The number of values in the three channels of a view.
fn value_count(size: UVec2) -> u32 {
    pixel_count(size).saturating_mul(3)
}

fn pixel_count(size: UVec2) -> u32 {
    size.x.saturating_mul(size.y)
}

fn no_scratch(term: &str, size: UVec2) -> Error {
    let UVec2 { x, y } = size;
    Error::Usage(format!("the {term} has no scratch memory for a view of {x} x {y}"))
}

/// Checks that a weight is finite and not negative.
fn check_weight(of: &str, weight: f64) -> Result<()> {
    if weight.is_finite() && weight >= 0.0 {
        return Ok(());
    }
    Err(Error::Usage(format!("the weight of {of} is {weight}; it must be 0 or more")))
}
