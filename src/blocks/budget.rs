//! The memory and disk of a block's training, foreseen from its numbers.

use nightsplat_models::attributes::rest_coefficients;
use nightsplat_photographs::dataset::Dataset;

use crate::splats::packed_sh::StorageFormat;
use crate::train::{CacheSize, TrainConfig};

/// The program, the driver and its compiled kernels, bytes.
const PROGRAM: f64 = 165.0 * 1024.0 * 1024.0;
/// The factor of capacity that a growing model allocates.
const HEADROOM: f64 = 1.5;
/// Floats of a Gaussian without spherical harmonics above degree 0.
const BASE_FLOATS: f64 = 14.0;
/// Bytes of a Gaussian in the renderer and in density control.
const WORKING: f64 = 180.0;
/// Bytes of an intersection of a Gaussian and a tile, with both halves of the sort.
const INTERSECTION: f64 = 72.0;
/// Intersections of a Gaussian in a view, with the margin for the largest view.
const INTERSECTIONS: f64 = 4.0;
/// Copies of a model on the host while it is saved.
const COPIES: f64 = 3.0;
/// The share of the memory that photographs may take.
const PHOTOGRAPHS: f64 = 0.25;
/// Bytes of a photograph's pixel: on the device, decoded, and in the buffers of its largest view.
const PIXEL: f64 = 40.0;

/// The numbers from which memory follows.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    /// Bytes of a Gaussian in training.
    gaussian: f64,
    /// Bytes of a Gaussian on the host, if that is the memory of the device as well.
    copies: f64,
    /// Bytes of a Gaussian in the two checkpoints and the model of a run.
    on_disk: f64,
    /// Pixels of the largest view.
    pixels: f64,
    /// Bytes that photographs may take; `None`: a quarter of the memory.
    cache: Option<f64>,
}

impl Budget {
    /// `is_shared`: the device's memory is that of the host, as of a software device.
    pub(crate) fn new(config: &TrainConfig, dataset: &Dataset, is_shared: bool) -> Self {
        let rest = 3.0 * rest_coefficients(config.sh_degree) as f64;
        let floats = BASE_FLOATS + rest;
        let bytes = |format| if format == StorageFormat::Single { 4.0 } else { 2.0 };
        let parameters = 4.0 * BASE_FLOATS + bytes(config.precision.rest) * rest;
        let trained = floats - f64::from(config.frozen_columns());
        let moments = 2.0 * bytes(config.precision.moments) * trained;
        let pixels = dataset
            .views
            .iter()
            .map(|view| f64::from(view.camera.width) * f64::from(view.camera.height));
        Self {
            gaussian: parameters + moments + 4.0 * trained,
            copies: if is_shared { COPIES * 4.0 * floats } else { 0.0 },
            on_disk: 2.0 * 3.0 * 4.0 * floats + 4.0 * (floats + 3.0),
            pixels: pixels.fold(0.0, f64::max),
            cache: config.cache.map(|CacheSize(bytes)| bytes as f64),
        }
    }

    /// That of the coarse model, which is trained at half size.
    pub(crate) fn at_half_size(self) -> Self {
        Self { pixels: self.pixels / 4.0, ..self }
    }

    /// Bytes of training up to this number of Gaussians on this number of views.
    pub(crate) fn memory(&self, gaussians: f64, views: f64, most: f64) -> f64 {
        let photographs = (views * self.pixels * PIXEL).min(self.photographs(most));
        PROGRAM + photographs + self.pixels * PIXEL + gaussians * self.each()
    }

    /// The number of Gaussians that fits into `most` bytes.
    pub(crate) fn gaussians(&self, most: f64) -> f64 {
        let left = most - PROGRAM - self.photographs(most) - self.pixels * PIXEL;
        (left / self.each()).max(0.0)
    }

    /// Bytes on disk of a run of this number of Gaussians.
    pub(crate) fn disk(&self, gaussians: f64) -> f64 {
        gaussians * self.on_disk
    }

    fn each(&self) -> f64 {
        HEADROOM * self.gaussian + WORKING + INTERSECTIONS * INTERSECTION + self.copies
    }

    fn photographs(&self, most: f64) -> f64 {
        self.cache.unwrap_or(PHOTOGRAPHS * most)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_shares_the_memory_of_the_host_has_room_for_the_copies_that_are_saved() {
        let dataset = Dataset { root: "".into(), views: vec![], points: vec![], skipped: vec![] };
        let config = TrainConfig::default();
        let [alone, shared] = [false, true].map(|shared| Budget::new(&config, &dataset, shared));
        let floats = 14.0 + 3.0 * rest_coefficients(config.sh_degree) as f64;
        let more = shared.memory(1e6, 0.0, 8e9) - alone.memory(1e6, 0.0, 8e9);
        assert!((more - 12e6 * floats).abs() < 1.0, "{more}");
        assert!(shared.gaussians(8e9) < alone.gaussians(8e9));
    }
}
