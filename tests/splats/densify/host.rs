//! Gaussians in host memory, and density control of them on the device.

use nightsplat_models::gaussians::width;

use nightsplat::splats::batches::Batches;
use nightsplat::splats::densify::{
    Densifier, DensifyInputs, DensifyReport, DensifySettings, DensityControl, Round,
};
use nightsplat::splats::device::{DeviceGaussians, GaussianSlice};

use crate::common::prelude::*;

/// Four features and SH of degree 1.
pub(super) const COLUMNS: usize = 27;
pub(super) const FEATURES: usize = 4;
pub(super) const REST: usize = 14 + FEATURES;
pub(super) const SETTINGS: DensifySettings = DensifySettings {
    control: DensityControl::Paper,
    gradient_threshold: 2e-4,
    split_scale: 0.05,
    min_opacity: 0.005,
    max_gaussians: usize::MAX,
    near: 0.01,
    seed: 10,
};
pub(super) const CONSERVING: DensifySettings =
    DensifySettings { control: DensityControl::Conserving, ..SETTINGS };
pub(super) const STEP: u64 = 600;
pub(super) const LAST: Round = Round { step: STEP, rounds_left: 1, most: usize::MAX };

/// Features of four channels.
pub(super) fn shape() -> Shape {
    let shape =
        Shape { sh_degree: 1, features: Features { depth: true, noise: true, ..Features::NONE } };
    assert_eq!([shape.features.width(), width(shape)], [FEATURES, COLUMNS]);
    shape
}

pub(super) fn room_for(count: usize) -> DeviceGaussians {
    DeviceGaussians::uninit(&gpu(), Layout::new(count, shape(), StorageFormat::Single)).unwrap()
}

/// A camera of 64 x 48 pixels that looks along +z.
pub(super) fn camera_at(position: DVec3) -> Camera {
    pinhole([64, 48], 60.0, DAffine3::from_translation(-position))
}

/// Gaussians, their moments and their statistics in host memory.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Host {
    pub(super) count: usize,
    pub(super) parameters: Vec<f32>,
    pub(super) first: Vec<f32>,
    pub(super) second: Vec<f32>,
    pub(super) grad_norm_sums: Vec<f32>,
    pub(super) visit_counts: Vec<u32>,
}

impl Host {
    /// Opaque Gaussians of scale 0.01 without gradients.
    pub(super) fn calm(count: usize) -> Self {
        let wave = |phase: f32| -> Vec<f32> {
            (0..count * COLUMNS).map(|i| (i as f32 * 0.7 + phase).sin()).collect()
        };
        let mut parameters = wave(0.0);
        parameters[7 * count..10 * count].fill(0.01f32.ln());
        parameters[10 * count..11 * count].fill(2.0);
        let (first, second) = (wave(1.0), wave(2.0));
        Self {
            count,
            parameters,
            first,
            second,
            grad_norm_sums: vec![0.0; count],
            visit_counts: vec![4; count],
        }
    }

    /// Calm ones whose gradients grow with their numbers.
    pub(super) fn ranked(count: usize) -> Self {
        let grad_norm_sums = (0..count).map(|i| 0.1 + i as f32).collect();
        Self { grad_norm_sums, ..Self::calm(count) }
    }

    /// Large and small, faint and opaque Gaussians with gradients of all sizes; some were never visible.
    pub(super) fn mixed(count: usize) -> Self {
        let mut host = Self::calm(count);
        for i in 0..count {
            host.parameters[7 * count + 3 * i] =
                if i % 3 == 0 { 0.2f32.ln() } else { 0.01f32.ln() };
            host.parameters[10 * count + i] = if i % 7 == 0 { -6.0 } else { 1.0 };
            host.visit_counts[i] = i as u32 % 5;
            host.grad_norm_sums[i] = (i * 37 % 101) as f32 * 2e-5;
        }
        host
    }

    pub(super) fn pull_at(&mut self, i: usize) {
        self.grad_norm_sums[i] = 1.0;
    }

    pub(super) fn quat_mut(&mut self, i: usize) -> &mut [f32] {
        let first = 3 * self.count + 4 * i;
        &mut self.parameters[first..first + 4]
    }

    pub(super) fn log_scales_mut(&mut self, i: usize) -> &mut [f32] {
        let first = 7 * self.count + 3 * i;
        &mut self.parameters[first..first + 3]
    }

    pub(super) fn mean(&self, i: usize) -> Vec3 {
        Vec3::from_slice(&self.parameters[3 * i..])
    }

    /// All floats of one Gaussian, in the order of the columns.
    pub(super) fn row(&self, planes: &[f32], i: usize) -> Vec<f32> {
        [(0, 3), (3, 4), (7, 3), (10, 1), (11, 3), (14, FEATURES), (REST, COLUMNS - REST)]
            .into_iter()
            .flat_map(|(column, width)| {
                let first = column * self.count + width * i;
                planes[first..first + width].to_vec()
            })
            .collect()
    }

    pub(super) fn densify(&self, settings: DensifySettings, round: Round) -> (Self, DensifyReport) {
        self.densify_seen_from(&[], settings, round)
    }

    pub(super) fn densify_seen_from(
        &self,
        cameras: &[Camera],
        settings: DensifySettings,
        round: Round,
    ) -> (Self, DensifyReport) {
        self.densify_as_kept(cameras, settings, round, |_| 1.0)
    }

    /// The same, with `keeps` giving the share of the splits to keep for a number of Gaussians.
    pub(super) fn densify_as_kept(
        &self,
        cameras: &[Camera],
        settings: DensifySettings,
        round: Round,
        mut keeps: impl FnMut(usize) -> f64,
    ) -> (Self, DensifyReport) {
        let gpu = gpu();
        let mut gaussians = room_for(self.count);
        let batches = Batches::new(&gpu, gaussians.layout.floats());
        let planes = |data: &[f32]| batches.upload(&gpu, "planes", data).unwrap();
        gaussians.parameters = planes(&self.parameters);
        let mut moments =
            Moments::Single { first: planes(&self.first), second: planes(&self.second) };
        let inputs = DensifyInputs {
            moments: &mut moments,
            grad_norm_sums: &mut gpu.buffer("grad_norm_sums", &self.grad_norm_sums).unwrap(),
            visit_counts: &mut gpu.buffer("visit_counts", &self.visit_counts).unwrap(),
            gradients: &mut planes(&vec![f32::NAN; self.count * COLUMNS]),
        };
        let mut densifier = Densifier::new(&gpu, settings, cameras).unwrap();
        let keeps = |new: GaussianSlice<'_>| {
            assert!(new.parameters.len() >= new.layout.count * COLUMNS);
            Ok(keeps(new.layout.count))
        };
        let report = densifier.densify(&mut gaussians, inputs, round, keeps).unwrap();
        assert_eq!(report.count, gaussians.layout.count);
        let Moments::Single { first, second } = &moments else { panic!() };
        let batches = Batches::new(&gpu, gaussians.layout.floats());
        let read = |buffer| {
            let planes = batches.read(&gpu, buffer).unwrap();
            assert_eq!(planes.len(), report.count * COLUMNS);
            planes
        };
        let host = Self {
            count: report.count,
            parameters: read(&gaussians.parameters),
            first: read(first),
            second: read(second),
            grad_norm_sums: vec![0.0; report.count],
            visit_counts: vec![0; report.count],
        };
        (host, report)
    }
}
