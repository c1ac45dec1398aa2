//! Density control: Gaussians that the views pull at multiply, faint ones go (Kerbl et al. 2023, section 5.2).
//!
//! As in LITA-GS, a clone's position is drawn from its parent, opacities are never reset and large Gaussians are not
//! pruned. A pass makes new buffers of the exact new size; nothing of the old ones is changed.

use crate::gpu::{Buffer, Gpu, Pipeline, Threads};
use crate::kernels::fate::{FATE_CLONE, FATE_PRUNE, FATE_SPLIT};
use crate::kernels::{densify_count, densify_scatter};
use crate::optimizer::Moments;
use crate::sort::{Count, Scan};
use crate::{Error, Result};

/// Which Gaussians multiply and which go.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DensifySettings {
    /// Mean norm of the screen-space gradient, in normalised device units, above which a Gaussian multiplies.
    pub gradient_threshold: f64,
    /// The largest standard deviation, in world units, up to which it is cloned; beyond, it is split.
    pub split_scale: f64,
    /// Fainter Gaussians go, in (0, 1).
    pub min_opacity: f64,
    /// There never come to be more; growth goes to those with the largest gradients.
    pub max_gaussians: usize,
    /// Where the drawn positions come from.
    pub seed: u64,
}

/// Gaussians on the device with their optimiser state, as planes (include/gaussian.glsl).
#[derive(Debug)]
pub struct DeviceGaussians {
    /// The number of Gaussians.
    pub count: u32,
    /// Floats per Gaussian: [`crate::scene::width`].
    pub column_count: u32,
    /// How many of these are features.
    pub feature_count: u32,
    /// `count * column_count` floats.
    pub parameters: Buffer<f32>,
    /// As many each.
    pub moments: Moments,
}

/// What the steps since the last pass have gathered, per Gaussian.
#[derive(Clone, Copy, Debug)]
pub struct GradientStatistics<'a> {
    /// Sums of the norms of the screen-space gradients, in normalised device units.
    pub grad_norm_sums: &'a Buffer<f32>,
    /// In how many steps the Gaussian was seen.
    pub visit_counts: &'a Buffer<u32>,
}

/// What one pass did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DensifyReport {
    /// Gaussians that got a copy.
    pub cloned: usize,
    /// Gaussians that two smaller ones replaced.
    pub split: usize,
    /// Gaussians that went.
    pub pruned: usize,
    /// Gaussians there are now.
    pub count: usize,
}

/// The kernels of density control.
#[derive(Debug)]
pub struct Densifier {
    gpu: Gpu,
    settings: DensifySettings,
    count: Pipeline<densify_count::Kernel>,
    scatter: Pipeline<densify_scatter::Kernel>,
    scan: Scan,
}

/// The decision for every Gaussian, on the device and on the host.
struct Decision {
    mean_gradients: Buffer<f32>,
    device_fates: Buffer<u32>,
    offspring_counts: Buffer<u32>,
    fates: Vec<u32>,
}

impl Densifier {
    /// The kernels on this device.
    ///
    /// # Errors
    /// A setting makes no sense, or the device refuses a pipeline.
    pub fn new(gpu: &Gpu, settings: DensifySettings) -> Result<Self> {
        let DensifySettings { gradient_threshold, split_scale, min_opacity, .. } = settings;
        for (name, value, upper) in [
            ("gradient threshold", gradient_threshold, f64::INFINITY),
            ("split scale", split_scale, f64::INFINITY),
            ("minimum opacity", min_opacity, 1.0),
        ] {
            if !(0.0..upper).contains(&value) {
                let problem = format!(
                    "density control: the {name} is {value}; it must be within 0 and {upper}"
                );
                return Err(Error::Usage(problem));
            }
        }
        Ok(Self {
            gpu: gpu.clone(),
            settings,
            count: gpu.pipeline(&densify_count::Constants::default())?,
            scatter: gpu.pipeline(&densify_scatter::Constants::default())?,
            scan: Scan::new(gpu, 0)?,
        })
    }

    /// One pass of density control after `step`: the Gaussians that come of `gaussians`, and what happened. New ones
    /// begin with zero moments, the statistics are to be zeroed for the new count.
    ///
    /// # Errors
    /// A buffer is shorter than the Gaussians need, or the device is out of memory.
    pub fn densify(
        &mut self,
        gaussians: &DeviceGaussians,
        statistics: GradientStatistics<'_>,
        step: u64,
    ) -> Result<(DeviceGaussians, DensifyReport)> {
        check(gaussians, statistics)?;
        let threshold = self.settings.gradient_threshold as f32;
        let mut decision = self.decide(gaussians, statistics, threshold)?;
        if let Some(threshold) = self.raised_threshold(&decision)? {
            decision = self.decide(gaussians, statistics, threshold)?;
        }
        let report = report(&decision.fates);
        let successors = self.scatter(gaussians, &decision, report.count, step)?;
        Ok((successors, report))
    }

    fn decide(
        &self,
        gaussians: &DeviceGaussians,
        GradientStatistics { grad_norm_sums, visit_counts }: GradientStatistics<'_>,
        gradient_threshold: f32,
    ) -> Result<Decision> {
        let len = gaussians.count as usize;
        let mut mean_gradients = self.gpu.uninit("mean_gradients", len)?;
        let mut device_fates = self.gpu.uninit("fates", len)?;
        let mut offspring_counts = self.gpu.uninit("offspring_counts", len)?;
        let min_opacity = self.settings.min_opacity;
        let params = densify_count::Params {
            gaussian_count: gaussians.count,
            column_count: gaussians.column_count,
            feature_count: gaussians.feature_count,
            gradient_threshold,
            split_log_scale: self.settings.split_scale.ln() as f32,
            min_raw_opacity: (min_opacity / (1.0 - min_opacity)).ln() as f32,
        };
        self.gpu.run("densify_count", |pass| {
            let buffers = densify_count::Buffers {
                parameters: &gaussians.parameters,
                grad_norm_sums,
                visit_counts,
                mean_gradients: &mut mean_gradients,
                fates: &mut device_fates,
                offspring_counts: &mut offspring_counts,
            };
            pass.dispatch(&self.count, &params, buffers, Threads::Exactly([gaussians.count, 1, 1]))
        })?;
        let fates = self.gpu.read(&device_fates)?;
        Ok(Decision { mean_gradients, device_fates, offspring_counts, fates })
    }

    /// The gradient threshold that keeps the successors of a decision within the limit, if it exceeds that.
    fn raised_threshold(&self, decision: &Decision) -> Result<Option<f32>> {
        let DensifyReport { cloned, split, pruned, .. } = report(&decision.fates);
        let room = self.settings.max_gaussians.saturating_sub(decision.fates.len() - pruned);
        if cloned + split <= room {
            return Ok(None);
        }
        let mean_gradients = self.gpu.read(&decision.mean_gradients)?;
        let mut candidates: Vec<f32> = mean_gradients
            .into_iter()
            .zip(&decision.fates)
            .filter_map(|(gradient, &fate)| (fate >= FATE_CLONE).then_some(gradient))
            .collect();
        // Each adds one Gaussian. Only those above the largest that finds no room may multiply.
        let (_, &mut threshold, _) = candidates.select_nth_unstable_by(room, |a, b| b.total_cmp(a));
        Ok(Some(threshold))
    }

    fn scatter(
        &mut self,
        gaussians: &DeviceGaussians,
        decision: &Decision,
        new_count: usize,
        step: u64,
    ) -> Result<DeviceGaussians> {
        let len = gaussians.count as usize;
        let new_len = new_count * gaussians.column_count as usize;
        let counts = self.gpu.buffer("gaussian_count", &[gaussians.count])?;
        let mut offsets = self.gpu.uninit("offspring_offsets", len)?;
        let mut total = self.gpu.uninit("offspring_total", 1)?;
        let mut successors = DeviceGaussians {
            count: new_count as u32,
            column_count: gaussians.column_count,
            feature_count: gaussians.feature_count,
            parameters: self.gpu.uninit("parameters", new_len)?,
            moments: Moments {
                first: self.gpu.uninit("first_moments", new_len)?,
                second: self.gpu.uninit("second_moments", new_len)?,
            },
        };
        let seed = self.settings.seed;
        let params = densify_scatter::Params {
            gaussian_count: gaussians.count,
            new_gaussian_count: successors.count,
            column_count: gaussians.column_count,
            feature_count: gaussians.feature_count,
            seed: (seed ^ (seed >> 32)) as u32,
            step: step as u32,
        };
        let (scan, scatter) = (&mut self.scan, &self.scatter);
        self.gpu.run("densify_scatter", |pass| {
            let count = Count { counts: &counts, index: 0 };
            scan.record(pass, count, &decision.offspring_counts, &mut offsets, &mut total)?;
            let buffers = densify_scatter::Buffers {
                parameters: &gaussians.parameters,
                first_moments: &gaussians.moments.first,
                second_moments: &gaussians.moments.second,
                fates: &decision.device_fates,
                offsets: &offsets,
                new_parameters: &mut successors.parameters,
                new_first_moments: &mut successors.moments.first,
                new_second_moments: &mut successors.moments.second,
            };
            pass.dispatch(scatter, &params, buffers, Threads::Exactly([gaussians.count, 1, 1]))
        })?;
        Ok(successors)
    }
}

fn report(fates: &[u32]) -> DensifyReport {
    let with = |fate: u32| fates.iter().filter(|&&other| other == fate).count();
    let (cloned, split, pruned) = (with(FATE_CLONE), with(FATE_SPLIT), with(FATE_PRUNE));
    DensifyReport { cloned, split, pruned, count: fates.len() - pruned + cloned + split }
}

/// A kernel that runs beyond a buffer reads its neighbours: refuse before anything is recorded.
fn check(gaussians: &DeviceGaussians, statistics: GradientStatistics<'_>) -> Result<()> {
    let DeviceGaussians { count, column_count, feature_count, parameters, moments } = gaussians;
    let (count, columns) = (*count as usize, *column_count as usize);
    let GradientStatistics { grad_norm_sums, visit_counts } = statistics;
    let planes =
        [parameters, &moments.first, &moments.second].map(|b| (b.name(), b.len(), count * columns));
    let per_gaussian = [
        (grad_norm_sums.name(), grad_norm_sums.len(), count),
        (visit_counts.name(), visit_counts.len(), count),
    ];
    if columns < crate::scene::width(0) + *feature_count as usize {
        return Err(Error::Usage(format!("density control: {columns} floats make no Gaussian")));
    }
    match planes.into_iter().chain(per_gaussian).find(|(_, len, needed)| len < needed) {
        Some((name, len, needed)) => Err(Error::Usage(format!(
            "buffer `{name}` holds {len} elements, density control needs {needed}"
        ))),
        None => Ok(()),
    }
}
