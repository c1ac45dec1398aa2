//! The kernels of a renderer: those that every view needs at once, others on first use.

use std::collections::BTreeMap;

use nightsplat_core::camera::CameraModel;

use super::buffers::{RANKS_PER_PARTITION, RenderBuffers, Segments};
use super::lamp::DeviceLamp;
use super::limits::{longest_run, segment_length, splats_per_turn, sums_in_shared_memory};
use super::{Purpose, RenderSettings, Renderer, Sort};
use crate::Result;
use crate::gpu::{Gpu, Pipeline, Sorting, Tile};
use crate::kernels::camera::CAMERA_ORTHOGRAPHIC;
use crate::kernels::{
    blend_backward, blend_forward, emit, order_counts, project, project_backward,
};
use crate::splats::batches::{GradientKind, rest_by_column};
use crate::splats::camera::model_number;
use crate::splats::lamp::Lamp;
use crate::splats::packed_sh::StorageFormat;
use crate::splats::scene::Shape;

impl Renderer {
    /// Builds the kernels; [`Renderer::reserve`] allocates.
    ///
    /// # Errors
    /// The driver refuses a kernel, or the tile does not suit the device.
    pub fn new(gpu: &Gpu, settings: RenderSettings) -> Result<Self> {
        Self::with_gradients(gpu, settings, GradientKind::All, 0)
    }

    /// [`Renderer::new`] whose backward pass writes such gradients, but not those of the first `frozen_columns`.
    #[doc(hidden)]
    pub fn with_gradients(
        gpu: &Gpu,
        settings: RenderSettings,
        gradients: GradientKind,
        frozen_columns: u32,
    ) -> Result<Self> {
        let tile = settings.tile_on(gpu)?;
        let segment = segment_length(gpu.properties(), settings.purpose, tile);
        let gradients = WrittenGradients { kind: gradients, frozen_columns };
        Self::build(gpu, settings, gradients, tile, segment)
    }

    /// [`Renderer::new`] with segments of `segment` splats, a multiple of the subgroup size; 0: a run has one segment.
    #[doc(hidden)]
    pub fn with_segments(gpu: &Gpu, settings: RenderSettings, segment: u32) -> Result<Self> {
        let gradients = WrittenGradients { kind: GradientKind::All, frozen_columns: 0 };
        Self::build(gpu, settings, gradients, settings.tile_on(gpu)?, segment)
    }

    fn build(
        gpu: &Gpu,
        settings: RenderSettings,
        gradients: WrittenGradients,
        tile: Tile,
        segment: u32,
    ) -> Result<Self> {
        let Tile { size: [tile_width, tile_height], subgroups: subgroups_per_tile } = tile;
        let channels = settings.channels() as u32;
        let (alpha_max, partition_size) = (settings.max_alpha, RANKS_PER_PARTITION);
        let pinhole = ProjectionKind {
            camera_model: model_number(&CameraModel::Pinhole),
            view_depths: false,
            instances: None,
            shares_sort: false,
        };
        let frozen_columns = gradients.frozen_columns;
        let lamp = settings.lamp;
        let lamp = lamp.map(|lamp| DeviceLamp::new(gpu, &settings, tile, frozen_columns, &lamp));
        let projections = Projections::new(gpu, &settings, tile.size, pinhole, gradients)?;
        let shaping_channels = settings.shaping_channels();
        let (skips_groups, splats_per_turn) = (!gpu.properties().is_cpu, splats_per_turn(gpu));
        let blend_backward = match settings.purpose {
            Purpose::Show => None,
            Purpose::Train => Some(gpu.pipeline(&blend_backward::Constants {
                alpha_max,
                channels,
                tile_width,
                tile_height,
                shaping_channels,
                skips_groups,
                splats_per_turn,
                sums_in_shared_memory: sums_in_shared_memory(gpu.properties()),
                subgroups_per_tile,
                segment,
            })?),
        };
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
            blend_depths: None,
            blend_backward,
            sort: Sort::new(gpu, sorting)?,
            frame: RenderBuffers::new(gpu, settings.channels(), settings.purpose, segments)?,
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
            let Self { gpu, settings, tile, gradients, .. } = self;
            let projections = Projections::new(gpu, settings, tile.size, kind, *gradients)?;
            self.projections.insert(kind, projections);
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
        let frozen_columns = self.gradients.frozen_columns;
        let new = |lamp| DeviceLamp::new(&self.gpu, &settings, self.tile, frozen_columns, &lamp);
        let on_device = lamp.map(new).transpose()?;
        if lamp.is_some() != self.settings.lamp.is_some() {
            self.projections = self.built_with(&settings)?;
        }
        (self.settings, self.lamp) = (settings, on_device);
        self.reserve_lamp()
    }

    /// The kernels that read Gaussians, for other settings.
    fn built_with(
        &self,
        settings: &RenderSettings,
    ) -> Result<BTreeMap<ProjectionKind, Projections>> {
        let Self { gpu, tile, gradients, .. } = self;
        let built = |&kind: &ProjectionKind| {
            Ok((kind, Projections::new(gpu, settings, tile.size, kind, *gradients)?))
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

/// The gradients that the backward pass writes.
#[derive(Clone, Copy, Debug)]
pub(super) struct WrittenGradients {
    pub(super) kind: GradientKind,
    /// The columns of the parameters, from the first, whose gradients are not written.
    pub(super) frozen_columns: u32,
}

/// The kernels that read Gaussians and cameras, the only ones that depend on the SH degree and the camera model.
#[derive(Debug)]
pub(super) struct Projections {
    pub(super) forward: Pipeline<project::Kernel>,
    /// Absent where the purpose is to show, of an orthographic camera, and with depths.
    pub(super) backward: Option<Pipeline<project_backward::Kernel>>,
}

impl Projections {
    fn new(
        gpu: &Gpu,
        settings: &RenderSettings,
        [tile_width, tile_height]: [u32; 2],
        ProjectionKind { camera_model, view_depths: has_depths, instances, shares_sort }: ProjectionKind,
        WrittenGradients { kind, frozen_columns }: WrittenGradients,
    ) -> Result<Self> {
        let color_gradients = kind == GradientKind::Colors;
        let (view_depths, alpha_max) = (u32::from(has_depths), settings.max_alpha);
        let channels = settings.channels() as u32 + view_depths;
        let RenderSettings { raw_colors, antialiased, .. } = *settings;
        let (sh_degree, rest) = instances.unwrap_or((settings.shape.sh_degree, settings.rest));
        let (lamp, is_instanced) = (settings.lamp.is_some(), instances.is_some());
        let half_rest = rest == StorageFormat::Half;
        let rest_by_column = rest_by_column(gpu);
        macro_rules! pipeline {
            ($kernel:ident $(, $extra:ident)*) => {
                gpu.pipeline(&$kernel::Constants {
                    channels,
                    alpha_max,
                    tile_width,
                    tile_height,
                    sh_degree,
                    raw_colors,
                    antialiased,
                    lamp,
                    half_rest,
                    rest_by_column,
                    camera_model,
                    $($extra,)*
                })?
            };
        }
        let is_shown = has_depths || is_instanced || shares_sort;
        let is_trained_on = camera_model != CAMERA_ORTHOGRAPHIC && !is_shown;
        let has_gradients = settings.purpose == Purpose::Train && is_trained_on;
        let backward = if has_gradients {
            Some(pipeline!(project_backward, color_gradients, frozen_columns))
        } else {
            None
        };
        let instances = is_instanced;
        Ok(Self { forward: pipeline!(project, view_depths, instances, shares_sort), backward })
    }
}

/// The blending kernel, with or without the depth as the last channel.
fn blending(
    gpu: &Gpu,
    settings: &RenderSettings,
    Tile { size: [tile_width, tile_height], subgroups: subgroups_per_tile }: Tile,
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
