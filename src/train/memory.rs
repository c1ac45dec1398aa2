//! Memory of a training: estimated before the first step, and limited as the model grows.
//!
//! Limits depend on counts alone, never on the current state of the system: growth stops at the same number of
//! Gaussians in every run, resumed or not.

use glam::UVec2;
use nightsplat_core::camera::Patch;
use serde::Serialize;

use super::views::TrainView;
use super::{CacheSize, Trainer};
use crate::Result;
use crate::splats::render::RenderOptions;
use crate::splats::scene::{Layout, Shape};

/// Approximate host memory of the program, the driver and its compiled kernels.
const PROGRAM: f64 = 256.0 * 1024.0 * 1024.0;
/// Bytes of density control's statistics for each Gaussian.
const STATISTICS: f64 = 8.0;
/// Copies of all planes on the host while a checkpoint or model is written.
const HOST_PLANE_SETS: f64 = 3.0;
/// The factor of capacity that a growing model allocates.
const HEADROOM: f64 = 1.5;
/// The share of memory for activations that could be recomputed.
const ACTIVATIONS: f64 = 0.25;
/// How many times more intersections per Gaussian a view may have than the last one.
pub(super) const MARGIN: f64 = 2.0;

/// The estimated memory of a training, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MemoryEstimate {
    /// The present number of Gaussians.
    pub gaussians: usize,
    /// Device memory of steps with that number.
    pub device: u64,
    /// Host memory of the process, including a software device's.
    pub host: u64,
    /// The largest number of Gaussians that the run can reach.
    pub peak_gaussians: usize,
    /// Peak device memory until then.
    pub peak_device: u64,
    /// Peak host memory until then.
    pub peak_host: u64,
}

impl Trainer {
    /// Reserves the renderer's memory for every view.
    pub(super) fn reserve(&mut self) -> Result<()> {
        let Self { model, supervision, renderer, .. } = self;
        let sizes = supervision.views.all().iter().map(TrainView::size);
        renderer.reserve_sizes(model.count(), model.capacity(), sizes)
    }

    /// Estimates the memory of the training from its present memory and its largest view.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn memory_estimate(&mut self) -> Result<MemoryEstimate> {
        let met = f64::from(self.intersections_of_largest_view()?);
        let (per, count) = (self.per_gaussian(), self.model.count());
        let peak_gaussians = self.peak_gaussians(met);
        let most = peak_gaussians as f64;
        let reserved = f64::from(self.renderer.intersection_capacity());
        let device = self.fixed_bytes
            + per.steady(self.model.capacity() as f64)
            + self.intersection_bytes(reserved);
        let intersections = reserved.max(met_by(most, met, count as f64));
        let grown = per.growing_to(count as f64, self.model.capacity() as f64, most);
        let peak_device = (self.fixed_bytes + self.intersection_bytes(intersections) + grown)
            .max(device)
            .max(self.gpu.peak_memory() as f64);
        let host = |gaussians: f64, device: f64| {
            // A software device's buffers are in the process's memory.
            let still_to_come = (device - self.gpu.memory_in_use() as f64).max(0.0);
            let shared = if self.gpu.properties().is_cpu { still_to_come } else { 0.0 };
            resident().unwrap_or(PROGRAM) + shared + HOST_PLANE_SETS * self.host_plane() * gaussians
        };
        Ok(MemoryEstimate {
            gaussians: count,
            device: device as u64,
            host: host(count as f64, device) as u64,
            peak_gaussians,
            peak_device: peak_device as u64,
            peak_host: host(most, peak_device) as u64,
        })
    }

    /// The intersections of the first Gaussians in the largest view, for which memory is then reserved.
    fn intersections_of_largest_view(&mut self) -> Result<u32> {
        let largest = self
            .supervision
            .views
            .all()
            .iter()
            .map(|view| view.patch)
            .max_by_key(Patch::pixel_count);
        let Some(patch) = largest else { return Ok(0) };
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        self.renderer.render_patch(&self.model.gaussians, &patch, &options)?;
        self.renderer.intersections()
    }

    /// The largest number of Gaussians that the run can reach, by its limits and its rounds of growth.
    fn peak_gaussians(&self, met: f64) -> usize {
        let (count, interval) = (self.model.count(), self.config.schedule.densify_interval.max(1));
        let rounds = (self.step / interval + 1..=self.config.steps / interval)
            .filter(|round| self.densifies_at(round * interval));
        // A round at most doubles the Gaussians.
        let filled = self.count_once_filled();
        let doubled = (0..rounds.count()).try_fold(filled, |count, _| count.checked_mul(2));
        let limit = self.max_renderable();
        let each = MARGIN * met / count.max(1) as f64;
        let limit = limit.min(self.fitting_in_vram(each)).min(self.fitting_in_ram(each));
        limit.min(doubled.unwrap_or(usize::MAX)).max(count)
    }

    /// Keeps the activations that the denoiser's backward pass would otherwise recompute, within their share of the
    /// memory.
    pub(super) fn keep_activations(&mut self, sizes: &[UVec2]) -> Result<()> {
        let most = (ACTIVATIONS * self.max_bytes()) as u64;
        match &mut self.supervision.networks {
            Some(terms) => terms.keep_activations(sizes, most),
            None => Ok(()),
        }
    }

    /// The most bytes on the device, by the limits and its memory.
    fn max_bytes(&self) -> f64 {
        let device = self.gpu.properties();
        let most = |CacheSize(bytes): CacheSize| bytes.min(device.memory);
        let vram = self.config.max_vram.map_or(device.memory, most) as f64;
        match self.config.max_ram {
            Some(CacheSize(ram)) if device.is_cpu => vram.min((ram as f64 - PROGRAM).max(0.0)),
            _ => vram,
        }
    }

    /// Bytes on the device that do not depend on the numbers of Gaussians and intersections.
    pub(super) fn measure_fixed_bytes(&self) -> f64 {
        self.gpu.free_unused();
        let model = self.model.capacity() as f64 * self.per_gaussian_of(self.model.shape()).model;
        (self.gpu.memory_in_use() as f64 - model - self.renderer.reserved_bytes() as f64).max(0.0)
    }

    /// The number of Gaussians, with `each` intersections, that fits the device's limit.
    pub(super) fn fitting_in_vram(&self, each: f64) -> usize {
        let limit = self.config.max_vram.map(|CacheSize(bytes)| bytes as f64);
        limit.map_or(usize::MAX, |limit| self.fitting(limit - self.fixed_bytes, each, 0.0))
    }

    /// The number of Gaussians that fits the host's limit: as copies and, on a software device, as device buffers.
    pub(super) fn fitting_in_ram(&self, each: f64) -> usize {
        let Some(CacheSize(limit)) = self.config.max_ram else { return usize::MAX };
        let copies = HOST_PLANE_SETS * self.host_plane();
        let rest = limit as f64 - PROGRAM;
        if self.gpu.properties().is_cpu {
            return self.fitting(rest - self.fixed_bytes, each, copies);
        }
        (rest / copies).max(0.0) as usize
    }

    /// The number of Gaussians that fits in `bytes`, including growth and saving, with `more` bytes each.
    fn fitting(&self, bytes: f64, each: f64, more: f64) -> usize {
        let (per, beside) = (self.per_gaussian(), more + self.intersection_bytes(each));
        let saved = bytes / (per.saving(1.0) + beside);
        // The present buffers may have 1.5 times the capacity.
        let before = HEADROOM * self.model.count() as f64;
        let grown = (bytes - per.growing(before, 0.0)) / (per.growing(0.0, 1.0) + beside);
        saved.min(grown).max(0.0) as usize
    }

    fn intersection_bytes(&self, intersections: f64) -> f64 {
        intersections * self.renderer.bytes_per_intersection() as f64
    }

    /// Bytes per Gaussian once the highest SH degree is in use.
    fn per_gaussian(&self) -> PerGaussian {
        let now = self.model.shape();
        let sh_degree = self.sh_degree(self.config.steps).max(now.sh_degree);
        self.per_gaussian_of(Shape { sh_degree, ..now })
    }

    /// Host bytes per Gaussian of one copy, with every SH degree.
    fn host_plane(&self) -> f64 {
        self.per_gaussian_of(self.model.whole_shape()).plane
    }

    fn per_gaussian_of(&self, shape: Shape) -> PerGaussian {
        let layout = Layout { shape, ..self.model.gaussians.layout };
        let columns = [layout.floats().columns, layout.words()];
        let [plane, parameters] = columns.map(|columns| (columns * size_of::<f32>()) as f64);
        // Gradients and moments are planes, without the columns that are not trained.
        let planes = (1 + self.model.moments.planes().len()) as f64;
        let frozen = f64::from(self.config.frozen_columns()) * size_of::<f32>() as f64;
        PerGaussian {
            plane,
            model: parameters + planes * (plane - frozen) + STATISTICS,
            working: (self.renderer.bytes_per_gaussian()
                + self.growth.densifier.bytes_per_gaussian()) as f64,
        }
    }
}

/// Device memory per Gaussian, in bytes.
struct PerGaussian {
    /// A float of every column.
    plane: f64,
    /// Parameters, gradients, moments, and statistics of density control.
    model: f64,
    /// In the renderer and in density control.
    working: f64,
}

impl PerGaussian {
    /// Bytes of `count` Gaussians in training.
    fn steady(&self, count: f64) -> f64 {
        count * (self.model + self.working)
    }

    /// Bytes while `count` Gaussians are read back, one copy at a time.
    fn saving(&self, count: f64) -> f64 {
        self.steady(count) + count * self.plane
    }

    /// Peak bytes of growing from `count` Gaussians with capacity `capacity` to `most` by doubling, and of saving them.
    fn growing_to(&self, count: f64, capacity: f64, most: f64) -> f64 {
        let (mut count, mut capacity, mut peak) = (count, capacity, 0.0_f64);
        while count >= 1.0 && count < most {
            count = (2.0 * count).min(most);
            if count > capacity {
                let grown = (HEADROOM * count).min(most).max(count);
                peak = peak.max(self.growing(capacity, grown));
                capacity = grown;
            }
        }
        peak.max(self.saving(capacity))
    }

    /// Bytes during a round from `before` to `count` Gaussians, while both exist.
    fn growing(&self, before: f64, count: f64) -> f64 {
        (before + count) * self.model + before * self.working
    }
}

/// The intersections of `gaussians` Gaussians, if `count` have `met` and both cover the same area: smaller ones
/// intersect their own tile and those beyond their edges.
fn met_by(gaussians: f64, met: f64, count: f64) -> f64 {
    let each = met / count.max(1.0);
    let beyond = (each.sqrt() - 1.0).max(0.0) * (count / gaussians).sqrt().min(1.0);
    gaussians * each.min((1.0 + beyond).powi(2))
}

/// The resident memory of the process in bytes; `None` if the system does not report it.
fn resident() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()? * 1024.0)
}
