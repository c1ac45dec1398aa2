//! The differentiable rasteriser: Gaussians and a camera to a render, and the gradient of the render to theirs.
//!
//! ```text
//! project -> sort by depth -> order_counts -> emit -> sort by tile -> blend_forward         as a whole
//! project -> order_counts -> emit -> places in tiles -> sort of each tile -> blend_forward    tile by tile
//!     -> [loss] -> blend_backward -> project_backward
//! ```
//!
//! Counts stay on the device. If the intersections of a view exceed the reserved memory, a status flag is set, nothing
//! is rendered or updated, and the host grows the buffers and repeats the step ([`Renderer::grow`]).

mod bins;
mod buffers;
mod cameras;
mod capacity;
#[cfg(feature = "train")]
mod context;
#[cfg(feature = "train")]
mod depths;
mod draw;
mod eyes;
#[cfg(feature = "train")]
mod gradients;
mod images;
mod instances;
#[cfg(feature = "train")]
mod kept;
mod lamp;
mod limits;
mod lists;
mod motion;
mod picks;
mod pipelines;
mod projection;
mod settings;
mod target;

use crate::splats::camera::model_number;
use std::collections::BTreeMap;

use glam::{UVec2, Vec2};

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Statistic, Threads, Tile};
use crate::kernels::blend_forward::{DEPTH_MEAN, DEPTH_SUM};
use crate::kernels::{self, blend_backward, blend_forward, emit, order_counts, project_backward};
use crate::splats::batches::GradientKind;
use crate::splats::device::{DeviceGaussians, GaussianSlice, Layout};
use crate::{Error, Result};

use bins::Sort;
pub use buffers::RenderBuffers;
pub use buffers::Status;
use buffers::color_floats;
pub use cameras::{Viewpoint, Viewpoints};
pub use draw::Drawn;
use draw::HostTargets;
use eyes::DepthOrder;
#[cfg(feature = "train")]
pub(crate) use gradients::ViewGradients;
pub use instances::Instance;
pub(crate) use lamp::DeviceLamp;
use lists::Lists;
use motion::MotionVectors;
use picks::Picks;
pub use picks::{Pick, PickedSplat};
use pipelines::{ProjectionKind, Projections, WrittenGradients};
pub use settings::{Purpose, RenderSettings};
pub use target::{DepthConvention, DepthKind, Motion, SceneDepth, Target};

/// Parameters of one render.
#[derive(Clone, Copy, Debug)]
pub struct RenderOptions {
    /// The SH degree in use, at most the stored one.
    pub sh_degree: u32,
    /// Background colour, RGB; features have background 0.
    pub background: [f32; 3],
}

/// The norm of a Gaussian's screen-space gradient that density control adds up, in normalised device units.
#[derive(Clone, Copy, Debug)]
pub struct GradientNorm {
    /// The sum of the norms of all pixels, to which fine texture adds (Ye et al. 2024, `AbsGS`); otherwise the norm of
    /// their sum, in which it cancels (Kerbl et al. 2023, section 5.2).
    pub adds_pixels: bool,
    /// How much of it is damped near the camera, 0 to 1.
    pub damping_weight: f32,
    /// Depth from which nothing is damped, in world units.
    pub damping_depth: f32,
}

impl Default for GradientNorm {
    /// Of the sum over all pixels, undamped.
    fn default() -> Self {
        Self { adds_pixels: false, damping_weight: 0.0, damping_depth: 1.0 }
    }
}

/// Outputs of the backward pass, for all Gaussians.
#[derive(Debug)]
pub struct Gradients<'a> {
    /// (columns x Gaussians): the gradients of the parameters, all of them unless the renderer is made for Adam.
    pub parameters: &'a mut Buffer<f32>,
    /// (Gaussians): sums of [`GradientNorm`]s.
    pub grad_norm_sums: &'a mut Buffer<f32>,
    /// (Gaussians): the number of steps in which each was visible.
    pub visit_counts: &'a mut Buffer<u32>,
}

/// Renders Gaussians, forward and backward. Owns the memory of one view.
#[derive(Debug)]
pub struct Renderer {
    gpu: Gpu,
    settings: RenderSettings,
    gradients: WrittenGradients,
    tile: Tile,
    /// The most splats of one tile that the blending kernels can process.
    longest_run: u32,
    /// By camera model and whether the last channel is the depth; those of the pinhole without depth are built at once,
    /// others on first use.
    projections: BTreeMap<ProjectionKind, Projections>,
    order_counts: Pipeline<order_counts::Kernel>,
    emit: Pipeline<emit::Kernel>,
    blend_forward: Pipeline<blend_forward::Kernel>,
    /// With the depth as the last channel; built on first use.
    blend_depths: Option<Pipeline<blend_forward::Kernel>>,
    /// Built with the first backward pass.
    blend_backward: Option<Pipeline<blend_backward::Kernel>>,
    sort: Sort,
    frame: RenderBuffers,
    /// Rendered before those of every view, and without gradients.
    context: Option<DeviceGaussians>,
    /// (H, W): the depths beyond which nothing is seen, where a draw has such.
    limits: Buffer<f32>,
    host_targets: Option<HostTargets>,
    picks: Option<Picks>,
    motion: Option<MotionVectors>,
    /// Lights the colours.
    lamp: Option<DeviceLamp>,
}

/// How the last channel of a render keeps the depth in the view.
#[derive(Clone, Copy, Debug)]
struct DepthChannel {
    /// `DEPTH_*`.
    kind: u32,
    /// Nothing beyond the limits is seen.
    has_limits: bool,
}

/// The depth that has a gradient.
const TRAINED_DEPTH: DepthChannel = DepthChannel { kind: DEPTH_MEAN, has_limits: false };

impl Renderer {
    /// The number of intersections of the last render; waits for it.
    #[doc(hidden)]
    pub fn intersections(&self) -> Result<u32> {
        Ok(self.gpu.read(&self.frame.lists.counts)?[0])
    }

    /// The settings that it was made with.
    pub(crate) fn settings(&self) -> &RenderSettings {
        &self.settings
    }

    /// The last render, planar (channels, H, W): RGB, then the features, then the mean depth if that is trained.
    pub fn render(&self) -> &Buffer<f32> {
        &self.frame.render
    }

    /// The transmittance of the last render, (H, W): 1 where there is no splat.
    pub fn transmittances(&self) -> &Buffer<f32> {
        &self.frame.transmittances
    }

    /// The driver's statistics of the blending kernels, forward and backward; empty where it has none.
    pub(crate) fn blend_statistics(&self) -> Result<Option<[Vec<Statistic>; 2]>> {
        let forward = self.blend_forward.statistics(&self.gpu)?;
        let backward = match &self.blend_backward {
            Some(backward) => backward.statistics(&self.gpu)?,
            None => None,
        };
        Ok(forward.zip(backward).map(<[_; 2]>::from))
    }

    /// The intermediate buffers of the last render.
    #[doc(hidden)]
    pub fn frame(&self) -> &RenderBuffers {
        &self.frame
    }

    /// The status words: see [`Status`]. Kernels that change parameters do nothing while the first is nonzero.
    pub fn status(&self) -> &Buffer<u32> {
        &self.frame.status
    }

    /// The last render, its transmittances and the status words, for a loss that reads the former and sets flags in the
    /// latter.
    #[doc(hidden)]
    pub fn render_and_status(&mut self) -> (&Buffer<f32>, &Buffer<f32>, &mut Buffer<u32>) {
        (&self.frame.render, &self.frame.transmittances, &mut self.frame.status)
    }

    /// The error for a view whose [`Status::splats_per_tile`] exceeds the limit.
    pub(crate) fn too_many_splats(&self, view: String, splats: u32) -> Error {
        let [width, height] = self.tile.size;
        let (tile, device) = (format!("{width}x{height}"), self.gpu.properties().name.clone());
        Error::TileLimit { view, splats, tile, device, limit: self.longest_run }
    }

    /// What the backward pass writes.
    pub(crate) fn gradient_kind(&self) -> GradientKind {
        self.gradients.kind
    }

    /// The camera of a recorded viewpoint: its buffer and index.
    pub(crate) fn camera_of<'a>(
        &'a self,
        viewpoint: &Viewpoint<'a>,
    ) -> (&'a Buffer<kernels::Camera>, u32) {
        viewpoint.on_device.unwrap_or((&self.frame.camera, 0))
    }

    /// Clears all status flags.
    pub fn clear_status(&mut self, pass: &mut Recorder<'_>) {
        pass.fill(&mut self.frame.status, 0);
    }

    /// Records the render of `gaussians` from a camera, or a patch of it. The first view of a camera model builds its
    /// kernels.
    ///
    /// # Errors
    /// The Gaussians are of another shape than the settings say; they or the image exceed what was reserved; a pass
    /// exceeds what the device can launch; or the driver refuses a kernel.
    pub fn forward<'a>(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussians: impl Into<GaussianSlice<'a>>,
        viewpoint: impl Into<Viewpoint<'a>>,
        options: &RenderOptions,
    ) -> Result<()> {
        let depths = self.settings.keeps_depth().then_some(TRAINED_DEPTH);
        self.record_forward(pass, gaussians.into(), viewpoint, options, depths)
    }

    /// Records a render. `depths`: the last channel is the depth in the view.
    fn record_forward<'a>(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussians: GaussianSlice<'_>,
        viewpoint: impl Into<Viewpoint<'a>>,
        options: &RenderOptions,
        depths: Option<DepthChannel>,
    ) -> Result<()> {
        let viewpoint = viewpoint.into();
        self.check(&gaussians.layout)?;
        let view = self.view(&viewpoint, depths.is_some(), DepthOrder::Own)?;
        let gaussian_count = (self.context_count() + gaussians.layout.count) as u32;
        if viewpoint.on_device.is_none() {
            pass.update(&mut self.frame.camera, &[(&viewpoint.patch).into()])?;
        }
        self.record_project(pass, gaussians, &view, options.sh_degree)?;
        self.record_splats(pass, gaussian_count, &view, options, depths, None)
    }

    /// Records what follows the projection of the Gaussians of a view. `capacity`: intersections beyond it are left
    /// out, the farthest first; without it they are an overflow.
    fn record_splats(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussian_count: u32,
        view: &KernelView<'_>,
        options: &RenderOptions,
        depths: Option<DepthChannel>,
        capacity: Option<u32>,
    ) -> Result<()> {
        if view.lists.is_none() {
            pass.fill(&mut self.frame.gaussian_counts, gaussian_count);
            self.record_bins(pass, gaussian_count, view, capacity)?;
        }
        let frame = &mut self.frame;
        let lists = view.lists.unwrap_or(&frame.lists);
        let with_depths = self.blend_depths.as_ref().filter(|_| depths.is_some());
        pass.dispatch(
            with_depths.unwrap_or(&self.blend_forward),
            &blend_forward::Params {
                size: view.size,
                tile_columns: view.tiles.x,
                longest_run: self.longest_run,
                has_limits: depths.is_some_and(|depths| depths.has_limits).into(),
                depth_kind: depths.map_or(DEPTH_SUM, |depths| depths.kind),
                background: options.background,
            },
            blend_forward::Buffers {
                counts: lists.counts.slice(),
                sorted_intersections: lists.intersection_ids.slice(),
                gaussian_ids: lists.gaussian_ids.slice(),
                splats: frame.splats.slice(),
                colors: frame.colors.slice(),
                render: frame.render.slice_mut(),
                transmittances: frame.transmittances.slice_mut(),
                sorted_tiles: lists.tiles.slice(),
                tile_ranges: frame.tile_ranges.slice_mut(),
                status: frame.status.slice_mut(),
                limits: self.limits.slice(),
                segment_states: frame.segment_states.slice_mut(),
            },
            Threads::Workgroups([view.tile_count(), 1, 1]),
        )
    }

    /// Records the gradients of the Gaussians, given `d_render` (channels, H, W), the gradient of the last recorded
    /// render, which must be of the same viewpoint. The first of a camera model builds its kernels.
    ///
    /// # Errors
    /// The Gaussians are of another shape than the settings say, the renderer was made to show, or a pass exceeds what
    /// the device can launch.
    #[expect(clippy::too_many_arguments, reason = "what the forward pass takes, and its gradient")]
    pub fn backward<'a>(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussians: impl Into<GaussianSlice<'a>>,
        viewpoint: impl Into<Viewpoint<'a>>,
        options: &RenderOptions,
        norm: GradientNorm,
        d_render: &Buffer<f32>,
        gradients: Gradients<'_>,
    ) -> Result<()> {
        let keeps_depth = self.settings.keeps_depth();
        let view = self.view(&viewpoint.into(), keeps_depth, DepthOrder::Own)?;
        let gaussians = gaussians.into();
        self.check(&gaussians.layout)?;
        self.build_backward(view.kind)?;
        let project_backward = self.projections[&view.kind].backward.as_ref();
        let (Some(blend_backward), Some(project_backward)) =
            (&self.blend_backward, project_backward)
        else {
            let problem = match self.settings.purpose {
                Purpose::Show => {
                    "a renderer with Purpose::Show has no gradients; make it with Purpose::Train"
                }
                Purpose::Train => "an orthographic camera has no gradients; take another camera",
            };
            return Err(Error::Usage(problem.to_owned()));
        };
        let color_floats = color_floats(view.channels);
        let first = self.context_count();
        let (frame, tile_count) = (&mut self.frame, view.tile_count());
        let lists = view.lists.unwrap_or(&frame.lists);
        let further_segments = frame.segments.blocks(lists.tiles.len() as u32);
        pass.dispatch(
            blend_backward,
            &blend_backward::Params { size: view.size, tile_columns: view.tiles.x, tile_count },
            blend_backward::Buffers {
                tile_ranges: frame.tile_ranges.slice(),
                sorted_intersections: lists.intersection_ids.slice(),
                gaussian_ids: lists.gaussian_ids.slice(),
                splats: frame.splats.slice(),
                colors: frame.colors.slice(),
                render: frame.render.slice(),
                d_render: d_render.slice(),
                gradient_records: frame.gradient_records.slice_mut(),
                counts: lists.counts.slice(),
                sorted_tiles: lists.tiles.slice(),
                segment_states: frame.segment_states.slice(),
            },
            Threads::Workgroups([tile_count.saturating_add(further_segments), 1, 1]),
        )?;
        let GaussianSlice { layout, parameters } = gaussians;
        for batch in layout.batches(&self.gpu).without(self.gradients.frozen_columns).iter() {
            let (gaussian_count, rendered) = (batch.gaussian_count(), batch.after(first));
            pass.dispatch(
                project_backward,
                &project_backward::Params {
                    camera_index: view.camera_index,
                    half_view: view.half_view,
                    gaussian_count,
                    sh_degree: options.sh_degree,
                    adds_pixels: norm.adds_pixels.into(),
                    damping_weight: norm.damping_weight,
                    damping_depth: norm.damping_depth,
                },
                project_backward::Buffers {
                    parameters: batch.rows(parameters, layout.words())?,
                    splats: rendered.rows(&frame.splats, 1)?,
                    colors: rendered.rows(&frame.colors, color_floats)?,
                    tile_counts: rendered.rows(&frame.tile_counts, 1)?,
                    intersection_ranges: rendered.rows(&lists.intersection_ranges, 1)?,
                    gradient_records: frame.gradient_records.slice(),
                    status: frame.status.slice_mut(),
                    gradients: batch.planes_mut(&mut *gradients.parameters)?,
                    grad_norm_sums: batch.rows_mut(&mut *gradients.grad_norm_sums, 1)?,
                    visit_counts: batch.rows_mut(&mut *gradients.visit_counts, 1)?,
                    cameras: view.cameras.unwrap_or(&frame.camera).slice(),
                    lamp: lamp::bound(self.lamp.as_ref(), parameters)?,
                },
                Threads::Exactly([gaussian_count, 1, 1]),
            )?;
        }
        self.record_lamp_backward(pass, gaussians, &view, gradients.parameters)
    }

    /// Refuses Gaussians in another layout than the kernels read, or more than there is memory for.
    fn check(&self, layout: &Layout) -> Result<()> {
        self.check_layout(layout)?;
        let (count, reserved) = (self.context_count() + layout.count, self.frame.splats.len());
        if count > reserved {
            let problem = format!(
                "{count} Gaussians exceed the {reserved} that the renderer has; call `Renderer::reserve`"
            );
            return Err(Error::Usage(problem));
        }
        Ok(())
    }

    /// Refuses Gaussians in another layout than the kernels read.
    fn check_layout(&self, layout: &Layout) -> Result<()> {
        let RenderSettings { shape, rest, .. } = self.settings;
        let problem = if layout.shape != shape {
            let [given, made_for] = [layout.shape, shape];
            format!("Gaussians of {given} cannot be rendered by a renderer made for {made_for}")
        } else if layout.sh_rest != rest {
            let [given, made_for] = [layout.sh_rest, rest];
            format!(
                "Gaussians with SH coefficients as {given:?} cannot be rendered by a renderer made for {made_for:?}"
            )
        } else {
            return Ok(());
        };
        Err(Error::Usage(problem))
    }

    /// The number of Gaussians that precede those of a view.
    fn context_count(&self) -> usize {
        self.context.as_ref().map_or(0, |context| context.layout.count)
    }

    /// Columns and rows of tiles.
    fn tiles(&self, size: UVec2) -> UVec2 {
        let tile = UVec2::from(self.tile.size);
        size.saturating_add(tile - 1) / tile
    }

    fn view<'a>(
        &mut self,
        viewpoint: &Viewpoint<'a>,
        view_depths: bool,
        order: DepthOrder,
    ) -> Result<KernelView<'a>> {
        let &Viewpoint { ref patch, on_device, lists } = viewpoint;
        let tiles = self.tiles(patch.size);
        let channels = self.settings.channels() + usize::from(view_depths);
        if channels * patch.pixel_count() > self.frame.render.len()
            || (tiles.x * tiles.y) as usize > self.frame.tile_ranges.len()
        {
            let UVec2 { x: width, y: height } = patch.size;
            let what = format!(
                "a {width}x{height} image exceeds what the renderer has; call `Renderer::reserve`"
            );
            return Err(Error::Usage(what));
        }
        let camera_model = model_number(&patch.camera.model);
        let shares_sort = order.is_shared();
        let kind = ProjectionKind { camera_model, view_depths, instances: None, shares_sort };
        self.build_projections(kind)?;
        let (cameras, camera_index) = on_device.unzip();
        let camera_index = camera_index.unwrap_or_default();
        let (size, half_view) = (patch.size, patch.half_view());
        Ok(KernelView {
            kind,
            order,
            channels,
            cameras,
            camera_index,
            size,
            half_view,
            tiles,
            lists,
        })
    }
}

/// A viewpoint as the kernels take it, and the columns and rows of tiles of its image.
struct KernelView<'a> {
    kind: ProjectionKind,
    order: DepthOrder,
    /// Values per pixel.
    channels: usize,
    /// `None`: the renderer's own.
    cameras: Option<&'a Buffer<kernels::Camera>>,
    camera_index: u32,
    size: UVec2,
    half_view: Vec2,
    tiles: UVec2,
    /// Its sorted intersections; `None`: they are sorted into the renderer's.
    lists: Option<&'a Lists>,
}

impl KernelView<'_> {
    fn tile_count(&self) -> u32 {
        self.tiles.x * self.tiles.y
    }
}
