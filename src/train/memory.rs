//! How much memory a training takes: foreseen before the first step, and kept below a limit as the model grows.
//!
//! Limits are held by what follows from counts, never by what the system says at the moment: growth stops at the same
//! number of Gaussians in every run, interrupted or not.

use glam::UVec2;
use serde::Serialize;

use super::views::TrainView;
use super::{CacheSize, Trainer};
use crate::Result;
use crate::camera::Patch;
use crate::splats::render::RenderOptions;
use crate::splats::scene::{Layout, Shape};

/// What the program, the driver and its compiled kernels take on the host, about.
const PROGRAM: f64 = 256.0 * 1024.0 * 1024.0;
/// What density control gathers for each Gaussian, in bytes.
const STATISTICS: f64 = 8.0;
/// Plane sets that a checkpoint or a model is made from on the host.
const HOST_PLANE_SETS: f64 = 3.0;
/// A model that grows gets room for so many times as many Gaussians.
const HEADROOM: f64 = 1.5;
/// The fraction of the memory there may be that activations take which could be computed again.
const ACTIVATIONS: f64 = 0.25;
/// A view may have so many times as many intersections for each Gaussian as the last one had.
pub(super) const MARGIN: f64 = 2.0;

/// What a training is going to take, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MemoryEstimate {
    /// The Gaussians that a step has now.
    pub gaussians: usize,
    /// What steps with so many take on the device.
    pub device: u64,
    /// What the process takes on the host then, on a software device with what that has.
    pub host: u64,
    /// The most Gaussians that there may come to be.
    pub peak_gaussians: usize,
    /// The most on the device on the way there.
    pub peak_device: u64,
    /// The most on the host on the way there.
    pub peak_host: u64,
}

impl Trainer {
    /// Room on the renderer for every view.
    pub(super) fn reserve(&mut self) -> Result<()> {
        let Self { model, supervision, renderer, .. } = self;
        let sizes = supervision.views.all().map(TrainView::size);
        renderer.reserve_sizes(model.count(), model.capacity(), sizes)
    }

    /// What the training is going to take, by what it takes now and what its largest view shows.
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
            // On a software device, its buffers are the process's memory.
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

    /// How many intersections the first Gaussians have in the largest view; there is room for them then.
    fn intersections_of_largest_view(&mut self) -> Result<u32> {
        let largest =
            self.supervision.views.all().map(|view| view.patch).max_by_key(Patch::pixel_count);
        let Some(patch) = largest else { return Ok(0) };
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        self.renderer.render_patch(&self.model.gaussians, &patch, &options)?;
        self.renderer.intersections()
    }

    /// The most Gaussians that the run can come to have: a limit that there is, or as many as all its rounds of growth can
    /// make.
    fn peak_gaussians(&self, met: f64) -> usize {
        let (count, interval) = (self.model.count(), self.config.schedule.densify_interval.max(1));
        let rounds = (self.step / interval + 1..=self.config.steps / interval)
            .filter(|round| self.densifies_at(round * interval));
        // A Gaussian becomes two at most.
        let filled = self.count_once_filled();
        let doubled = (0..rounds.count()).try_fold(filled, |count, _| count.checked_mul(2));
        let limit = self.max_renderable();
        let each = MARGIN * met / count.max(1) as f64;
        let limit = limit.min(self.fitting_in_vram(each)).min(self.fitting_in_ram(each));
        limit.min(doubled.unwrap_or(usize::MAX)).max(count)
    }

    /// Keeps the activations that a denoiser's backward pass would compute again, within a fraction of what the run may have:
    /// the rest is the model's.
    pub(super) fn keep_activations(&mut self, sizes: &[UVec2]) -> Result<()> {
        let most = (ACTIVATIONS * self.max_bytes()) as u64;
        match &mut self.supervision.networks {
            Some(terms) => terms.keep_activations(sizes, most),
            None => Ok(()),
        }
    }

    /// What there may be on the device at most, by the limits and by what it has.
    fn max_bytes(&self) -> f64 {
        let device = self.gpu.properties();
        let most = |CacheSize(bytes): CacheSize| bytes.min(device.memory);
        let vram = self.config.max_vram.map_or(device.memory, most) as f64;
        match self.config.max_ram {
            Some(CacheSize(ram)) if device.is_cpu => vram.min((ram as f64 - PROGRAM).max(0.0)),
            _ => vram,
        }
    }

    /// What is on the device now, less what follows the numbers of Gaussians and intersections, in bytes.
    pub(super) fn measure_fixed_bytes(&self) -> f64 {
        self.gpu.free_unused();
        let model = self.model.capacity() as f64 * self.per_gaussian_of(self.model.shape()).model;
        (self.gpu.memory_in_use() as f64 - model - self.renderer.reserved_bytes() as f64).max(0.0)
    }

    /// How many Gaussians of so many intersections each fit into what the device may have.
    pub(super) fn fitting_in_vram(&self, each: f64) -> usize {
        let limit = self.config.max_vram.map(|CacheSize(bytes)| bytes as f64);
        limit.map_or(usize::MAX, |limit| self.fitting(limit - self.fixed_bytes, each, 0.0))
    }

    /// How many fit into what the process may have on the host: their copies there, and on a software device themselves.
    pub(super) fn fitting_in_ram(&self, each: f64) -> usize {
        let Some(CacheSize(limit)) = self.config.max_ram else { return usize::MAX };
        let copies = HOST_PLANE_SETS * self.host_plane();
        let rest = limit as f64 - PROGRAM;
        if self.gpu.properties().is_cpu {
            return self.fitting(rest - self.fixed_bytes, each, copies);
        }
        (rest / copies).max(0.0) as usize
    }

    /// How many Gaussians fit into so many bytes, with room to save them and to come to be, at `more` bytes each.
    fn fitting(&self, bytes: f64, each: f64, more: f64) -> usize {
        let (per, beside) = (self.per_gaussian(), more + self.intersection_bytes(each));
        let saved = bytes / (per.saving(1.0) + beside);
        // Those that there are may have room for half as many again.
        let before = HEADROOM * self.model.count() as f64;
        let grown = (bytes - per.growing(before, 0.0)) / (per.growing(0.0, 1.0) + beside);
        saved.min(grown).max(0.0) as usize
    }

    fn intersection_bytes(&self, intersections: f64) -> f64 {
        intersections * self.renderer.bytes_per_intersection() as f64
    }

    /// Once every SH degree is in use that the run comes to.
    fn per_gaussian(&self) -> PerGaussian {
        let now = self.model.shape();
        let sh_degree = self.sh_degree(self.config.steps).max(now.sh_degree);
        self.per_gaussian_of(Shape { sh_degree, ..now })
    }

    /// What a plane set takes of each on the host, where it has every SH degree.
    fn host_plane(&self) -> f64 {
        self.per_gaussian_of(self.model.whole_shape()).plane
    }

    fn per_gaussian_of(&self, shape: Shape) -> PerGaussian {
        let layout = Layout { shape, ..self.model.gaussians.layout };
        let columns = [layout.floats().columns, layout.words()];
        let [plane, parameters] = columns.map(|columns| (columns * size_of::<f32>()) as f64);
        // Beside the moments, gradients are planes.
        let planes = 1 + self.model.moments.planes().len();
        PerGaussian {
            plane,
            model: parameters + planes as f64 * plane + STATISTICS,
            working: (self.renderer.bytes_per_gaussian()
                + self.growth.densifier.bytes_per_gaussian()) as f64,
        }
    }
}

/// What each Gaussian takes on the device, in bytes.
struct PerGaussian {
    /// A float of every column.
    plane: f64,
    /// Parameters, gradients, moments, and what density control gathers.
    model: f64,
    /// In the renderer and in density control.
    working: f64,
}

impl PerGaussian {
    /// So many in training.
    fn steady(&self, count: f64) -> f64 {
        count * (self.model + self.working)
    }

    /// So many on their way to the host, one plane set after the other.
    fn saving(&self, count: f64) -> f64 {
        self.steady(count) + count * self.plane
    }

    /// The most that it takes to come from `count` with room for `capacity` to `most` by doubling, and to save them.
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

    /// So many come to be from so many: both are there for a moment.
    fn growing(&self, before: f64, count: f64) -> f64 {
        (before + count) * self.model + before * self.working
    }
}

/// How many intersections `gaussians` have where `count` have `met` and all of them together cover the same: each is
/// smaller then, and meets its own tile and those beyond its edges.
fn met_by(gaussians: f64, met: f64, count: f64) -> f64 {
    let each = met / count.max(1.0);
    let beyond = (each.sqrt() - 1.0).max(0.0) * (count / gaussians).sqrt().min(1.0);
    gaussians * each.min((1.0 + beyond).powi(2))
}

/// What the process has in memory now, in bytes; none where the system does not say.
fn resident() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()? * 1024.0)
}
