//! Gaussians with what Adam needs of them.

use nightsplat::gpu::{Buffer, Recorder};
use nightsplat::kernels;
use nightsplat::splats::batches::Batches;
use nightsplat::splats::device::DeviceGaussians;
use nightsplat::splats::optimizer::{Adam, AdamBuffers, AdamStep, GaussianStep, LearningRates};
use nightsplat_core::camera::Patch;

use crate::common::prelude::*;

pub(crate) fn wave(len: usize, scale: f32, phase: f32) -> Vec<f32> {
    (0..len).map(|i| scale * (i as f32 * 0.7 + phase).sin()).collect()
}

/// The buffers that Adam updates, seen by a camera at the origin.
pub(crate) struct Learned {
    pub(crate) gaussians: DeviceGaussians,
    pub(crate) moments: Moments,
    pub(crate) gradients: Buffer<f32>,
    pub(crate) rates: LearningRates,
    pub(crate) status: Buffer<u32>,
    /// The SH degree in use.
    pub(crate) sh_degree: u32,
    adam: Adam,
    camera: Buffer<kernels::Camera>,
    /// The layout of gradients and moments.
    trained: Batches,
}

impl Learned {
    pub(crate) fn new(
        count: usize,
        shape: Shape,
        [rest, moments]: [StorageFormat; 2],
        frozen_columns: u32,
    ) -> Self {
        let (gpu, layout) = (gpu(), Layout::new(count, shape, rest));
        let mut gaussians = DeviceGaussians::uninit(&gpu, layout).unwrap();
        gaussians.write(&gpu, &wave(layout.floats().total(), 0.7, 0.3)).unwrap();
        let trained = layout.batches(&gpu).without(frozen_columns);
        let zeros = |name| trained.zeros(&gpu, name).unwrap();
        let moments = match moments {
            StorageFormat::Single => Moments::Single { first: zeros("m"), second: zeros("v") },
            StorageFormat::Half => Moments::Half(zeros("moments")),
        };
        let gradients = wave(layout.floats().total(), 1e-3, 1.0);
        let gradients = trained.upload(&gpu, "gradients", &gradients).unwrap();
        let camera = pinhole([64, 48], 50.0, DAffine3::IDENTITY);
        let camera = gpu.buffer("camera", &[(&Patch::from(&camera)).into()]).unwrap();
        let (status, rates) = (gpu.zeros("status", 1).unwrap(), LearningRates::uniform(1e-3));
        let (adam, sh_degree) = (Adam::with_frozen(&gpu, frozen_columns).unwrap(), shape.sh_degree);
        Self { gaussians, moments, gradients, rates, status, sh_degree, adam, camera, trained }
    }

    pub(crate) fn step(&mut self, step: u64) {
        let layout = self.gaussians.layout;
        gpu().run("adam", |pass| self.record(pass, step, layout)).unwrap();
    }

    /// Records a step of Gaussians in this layout.
    pub(crate) fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        step: u64,
        layout: Layout,
    ) -> nightsplat::Result<()> {
        let Self { gaussians, moments, gradients, rates, status, sh_degree, adam, camera, .. } =
            self;
        let step = AdamStep { step, rates, status };
        let step = GaussianStep { adam: step, sh_degree: *sh_degree, camera: (camera, 0) };
        let buffers = AdamBuffers {
            parameters: gaussians.parameters.slice_mut(),
            gradients: gradients.slice(),
            moments: moments.slice_mut(),
        };
        adam.record_gaussians(pass, step, layout, buffers)
    }

    /// The parameters.
    pub(crate) fn parameters(&self) -> Vec<f32> {
        self.gaussians.read(&gpu()).unwrap()
    }

    /// Both moments of every parameter; 0 of those that are not trained.
    pub(crate) fn moments(&self) -> Vec<[f32; 2]> {
        let read = |plane: &Buffer<f32>| self.trained.read(&gpu(), plane).unwrap();
        match &self.moments {
            Moments::Single { first, second } => {
                read(first).into_iter().zip(read(second)).map(|(m, v)| [m, v]).collect()
            }
            Moments::Half(both) => {
                let of = |both: u32| [both & 0xffff_0000, both << 16].map(f32::from_bits);
                read(both).into_iter().map(|both| of(both.to_bits())).collect()
            }
        }
    }

    /// The bits of parameters and moments.
    pub(crate) fn bits(&self) -> Vec<u32> {
        let moments = self.moments().into_iter().flatten();
        self.parameters().into_iter().chain(moments).map(f32::to_bits).collect()
    }
}
