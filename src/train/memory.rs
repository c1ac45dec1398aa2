//! How much memory a training takes: foreseen before the first step, and kept below a limit as the model grows.
//!
//! Limits are held by what follows from counts, never by what the system says at the moment: growth stops at the same
//! number of Gaussians in every run, interrupted or not.

use serde::Serialize;

use super::{CacheSize, Trainer};
use crate::render::TILES_PER_GAUSSIAN;

/// What the program, the driver and its compiled kernels take on the host, about.
const PROGRAM: f64 = 256.0 * 1024.0 * 1024.0;
/// Parameters, two moments, and the gradients: a float of every column each.
const PLANE_SETS: f64 = 4.0;
/// What density control gathers for each Gaussian, in bytes.
const STATISTICS: f64 = 8.0;
/// Plane sets that a checkpoint or a model is made from on the host.
const HOST_PLANE_SETS: f64 = 3.0;
/// A model that grows gets room for so many times as many Gaussians.
const HEADROOM: f64 = 1.5;
/// What buffers had room for before they grew the last time, as a part of what they have then: 1 / [`HEADROOM`] to 1.
const BEFORE_GROWTH: f64 = 0.8;

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
    pub most_gaussians: usize,
    /// The most on the device on the way there.
    pub most_device: u64,
    /// The most on the host on the way there.
    pub most_host: u64,
}

impl Trainer {
    /// What the training is going to take, by what it takes now.
    pub fn memory_estimate(&self) -> MemoryEstimate {
        let count = self.model.count();
        let per = self.per_gaussian();
        let reserved = f64::from(self.renderer.intersection_capacity());
        let device = per.steady(self.model.capacity() as f64) + self.intersection_bytes(reserved);
        let most_gaussians = self.most_gaussians();
        let most = most_gaussians as f64;
        let intersections = reserved.max(f64::from(TILES_PER_GAUSSIAN) * most);
        let grown = if most_gaussians > self.model.capacity() {
            per.growing(BEFORE_GROWTH * most, most).max(per.saving(most))
        } else {
            per.saving(self.model.capacity() as f64)
        };
        let most_device = (self.fixed_bytes + self.intersection_bytes(intersections) + grown)
            .max(self.gpu.peak_memory() as f64);
        let device = self.fixed_bytes + device;
        let host = |gaussians: f64, device: f64| {
            // On a software device, its buffers are the process's memory.
            let still_to_come = (device - self.gpu.memory_in_use() as f64).max(0.0);
            let shared = if self.gpu.properties().is_cpu { still_to_come } else { 0.0 };
            resident().unwrap_or(PROGRAM) + shared + HOST_PLANE_SETS * per.plane * gaussians
        };
        MemoryEstimate {
            gaussians: count,
            device: device as u64,
            host: host(count as f64, device) as u64,
            most_gaussians,
            most_device: most_device as u64,
            most_host: host(most, most_device) as u64,
        }
    }

    /// The most Gaussians that the run can come to have: a limit that there is, or as many as all its rounds of growth can
    /// make.
    fn most_gaussians(&self) -> usize {
        let rounds = (self.step + 1..=self.config.steps).filter(|&step| self.densifies_at(step));
        // A Gaussian becomes two at most.
        let doubled =
            (0..rounds.count()).try_fold(self.model.count(), |count, _| count.checked_mul(2));
        let limit = self.densifier.limit(self.model.gaussians.column_count);
        let each = f64::from(TILES_PER_GAUSSIAN);
        let limit = limit.min(self.fitting_in_vram(each)).min(self.fitting_in_ram(each));
        limit.min(doubled.unwrap_or(usize::MAX)).max(self.model.count())
    }

    /// What is on the device now, less what follows the numbers of Gaussians and intersections, in bytes.
    pub(super) fn measure_fixed_bytes(&self) -> f64 {
        self.gpu.free_unused();
        let model = self.model.capacity() as f64 * self.per_gaussian().model();
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
        let copies = HOST_PLANE_SETS * self.per_gaussian().plane;
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

    fn per_gaussian(&self) -> PerGaussian {
        PerGaussian {
            plane: f64::from(self.model.gaussians.column_count) * size_of::<f32>() as f64,
            working: (self.renderer.bytes_per_gaussian() + self.densifier.bytes_per_gaussian())
                as f64,
        }
    }
}

/// What each Gaussian takes on the device, in bytes.
struct PerGaussian {
    /// A float of every column.
    plane: f64,
    /// In the renderer and in density control.
    working: f64,
}

impl PerGaussian {
    fn model(&self) -> f64 {
        PLANE_SETS * self.plane + STATISTICS
    }

    /// So many in training.
    fn steady(&self, count: f64) -> f64 {
        count * (self.model() + self.working)
    }

    /// So many on their way to the host, one plane set after the other.
    fn saving(&self, count: f64) -> f64 {
        self.steady(count) + count * self.plane
    }

    /// So many come to be from so many: both are there for a moment.
    fn growing(&self, before: f64, count: f64) -> f64 {
        (before + count) * self.model() + before * self.working
    }
}

/// What the process has in memory now, in bytes; none where the system does not say.
fn resident() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()? * 1024.0)
}
