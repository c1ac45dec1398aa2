//! The model in training: its Gaussians, and what renders, optimizes and grows them.

use nightsplat_core::camera::Camera;

use super::gaussians::TrainedGaussians;
use super::lamp::LampLearning;
use super::networks::Networks;
use super::rendered::Rendered;
use super::target_views::TargetViews;
use super::views::{TrainView, Views};
use crate::Result;
use crate::gpu::Gpu;
use crate::splats::densify::Densifier;
use crate::splats::optimizer::{Adam, FiniteCheck};
use crate::splats::render::{RenderOptions, Renderer};
use crate::splats::smoothing::SmoothingFloor;

/// A tensor of a checkpoint: name, shape and values.
pub(super) type Tensor = (String, Vec<usize>, Vec<f32>);

/// The learned parameters, without optimizer state, as tensors of a checkpoint.
pub(super) type Snapshot = Vec<Tensor>;

/// How many times more intersections per Gaussian a view may have than the last one.
pub(super) const MARGIN: f64 = 2.0;

/// Gaussians with their renderer, optimizer and density control.
#[derive(Debug)]
pub(super) struct TrainedModel {
    pub(super) gaussians: TrainedGaussians,
    pub(super) renderer: Renderer,
    pub(super) optimizer: Optimizer,
    pub(super) density: Density,
    /// The parameters with the best score of the held-out views; empty without one.
    pub(super) best: Snapshot,
}

/// The optimizer and the check of the parameters.
#[derive(Debug)]
pub(super) struct Optimizer {
    pub(super) adam: Adam,
    pub(super) finite: FiniteCheck,
    /// `None`: off.
    pub(super) floor: Option<SmoothingFloor>,
    /// `None`: off.
    pub(super) lamp: Option<LampLearning>,
    /// The step of the last check of the parameters.
    pub(super) checked: u64,
}

/// Density control and what limits it.
#[derive(Debug)]
pub(super) struct Density {
    pub(super) densifier: Densifier,
    /// Training views on which the cost of a round is measured; empty if it is not.
    pub(super) probes: TargetViews,
    /// Whether the end of growth for lack of capacity was logged.
    pub(super) has_logged_capacity: bool,
}

impl TrainedModel {
    /// The number of Gaussians.
    pub(super) fn count(&self) -> usize {
        self.gaussians.count()
    }

    /// Reserves the renderer's memory for every view.
    pub(super) fn reserve(&mut self, views: &Views) -> Result<()> {
        let sizes = views.all().iter().map(TrainView::size);
        self.renderer.reserve_sizes(self.gaussians.count(), self.gaussians.capacity(), sizes)
    }

    /// Changes the SH degree of Gaussians and renderer.
    pub(super) fn set_sh_degree(&mut self, gpu: &Gpu, degree: u32) -> Result<()> {
        self.gaussians.set_sh_degree(gpu, degree)?;
        self.renderer.set_sh_degree(degree)
    }

    /// Renders from a camera in the training frame, over a black background.
    pub(super) fn render(
        &mut self,
        camera: &Camera,
        sh_degree: u32,
        networks: Option<&mut Networks>,
    ) -> Result<Rendered> {
        let options = RenderOptions { sh_degree, background: [0.0; 3] };
        Rendered::new(&mut self.renderer, &self.gaussians.values, camera, &options, networks)
    }

    /// The index of the first parameter that is not finite, in the planes of all Gaussians.
    pub(super) fn first_not_finite(&mut self, gpu: &Gpu) -> Result<Option<usize>> {
        self.gaussians.first_not_finite(gpu, &mut self.optimizer.finite)
    }
}
