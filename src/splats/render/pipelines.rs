//! The kernels of a renderer: those that every view needs at once, others on first use. A program that only draws is
//! linked without those of the backward pass.

use std::collections::BTreeMap;

use nightsplat_core::camera::CameraModel;
use nightsplat_models::gaussians::Shape;

use super::buffers::{RANKS_PER_PARTITION, RenderBuffers, Segments};
use super::lamp::DeviceLamp;
use super::limits::{backward_form, longest_run, splats_per_turn};
use super::{Purpose, RenderSettings, Renderer, Sort};
use crate::gpu::{BackwardForm, Gpu, Pipeline, Sorting, Tile};
use crate::kernels::camera::CAMERA_ORTHOGRAPHIC;
use crate::kernels::splat::MAX_CHANNELS;
use crate::kernels::{
    blend_backward, blend_forward, emit, order_counts, project, project_backward,
};
use crate::splats::batches::{GradientKind, freezes_splats, rest_by_column};
use crate::splats::camera::model_number;
use crate::splats::lamp::Lamp;
use crate::splats::packed_sh::StorageFormat;
use crate::{Error, Result};

impl Renderer {
    /// Builds the kernels; [`Renderer::reserve`] allocates.
    ///
    /// # Errors
    /// The driver refuses a kernel, or the tile does not suit the device.
    pub fn new(gpu: &Gpu, settings: RenderSettings) -> Result<Self> {
        Self::build(gpu, settings, WrittenGradients::ALL)
    }

    /// [`Renderer::new`] with the kernels of its backward pass, which writes such gradients, but not those of the first
    /// `frozen_columns`.
    #[doc(hidden)]
    pub fn with_gradients(
        gpu: &Gpu,
        settings: RenderSettings,
        gradients: GradientKind,
        frozen_columns: u32,
    ) -> Result<Self> {
        let gradients = WrittenGradients { kind: gradients, frozen_columns };
        let mut renderer = Self::build(gpu, settings, gradients)?;
        renderer.build_backward(ProjectionKind::pinhole(&renderer.settings))?;
        Ok(renderer)
    }

    fn build(gpu: &Gpu, settings: RenderSettings, gradients: WrittenGradients) -> Result<Self> {
        let tile = settings.tile_on(gpu)?;
        let segment = backward_form(gpu.properties(), settings.purpose, tile).segment;
        let [tile_width, tile_height] = tile.size;
        let channels = settings.trained_channels() as u32;
        if channels > MAX_CHANNELS {
            let problem = format!(
                "a pixel would have {channels} values, and has {MAX_CHANNELS} at most; train normals without \
                 the denoiser of the paper's variant, or without another part"
            );
            return Err(Error::Usage(problem));
        }
        let (alpha_max, partition_size) = (settings.max_alpha, RANKS_PER_PARTITION);
        let pinhole = ProjectionKind::pinhole(&settings);
        let lamp = settings.lamp.map(|lamp| DeviceLamp::new(gpu, settings.purpose, &lamp));
        let projections = Projections::new(gpu, &settings, tile, pinhole)?;
        let state = tile_width * tile_height * (channels + 1);
        let segments = Segments { length: segment, state };
        let sorting = settings.sorting_on(gpu);
        Ok(Self {
            gpu: gpu.clone(),
            settings,
            gradients,
            tile,
            longest_run: longest_run(gpu),
            projections: BTreeMap::from([(pinhole, projections)]),
            order_counts: gpu.pipeline(&order_counts::Constants { partition_size })?,
            emit: gpu.pipeline(&emit::Constants {
                alpha_max,
                channels,
                tile_width,
                tile_height,
                partition_size,
                sorts_tiles: sorting == Sorting::Tiles,
            })?,
            blend_forward: blending(gpu, &settings, tile, segment, false)?,
            blend_depths: settings
                .keeps_depth()
                .then(|| blending(gpu, &settings, tile, segment, true))
                .transpose()?,
            blend_backward: None,
            sort: Sort::new(gpu, sorting)?,
            frame: RenderBuffers::new(gpu, channels as usize, settings.purpose, segments)?,
            limits: gpu.uninit("limits", 1)?,
            host_targets: None,
            picks: None,
            motion: None,
            context: None,
            lamp: lamp.transpose()?,
        })
    }

    /// Builds the kernels for a camera model where they are not there yet.
    pub(super) fn build_projections(&mut self, kind: ProjectionKind) -> Result<()> {
        if !self.projections.contains_key(&kind) {
            let projections = Projections::new(&self.gpu, &self.settings, self.tile, kind)?;
            self.projections.insert(kind, projections);
        }
        Ok(())
    }

    /// Builds the kernels of the backward pass where such views have one and its kernels are not there yet.
    pub(super) fn build_backward(&mut self, kind: ProjectionKind) -> Result<()> {
        let Self { gpu, settings, gradients, tile, .. } = self;
        if settings.purpose == Purpose::Show || kind.camera_model == CAMERA_ORTHOGRAPHIC {
            return Ok(());
        }
        if self.blend_backward.is_none() {
            self.blend_backward = Some(blending_backward(gpu, settings, *tile, *gradients)?);
        }
        if let Some(Projections { backward: backward @ None, .. }) = self.projections.get_mut(&kind)
        {
            *backward = Some(projection_backward(gpu, settings, *tile, kind, *gradients)?);
        }
        if let Some(lamp) = &mut self.lamp
            && lamp.build_backward(gpu, settings, *tile, gradients.frozen_columns)?
        {
            self.reserve_lamp()?;
        }
        Ok(())
    }

    /// Builds the blending kernel that keeps depths where it is needed and not there yet.
    pub(super) fn build_blending(&mut self, view_depths: bool) -> Result<()> {
        if view_depths && self.blend_depths.is_none() {
            self.blend_depths = Some(blending(&self.gpu, &self.settings, self.tile, 0, true)?);
        }
        Ok(())
    }

    /// Lights the colours with another lamp, or with none.
    #[doc(hidden)]
    pub fn set_lamp(&mut self, lamp: Option<Lamp>) -> Result<()> {
        let settings = RenderSettings { lamp, ..self.settings };
        let new = |lamp| DeviceLamp::new(&self.gpu, settings.purpose, &lamp);
        let on_device = lamp.map(new).transpose()?;
        if lamp.is_some() != self.settings.lamp.is_some() {
            self.projections = self.built_with(&settings)?;
        }
        (self.settings, self.lamp) = (settings, on_device);
        Ok(())
    }

    /// The kernels that read Gaussians, for other settings.
    fn built_with(
        &self,
        settings: &RenderSettings,
    ) -> Result<BTreeMap<ProjectionKind, Projections>> {
        let built = |&kind: &ProjectionKind| {
            Ok((kind, Projections::new(&self.gpu, settings, self.tile, kind)?))
        };
        self.projections.keys().map(built).collect()
    }

    /// Switches to another SH degree.
    #[doc(hidden)]
    pub fn set_sh_degree(&mut self, sh_degree: u32) -> Result<()> {
        if sh_degree == self.settings.shape.sh_degree {
            return Ok(());
        }
        let shape = Shape { sh_degree, ..self.settings.shape };
        let settings = RenderSettings { shape, ..self.settings };
        self.projections = self.built_with(&settings)?;
        #[cfg(feature = "train")]
        self.set_context_degree(sh_degree)?;
        self.settings = settings;
        Ok(())
    }
}

/// What the kernels of a view are specialised for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ProjectionKind {
    /// The number of the camera model in kernels.
    pub(super) camera_model: u32,
    /// Whether the last channel is the depth in the view.
    pub(super) view_depths: bool,
    /// The stored SH degree of instances and its format; one dispatch has several of them. `None`: a model without
    /// transform, as the renderer's settings say.
    pub(super) instances: Option<(u32, StorageFormat)>,
    /// Whether the order of depth is that of several views.
    pub(super) shares_sort: bool,
}

impl ProjectionKind {
    /// Of a pinhole camera and a model without transform, in training.
    fn pinhole(settings: &RenderSettings) -> Self {
        let camera_model = model_number(&CameraModel::Pinhole);
        let view_depths = settings.keeps_depth();
        Self { camera_model, view_depths, instances: None, shares_sort: false }
    }
}

/// The gradients that the backward pass writes.
#[derive(Clone, Copy, Debug)]
pub(super) struct WrittenGradients {
    pub(super) kind: GradientKind,
    /// The columns of the parameters, from the first, whose gradients are not written.
    pub(super) frozen_columns: u32,
}

impl WrittenGradients {
    const ALL: Self = Self { kind: GradientKind::All, frozen_columns: 0 };

    /// The leading channels whose gradients reach the geometry; none if that is frozen.
    fn shaping_channels(self, settings: &RenderSettings) -> u32 {
        if freezes_splats(self.frozen_columns) { 0 } else { settings.shaping_channels() }
    }
}

/// The kernels that read Gaussians and cameras, the only ones that depend on the SH degree and the camera model.
#[derive(Debug)]
pub(super) struct Projections {
    pub(super) forward: Pipeline<project::Kernel>,
    /// Built with the first backward pass.
    pub(super) backward: Option<Pipeline<project_backward::Kernel>>,
}

/// Builds a kernel that projects views, given its other constants.
macro_rules! projection {
    ($kernel:ident, $gpu:expr, $settings:expr, $tile:expr, $kind:expr, { $($extra:ident: $value:expr),* }) => {{
        let (gpu, settings, kind): (&Gpu, &RenderSettings, ProjectionKind) = ($gpu, $settings, $kind);
        let (sh_degree, rest) = kind.instances.unwrap_or((settings.shape.sh_degree, settings.rest));
        gpu.pipeline(&$kernel::Constants {
            channels: settings.channels() as u32 + u32::from(kind.view_depths),
            alpha_max: settings.max_alpha,
            tile_width: $tile.size[0],
            tile_height: $tile.size[1],
            sh_degree,
            raw_colors: settings.raw_colors,
            antialiased: settings.antialiased,
            lamp: settings.lamp.is_some(),
            half_rest: rest == StorageFormat::Half,
            rest_by_column: rest_by_column(gpu),
            camera_model: kind.camera_model,
            view_depths: u32::from(kind.view_depths),
            $($extra: $value,)*
        })
    }};
}

impl Projections {
    fn new(gpu: &Gpu, settings: &RenderSettings, tile: Tile, kind: ProjectionKind) -> Result<Self> {
        let forward = projection!(project, gpu, settings, tile, kind, {
            instances: kind.instances.is_some(),
            shares_sort: kind.shares_sort
        });
        Ok(Self { forward: forward?, backward: None })
    }
}

fn projection_backward(
    gpu: &Gpu,
    settings: &RenderSettings,
    tile: Tile,
    kind: ProjectionKind,
    WrittenGradients { kind: written, frozen_columns }: WrittenGradients,
) -> Result<Pipeline<project_backward::Kernel>> {
    projection!(project_backward, gpu, settings, tile, kind, {
        color_gradients: written == GradientKind::Colors,
        frozen_columns: frozen_columns
    })
}

/// The blending kernel, with or without the depth as the last channel.
fn blending(
    gpu: &Gpu,
    settings: &RenderSettings,
    Tile { size: [tile_width, tile_height], subgroups: subgroups_per_tile, .. }: Tile,
    segment: u32,
    has_depths: bool,
) -> Result<Pipeline<blend_forward::Kernel>> {
    let view_depths = u32::from(has_depths);
    gpu.pipeline(&blend_forward::Constants {
        alpha_max: settings.max_alpha,
        channels: settings.channels() as u32 + view_depths,
        tile_width,
        tile_height,
        skips_groups: !gpu.properties().is_cpu,
        splats_per_turn: splats_per_turn(gpu),
        subgroups_per_tile,
        view_depths,
        segment,
    })
}

fn blending_backward(
    gpu: &Gpu,
    settings: &RenderSettings,
    tile: Tile,
    gradients: WrittenGradients,
) -> Result<Pipeline<blend_backward::Kernel>> {
    let Tile { size: [tile_width, tile_height], subgroups: subgroups_per_tile, .. } = tile;
    let BackwardForm { segment, sums } = backward_form(gpu.properties(), settings.purpose, tile);
    gpu.pipeline(&blend_backward::Constants {
        alpha_max: settings.max_alpha,
        channels: settings.trained_channels() as u32,
        tile_width,
        tile_height,
        shaping_channels: gradients.shaping_channels(settings),
        view_depths: settings.keeps_depth().into(),
        skips_groups: !gpu.properties().is_cpu,
        splats_per_turn: splats_per_turn(gpu),
        sums_in_shared_memory: sums as u32,
        subgroups_per_tile,
        segment,
    })
}
