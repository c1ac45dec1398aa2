//! Memory of a training: estimated before the first step, and limited as the model grows.
//!
//! Limits depend on counts alone, never on the current state of the system: growth stops at the same number of
//! Gaussians in every run, resumed or not.

use std::sync::Arc;

use nightsplat_core::camera::Patch;
use nightsplat_models::gaussians::Shape;
use serde::Serialize;

use super::cache::CacheSize;
use super::clock::RunClock;
use super::config::TrainConfig;
use super::depth_seeding::count_once_seeded;
use super::model::{MARGIN, TrainedModel};
use super::views::Views;
use crate::Result;
use crate::gpu::Gpu;
use crate::splats::device::Layout;
use crate::splats::render::RenderOptions;

/// Approximate host memory of the program, the driver and its compiled kernels.
const PROGRAM: f64 = 256.0 * 1024.0 * 1024.0;
/// Bytes of density control's statistics for each Gaussian.
const STATISTICS: f64 = 8.0;
/// Copies of all planes on the host while a checkpoint or model is written.
const HOST_PLANE_SETS: f64 = 3.0;
/// The factor of capacity that a growing model allocates.
const HEADROOM: f64 = 1.5;
/// The share of memory for what could be recomputed: activations of networks, sorted intersections of views.
const RECOMPUTABLE: f64 = 0.25;

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

/// The memory of a run, and the limits of its growth.
#[derive(Debug)]
pub(super) struct Memory {
    gpu: Gpu,
    config: Arc<TrainConfig>,
    /// Bytes on the device that do not depend on the numbers of Gaussians and intersections.
    fixed_bytes: f64,
}

impl Memory {
    /// The memory of a run whose model has just been made.
    pub(super) fn new(gpu: &Gpu, config: Arc<TrainConfig>, model: &TrainedModel) -> Self {
        gpu.free_unused();
        let planes = PerGaussian::new(&config, model, model.gaussians.shape()).model;
        let in_model = model.gaussians.capacity() as f64 * planes;
        let (in_use, in_renderer) = (gpu.memory_in_use(), model.renderer.reserved_bytes());
        let fixed_bytes = (in_use as f64 - in_model - in_renderer as f64).max(0.0);
        Self { gpu: gpu.clone(), config, fixed_bytes }
    }

    /// Estimates the memory of the training from its present memory and its largest view.
    pub(super) fn estimate(
        &self,
        model: &mut TrainedModel,
        clock: &RunClock,
        views: &Views,
    ) -> Result<MemoryEstimate> {
        let met = f64::from(intersections_of_largest_view(model, views)?);
        let (per, count) = (self.per_gaussian(model, clock), model.count());
        let peak_gaussians = self.peak_gaussians(model, clock, views, met);
        let most = peak_gaussians as f64;
        let (reserved, capacity) =
            (f64::from(model.renderer.intersection_capacity()), model.gaussians.capacity() as f64);
        let device = self.fixed_bytes + per.steady(capacity) + intersection_bytes(model, reserved);
        let intersections = reserved.max(met_by(most, met, count as f64));
        let grown = per.growing_to(count as f64, capacity, most);
        let peak_device = (self.fixed_bytes + intersection_bytes(model, intersections) + grown)
            .max(device)
            .max(self.gpu.peak_memory() as f64);
        let host_plane = self.host_plane(model);
        let host = |gaussians: f64, device: f64| {
            // A software device's buffers are in the process's memory.
            let still_to_come = (device - self.gpu.memory_in_use() as f64).max(0.0);
            let shared = if self.gpu.properties().is_cpu { still_to_come } else { 0.0 };
            resident().unwrap_or(PROGRAM) + shared + HOST_PLANE_SETS * host_plane * gaussians
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

    /// The largest number of Gaussians that the run can reach, by its limits and its rounds of growth.
    fn peak_gaussians(
        &self,
        model: &TrainedModel,
        clock: &RunClock,
        views: &Views,
        met: f64,
    ) -> usize {
        let (count, interval) = (model.count(), self.config.schedule.densify_interval.max(1));
        let rounds = (clock.step / interval + 1..=self.config.steps / interval)
            .filter(|round| clock.densifies_at(round * interval));
        // A round at most doubles the Gaussians.
        let filled = count_once_seeded(&self.config, clock, views, count);
        let doubled = (0..rounds.count()).try_fold(filled, |count, _| count.checked_mul(2));
        let each = MARGIN * met / count.max(1) as f64;
        self.max_renderable()
            .min(self.fitting_in_vram(model, clock, each))
            .min(self.fitting_in_ram(model, clock, each))
            .min(doubled.unwrap_or(usize::MAX))
            .max(count)
    }

    /// The largest number of Gaussians that fits, at least the present number, and the limiting resource. `met`: the
    /// most intersections of a view with the present number.
    pub(super) fn capacity(
        &self,
        model: &TrainedModel,
        clock: &RunClock,
        met: f64,
    ) -> (usize, &'static str) {
        let count = model.count();
        let each = met / count.max(1) as f64;
        let bindable = f64::from(model.renderer.max_intersections()) / each;
        let bindable = self.max_renderable().min(bindable as usize);
        let bounds = [
            (bindable, "the most that the device binds"),
            (self.fitting_in_vram(model, clock, each), "the most that fits in max_vram"),
            (self.fitting_in_ram(model, clock, each), "the most that fits in max_ram"),
        ];
        let (capacity, why) =
            bounds.into_iter().min_by_key(|(capacity, _)| *capacity).unwrap_or(bounds[0]);
        (capacity.max(count), why)
    }

    /// The limit of Gaussians from the setting and from the buffers that the renderer binds.
    fn max_renderable(&self) -> usize {
        let renderable = self.config.render_settings().peak_gaussians(&self.gpu);
        self.config.max_gaussians.min(renderable)
    }

    /// The number of Gaussians, with `each` intersections, that fits the device's limit.
    fn fitting_in_vram(&self, model: &TrainedModel, clock: &RunClock, each: f64) -> usize {
        let Some(CacheSize(limit)) = self.config.max_vram else { return usize::MAX };
        let beside = intersection_bytes(model, each);
        self.per_gaussian(model, clock).fitting(limit as f64 - self.fixed_bytes, model, beside)
    }

    /// The number of Gaussians that fits the host's limit: as copies and, on a software device, as device buffers.
    fn fitting_in_ram(&self, model: &TrainedModel, clock: &RunClock, each: f64) -> usize {
        let Some(CacheSize(limit)) = self.config.max_ram else { return usize::MAX };
        let copies = HOST_PLANE_SETS * self.host_plane(model);
        let rest = limit as f64 - PROGRAM;
        if self.gpu.properties().is_cpu {
            let beside = copies + intersection_bytes(model, each);
            let per = self.per_gaussian(model, clock);
            return per.fitting(rest - self.fixed_bytes, model, beside);
        }
        (rest / copies).max(0.0) as usize
    }

    /// Bytes per Gaussian once the highest SH degree is in use.
    fn per_gaussian(&self, model: &TrainedModel, clock: &RunClock) -> PerGaussian {
        let now = model.gaussians.shape();
        let sh_degree = clock.sh_degree(self.config.steps).max(now.sh_degree);
        PerGaussian::new(&self.config, model, Shape { sh_degree, ..now })
    }

    /// Host bytes per Gaussian of one copy, with every SH degree.
    fn host_plane(&self, model: &TrainedModel) -> f64 {
        PerGaussian::new(&self.config, model, model.gaussians.whole_shape()).plane
    }
}

/// The bytes of the device that a training may use, by the limits of memory and the device's.
fn usable_bytes(gpu: &Gpu, config: &TrainConfig) -> f64 {
    let device = gpu.properties();
    let most = |CacheSize(bytes): CacheSize| bytes.min(device.memory);
    let vram = config.max_vram.map_or(device.memory, most) as f64;
    match config.max_ram {
        Some(CacheSize(ram)) if device.is_cpu => vram.min((ram as f64 - PROGRAM).max(0.0)),
        _ => vram,
    }
}

/// The most bytes for activations that could be recomputed.
pub(super) fn activation_bytes(gpu: &Gpu, config: &TrainConfig) -> u64 {
    (RECOMPUTABLE * usable_bytes(gpu, config)) as u64
}

/// The most bytes for sorted intersections of views, which must not fill what is free.
pub(super) fn list_bytes(gpu: &Gpu, config: &TrainConfig) -> u64 {
    let free = usable_bytes(gpu, config) - gpu.memory_in_use() as f64;
    activation_bytes(gpu, config).min((0.5 * free) as u64)
}

/// The intersections of the first Gaussians in the largest view, for which memory is then reserved.
fn intersections_of_largest_view(model: &mut TrainedModel, views: &Views) -> Result<u32> {
    let patches = views.all().iter().map(|view| view.patch);
    let Some(patch) = patches.max_by_key(Patch::pixel_count) else { return Ok(0) };
    let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
    model.renderer.render_patch(&model.gaussians.values, &patch, &options)?;
    model.renderer.intersections()
}

fn intersection_bytes(model: &TrainedModel, intersections: f64) -> f64 {
    intersections * model.renderer.bytes_per_intersection() as f64
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
    /// For Gaussians of this shape.
    fn new(config: &TrainConfig, model: &TrainedModel, shape: Shape) -> Self {
        let TrainedModel { gaussians, renderer, density, .. } = model;
        let layout = Layout { shape, ..gaussians.values.layout };
        let columns = [layout.floats().columns, layout.words()];
        let [plane, parameters] = columns.map(|columns| (columns * size_of::<f32>()) as f64);
        // Gradients and moments are planes, without the columns that are not trained.
        let planes = (1 + gaussians.moments.planes().len()) as f64;
        let frozen = f64::from(config.frozen_columns()) * size_of::<f32>() as f64;
        let densifier = &density.densifier;
        Self {
            plane,
            model: parameters + planes * (plane - frozen) + STATISTICS,
            working: (renderer.bytes_per_gaussian() + densifier.bytes_per_gaussian()) as f64,
        }
    }

    /// The number of Gaussians that fits in `bytes`, including growth and saving, with `beside` bytes more each.
    fn fitting(&self, bytes: f64, model: &TrainedModel, beside: f64) -> usize {
        let saved = bytes / (self.saving(1.0) + beside);
        // The present buffers may have 1.5 times the capacity.
        let before = HEADROOM * model.count() as f64;
        let grown = (bytes - self.growing(before, 0.0)) / (self.growing(0.0, 1.0) + beside);
        saved.min(grown).max(0.0) as usize
    }

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
