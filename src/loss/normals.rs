//! The term of normals: those of the rendered depth against those of a normal map.
//!
//! weight(step) * mean over the map of 1 - n g. The weight falls linearly to 0 at the last step: estimated normals are
//! right in the large, and lack detail.

use std::sync::Arc;

use nightsplat_models::gaussians::COLOR_CHANNELS;

use super::log::{LogSlot, PartialSums};
use super::{
    LossSpec, LossTerm, Term, TermInputs, TermOn, ViewSource, check_weight, no_scratch, pixel_count,
};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::map_normal::NO_NORMAL;
use crate::kernels::{Camera, normals, normals_backward};

pub(super) const SPEC: LossSpec = LossSpec {
    terms: &[Term::NORMALS],
    on: TermOn::ViewDepth(|gpu, config| {
        Ok(Box::new(NormalLoss::new(gpu, config.weights.normals, config.steps)?))
    }),
};

impl Term {
    /// Mean 1 - cosine of rendered and given normals.
    pub const NORMALS: Self = Self::distance("normals", "normals", |config| config.weights.normals);
}

/// Floats of the gradients of a pixel's two differences, each filled up to four.
const DIFFERENCE_FLOATS: usize = 8;

/// weight * (1 - (step - 1) / steps) * mean (1 - n g).
#[derive(Debug)]
pub struct NormalLoss {
    gpu: Gpu,
    weight: f64,
    steps: u64,
    loss: Pipeline<normals::Kernel>,
    backward: Pipeline<normals_backward::Kernel>,
    values_per_workgroup: u32,
    d_differences: Buffer<f32>,
    partials: Buffer<f32>,
    /// Of every view that has a normal map.
    maps: Vec<Option<Arc<NormalTarget>>>,
}

/// The normal map of a view, on the device.
#[derive(Debug)]
struct NormalTarget {
    camera: Camera,
    /// (H, W), as in `include/map_normal.glsl`.
    normals: Buffer<u32>,
    /// The pixels that have a normal.
    count: u32,
}

impl NormalLoss {
    /// Builds the kernels; [`NormalLoss::add`] and [`LossTerm::prepare`] add views. The weight is 0 after `steps`.
    pub fn new(gpu: &Gpu, weight: f64, steps: u64) -> Result<Self> {
        check_weight("the normals", weight)?;
        let constants = normals::Constants::default();
        Ok(Self {
            gpu: gpu.clone(),
            weight,
            steps,
            loss: gpu.pipeline(&constants)?,
            backward: gpu.pipeline(&normals_backward::Constants {})?,
            values_per_workgroup: gpu.properties().subgroup_size * constants.values_per_thread,
            d_differences: gpu.uninit("d_differences", 0)?,
            partials: gpu.uninit("normal_partials", 0)?,
            maps: vec![],
        })
    }

    /// Adds a view by its pinhole camera and its normals, (H, W), and allocates scratch memory for it.
    pub fn add(&mut self, camera: Camera, normals: Option<&[u32]>) -> Result<()> {
        let count_of = |normals: &[u32]| normals.iter().filter(|&&it| it != NO_NORMAL).count();
        let counted = normals.map(|normals| (normals, count_of(normals) as u32));
        let Some((normals, count)) = counted.filter(|&(_, count)| count > 0) else {
            self.maps.push(None);
            return Ok(());
        };
        let pixels = pixel_count(camera.size);
        self.d_differences.grow(&self.gpu, DIFFERENCE_FLOATS * pixels as usize)?;
        self.partials.grow(&self.gpu, pixels.div_ceil(self.values_per_workgroup) as usize)?;
        let normals = self.gpu.buffer("normals", normals)?;
        self.maps.push(Some(Arc::new(NormalTarget { camera, normals, count })));
        Ok(())
    }

    /// The weight of a step, counted from 1.
    fn weight_at(&self, step: u64) -> f64 {
        let left = self.steps.saturating_sub(step.saturating_sub(1));
        self.weight * left as f64 / self.steps.max(1) as f64
    }
}

impl LossTerm for NormalLoss {
    fn prepare(&mut self, views: &[ViewSource<'_>]) -> Result<()> {
        views.iter().try_for_each(|view| self.add(view.camera, view.normals))
    }

    fn record_step(
        &mut self,
        pass: &mut Recorder<'_>,
        inputs: &TermInputs<'_>,
        d_render: &mut Buffer<f32>,
        log: &mut LogSlot<'_>,
    ) -> Result<()> {
        let &TermInputs { size, render, transmittances, view, step, features, .. } = inputs;
        let Some(Some(map)) = self.maps.get(view).cloned() else { return Ok(()) };
        let Camera { focal, principal_point, .. } = map.camera;
        let pixels = pixel_count(size);
        let workgroups = pixels.div_ceil(self.values_per_workgroup);
        if pixels == 0
            || workgroups as usize > self.partials.len()
            || DIFFERENCE_FLOATS * pixels as usize > self.d_differences.len()
        {
            return Err(no_scratch("term of normals", size));
        }
        let first = (COLOR_CHANNELS + features.width()) as u32 * pixels;
        map.normals.check_len(pixels as usize)?;
        transmittances.check_len(pixels as usize)?;
        for buffer in [render, &*d_render] {
            buffer.check_len((first + pixels) as usize)?;
        }
        log.check()?;
        pass.dispatch(
            &self.loss,
            &normals::Params { size, focal, principal_point, first },
            normals::Buffers {
                render: render.slice(),
                transmittances: transmittances.slice(),
                normals: map.normals.slice(),
                d_differences: self.d_differences.slice_mut(),
                partials: self.partials.slice_mut(),
            },
            Threads::Workgroups([workgroups, 1, 1]),
        )?;
        let scale = (self.weight_at(step) / f64::from(map.count)) as f32;
        pass.dispatch(
            &self.backward,
            &normals_backward::Params { size, focal, principal_point, first, scale },
            normals_backward::Buffers {
                transmittances: transmittances.slice(),
                d_differences: self.d_differences.slice(),
                d_render: d_render.slice_mut(),
            },
            Threads::Exactly([pixels, 1, 1]),
        )?;
        let sums = |count| PartialSums {
            term: Term::NORMALS,
            partials: &self.partials,
            count,
            scale: 1.0 / map.count as f32,
        };
        log.record(pass, [sums(workgroups), sums(0)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::DeviceChoice;

    #[test]
    fn the_weight_falls_to_nothing_at_the_last_step() {
        let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
        let term = NormalLoss::new(&gpu, 0.2, 4).unwrap();
        assert_eq!([1, 3, 4, 5, 9].map(|step| term.weight_at(step)), [0.2, 0.1, 0.05, 0.0, 0.0]);
        assert!(NormalLoss::new(&gpu, -1.0, 4).is_err());
    }
}
