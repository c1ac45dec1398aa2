//! The smoothing floor: no Gaussian is smaller than what the finest training view of it resolves.

use nightsplat_core::camera::{Camera, Patch};

use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{self, smoothing_floor};
use crate::splats::device::DeviceGaussians;

/// Raises standard deviations to the smoothing floor.
#[derive(Debug)]
pub struct SmoothingFloor {
    gpu: Gpu,
    pipeline: Pipeline<smoothing_floor::Kernel>,
    cameras: Buffer<kernels::Camera>,
    near: f32,
    width: f32,
}

impl SmoothingFloor {
    /// The floor is a Gaussian of `variance` square pixels of the view, among those of `cameras`, that samples a
    /// Gaussian most finely. `near` is the near plane in world units.
    pub fn new(gpu: &Gpu, variance: f64, near: f32, cameras: &[Camera]) -> Result<Self> {
        let cameras: Vec<kernels::Camera> =
            cameras.iter().map(|camera| (&Patch::from(camera)).into()).collect();
        Ok(Self {
            gpu: gpu.clone(),
            pipeline: gpu.pipeline(&smoothing_floor::Constants::default())?,
            cameras: gpu.buffer("cameras", &cameras)?,
            near,
            width: variance.sqrt() as f32,
        })
    }

    /// Records a pass that raises the standard deviations; nothing changes while the first word of `status` is not 0.
    pub fn record(
        &self,
        pass: &mut Recorder<'_>,
        gaussians: &mut DeviceGaussians,
        status: &Buffer<u32>,
    ) -> Result<()> {
        let DeviceGaussians { layout, parameters, .. } = gaussians;
        layout.batches(&self.gpu).iter().try_for_each(|batch| {
            let gaussian_count = batch.gaussian_count();
            pass.dispatch(
                &self.pipeline,
                &smoothing_floor::Params {
                    gaussian_count,
                    camera_count: self.cameras.len() as u32,
                    near: self.near,
                    width: self.width,
                },
                smoothing_floor::Buffers {
                    parameters: batch.rows_mut(&mut *parameters, layout.words())?,
                    cameras: self.cameras.slice(),
                    status: status.slice(),
                },
                Threads::Exactly([gaussian_count, 1, 1]),
            )
        })
    }
}
