//! Gaussians to splats: the passes of `project` of a view.

use std::collections::BTreeMap;
use std::ops::Range;

use super::buffers::RenderBuffers;
use super::lamp::{self, DeviceLamp};
use super::pipelines::{ProjectionKind, Projections};
use super::{KernelView, RenderSettings, Renderer, color_floats};
use crate::Result;
use crate::gpu::{Gpu, Kernel as _, Recorder, Threads};
use crate::kernels::project;
use crate::splats::batches::Batch;
use crate::splats::device::{DeviceGaussians, GaussianSlice};

/// Invocations of a workgroup of `project`.
pub(super) const GROUP: u32 = project::Kernel::INTERFACE.workgroup_size[0];

/// Gaussians of one buffer, and their splats.
pub(super) struct Projected<'a> {
    pub(super) gaussians: GaussianSlice<'a>,
    pub(super) kind: ProjectionKind,
    pub(super) sh_degree: u32,
    /// Those that are bound: theirs, or those of all instances.
    pub(super) splats: Range<usize>,
    /// In the table of the view; none where they are drawn as they are.
    pub(super) instances: Range<u32>,
}

/// What the passes read and write.
pub(super) struct Projecting<'a> {
    pub(super) gpu: &'a Gpu,
    settings: &'a RenderSettings,
    projections: &'a BTreeMap<ProjectionKind, Projections>,
    frame: &'a mut RenderBuffers,
    lamp: Option<&'a DeviceLamp>,
}

impl Renderer {
    /// The passes of a view, and the Gaussians before those of every view.
    pub(super) fn projecting(&mut self) -> (Projecting<'_>, Option<GaussianSlice<'_>>) {
        let Self { gpu, settings, projections, frame, context, lamp, .. } = self;
        let lamp = lamp.as_ref();
        let context = context.as_ref().map(DeviceGaussians::slice);
        (Projecting { gpu, settings, projections, frame, lamp }, context)
    }

    /// Records the projection of the context, and of the Gaussians of a view, which come after it.
    pub(super) fn record_project(
        &mut self,
        pass: &mut Recorder<'_>,
        gaussians: GaussianSlice<'_>,
        view: &KernelView<'_>,
        sh_degree: u32,
    ) -> Result<()> {
        let (mut projecting, context) = self.projecting();
        let mut first = 0;
        for gaussians in context.into_iter().chain([gaussians]) {
            let splats = first..first + gaussians.layout.count;
            first = splats.end;
            let (kind, instances) = (view.kind, 0..0);
            projecting.record(
                pass,
                view,
                &Projected { gaussians, kind, sh_degree, splats, instances },
            )?;
        }
        Ok(())
    }
}

impl Projecting<'_> {
    /// Records the passes of Gaussians, one for each batch.
    pub(super) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        view: &KernelView<'_>,
        projected: &Projected<'_>,
    ) -> Result<()> {
        projected
            .gaussians
            .layout
            .batches(self.gpu)
            .iter()
            .try_for_each(|batch| self.record_batch(pass, view, projected, batch))
    }

    fn record_batch(
        &mut self,
        pass: &mut Recorder<'_>,
        view: &KernelView<'_>,
        projected: &Projected<'_>,
        batch: Batch,
    ) -> Result<()> {
        let Self { settings, projections, frame, lamp, .. } = self;
        let Projected { gaussians, kind, sh_degree, ref splats, ref instances } = *projected;
        let GaussianSlice { layout, parameters } = gaussians;
        let gaussian_count = batch.gaussian_count();
        let instance_count = instances.len() as u32;
        // Splats of instances are bound for the whole model, others for the batch.
        let (bound, threads) = match instance_count {
            0 => {
                let first = splats.start + batch.first_gaussian() as usize;
                let bound = first..first + gaussian_count as usize;
                (bound, Threads::Exactly([gaussian_count, 1, 1]))
            }
            count => {
                let groups = gaussian_count.div_ceil(GROUP) * count;
                (splats.clone(), Threads::Workgroups([groups, 1, 1]))
            }
        };
        let floats = color_floats(view.channels);
        let first_gaussian = match instance_count {
            0 => bound.start as u32,
            _ => batch.first_gaussian(),
        };
        pass.dispatch(
            &projections[&kind].forward,
            &project::Params {
                camera_index: view.camera_index,
                near: settings.near,
                gaussian_count,
                sh_degree,
                first_gaussian,
                first_instance: instances.start,
                instance_count,
                first_splat: splats.start as u32,
                keeps_order: view.order.is_kept().into(),
                sort_axis: view.order.axis(),
            },
            project::Buffers {
                parameters: batch.rows(parameters, layout.words())?,
                splats: frame.splats.slice_mut().range(bound.clone())?,
                colors: frame.colors.slice_mut().range(floats * bound.start..floats * bound.end)?,
                depth_keys: frame.depth_keys.slice_mut().range(bound.clone())?,
                ids: frame.ids.slice_mut().range(bound.clone())?,
                tile_counts: frame.tile_counts.slice_mut().range(bound)?,
                cameras: view.cameras.unwrap_or(&frame.camera).slice(),
                lamp: lamp::bound(*lamp, parameters)?,
                instances: frame.instances.slice(),
            },
            threads,
        )
    }
}
