//! Density control: Gaussians with large view-space gradients are densified, faint ones pruned (Kerbl et al. 2023,
//! section 5.2).
//!
//! ```text
//! score -> sort by need -> decide -> scan of child counts -> counts to the host -> scatter
//! ```
//!
//! The device decides; the host reads four counters and allocates. The new Gaussians are written one plane set after
//! the other into the spare buffer, at first that of the last step's gradients: a round needs no additional memory.
//! Buffers grow with headroom, so most rounds allocate nothing.

mod control;

use nightsplat_core::camera::{Camera, Patch};
use nightsplat_models::attributes::PlaneCounts;

use crate::gpu::{Buffer, Gpu, Pipeline, Threads};
use crate::kernels::densify_action::{
    COUNTER_CANDIDATES, COUNTER_CLONED, COUNTER_PRUNED, COUNTER_SPLIT, COUNTER_WORDS,
};
use crate::kernels::{self, densify_decide, densify_moments, densify_scatter, densify_score};
use crate::splats::batches::{Batch, rest_by_column};
use crate::splats::device::{DeviceGaussians, GaussianSlice, Layout};
use crate::splats::optimizer::Moments;
use crate::splats::packed_sh::StorageFormat;
use crate::splats::sort::{Count, RadixSort, Scan};
use crate::{Error, Result};
pub use control::{DensityControl, DensityStrategy};

/// Thresholds and limits of density control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DensifySettings {
    /// How they are densified.
    pub control: DensityControl,
    /// Mean [`GradientNorm`](crate::GradientNorm) above which a Gaussian is densified.
    pub gradient_threshold: f64,
    /// Standard deviation up to which the paper's control clones, in world units; larger Gaussians are split.
    pub split_scale: f64,
    /// Fainter Gaussians are pruned, in (0, 1).
    pub min_opacity: f64,
    /// Upper limit; growth favours the largest gradients.
    pub max_gaussians: usize,
    /// The near plane of the cameras, in world units.
    pub near: f64,
    /// The seed of drawn positions.
    pub seed: u64,
}

/// State per Gaussian in addition to its parameters: Adam's moments, statistics since the last round, and a spare
/// buffer.
#[derive(Debug)]
pub struct DensifyInputs<'a> {
    /// Carried over to the new Gaussians.
    pub moments: &'a mut Moments,
    /// Sums of [`GradientNorm`](crate::GradientNorm)s.
    pub grad_norm_sums: &'a mut Buffer<f32>,
    /// The number of steps in which the Gaussian was visible.
    pub visit_counts: &'a mut Buffer<u32>,
    /// The gradients, as planes; overwritten.
    pub gradients: &'a mut Buffer<f32>,
}

/// A round of density control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Round {
    /// The step that it follows.
    pub step: u64,
    /// Remaining rounds, including this one. Each may use its share of the headroom below the limit; 1 uses all of it.
    pub rounds_left: u64,
    /// The most Gaussians that memory and views allow; [`DensifySettings::max_gaussians`] applies as well.
    pub most: usize,
}

/// The most trials of a round; the last one splits nothing.
const TRIALS: usize = 5;

/// The largest mean squared change of a camera's view by one split, in units of the squared contrast of what the
/// Gaussian covers, as `view_change` in `densify_score.comp` estimates it. It prevents a split from changing a view of
/// 30 dB by 0.1 dB at a contrast of 0.3 (docs/measurements.md).
pub const LARGEST_CHANGE: f32 = 2e-4;

/// The result of a round.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DensifyReport {
    /// Cloned Gaussians.
    pub cloned: usize,
    /// Gaussians that were replaced by two smaller ones.
    pub split: usize,
    /// Pruned Gaussians.
    pub pruned: usize,
    /// Gaussians after the round.
    pub count: usize,
    /// Candidates beyond the limit, which were not densified.
    pub refused: usize,
}

/// The kernels of density control.
#[derive(Debug)]
pub struct Densifier {
    gpu: Gpu,
    settings: DensifySettings,
    /// The cameras whose views splits must not change; empty for a control that does not keep views.
    cameras: Buffer<kernels::Camera>,
    score: Pipeline<densify_score::Kernel>,
    decide: Pipeline<densify_decide::Kernel>,
    scatter: Pipeline<densify_scatter::Kernel>,
    moments: Pipeline<densify_moments::Kernel>,
    sort: RadixSort,
    scan: Scan,
    scratch: DensifyScratch,
}

/// The decision for every Gaussian.
#[derive(Debug)]
struct DensifyScratch {
    keys: Buffer<u32>,
    ids: Buffer<u32>,
    actions: Buffer<u32>,
    child_counts: Buffer<u32>,
    offsets: Buffer<u32>,
    counters: Buffer<u32>,
    total: Buffer<u32>,
    count: Buffer<u32>,
}

impl DensifyScratch {
    fn new(gpu: &Gpu, capacity: usize) -> Result<Self> {
        Ok(Self {
            keys: gpu.uninit("densify_keys", capacity)?,
            ids: gpu.uninit("densify_ids", capacity)?,
            actions: gpu.uninit("densify_actions", capacity)?,
            child_counts: gpu.uninit("child_counts", capacity)?,
            offsets: gpu.uninit("child_offsets", capacity)?,
            counters: gpu.uninit("densify_counters", COUNTER_WORDS as usize)?,
            total: gpu.uninit("child_total", 1)?,
            count: gpu.uninit("gaussian_count", 1)?,
        })
    }
}

impl Densifier {
    /// Builds the kernels. A Gaussian is not split if that would change the view of one of `cameras`, in world space;
    /// the paper's control ignores them.
    pub fn new(gpu: &Gpu, settings: DensifySettings, cameras: &[Camera]) -> Result<Self> {
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
        let conserving = settings.control.strategy().keeps_views;
        let rest_by_column = rest_by_column(gpu);
        let cameras = if conserving { cameras } else { &[] };
        let cameras: Vec<kernels::Camera> =
            cameras.iter().map(|camera| (&Patch::from(camera)).into()).collect();
        Ok(Self {
            gpu: gpu.clone(),
            settings,
            cameras: gpu.buffer("cameras", &cameras)?,
            score: gpu
                .pipeline(&densify_score::Constants { rest_by_column, ..Default::default() })?,
            decide: gpu.pipeline(&densify_decide::Constants { conserving })?,
            scatter: gpu.pipeline(&densify_scatter::Constants { conserving, rest_by_column })?,
            moments: gpu.pipeline(&densify_moments::Constants { rest_by_column })?,
            sort: RadixSort::new(gpu, 0)?,
            scan: Scan::new(gpu, 0)?,
            scratch: DensifyScratch::new(gpu, 0)?,
        })
    }

    /// One round of density control: prunes and splits `gaussians`, or clones them under the paper's control. The
    /// caller zeroes the statistics for the new count; buffers grow as needed.
    ///
    /// `keeps` inspects the new Gaussians before they are committed and returns the fraction of the splits that may
    /// stay: 1 or more for all of them. Otherwise the round is repeated with that fraction, those with the largest
    /// gradients first, and at last with none.
    pub fn densify(
        &mut self,
        gaussians: &mut DeviceGaussians,
        mut inputs: DensifyInputs<'_>,
        round: Round,
        mut keeps: impl FnMut(GaussianSlice<'_>) -> Result<f64>,
    ) -> Result<DensifyReport> {
        check(gaussians, &inputs)?;
        let limit = self.settings.max_gaussians.min(round.most);
        let mut max_added = u32::MAX;
        for trial in 1..=TRIALS {
            let counters = self.decide(gaussians, &inputs, limit, max_added, round)?;
            let report = report(gaussians.layout.count, &counters);
            let added = report.split + report.cloned;
            if added + report.pruned == 0 {
                return Ok(report);
            }
            let mut spare_buffers = self.spare_buffers(gaussians, &inputs, report.count, limit)?;
            self.scatter(gaussians, &mut inputs, &mut spare_buffers, &report, round.step)?;
            let parameters = spare_buffers.words.as_ref().unwrap_or(inputs.gradients).slice();
            let layout = Layout { count: report.count, ..gaussians.layout };
            let new = GaussianSlice { layout, parameters };
            let share = if added == 0 { 1.0 } else { keeps(new)? };
            if share >= 1.0 {
                self.commit(gaussians, inputs, spare_buffers, &report)?;
                return Ok(report);
            }
            tracing::debug!("step {}: of {added} splits, {share:.3} may stay", round.step);
            max_added = if trial + 1 < TRIALS { (share * added as f64) as u32 } else { 0 };
        }
        Err(Error::Usage("density control: the last trial of a round splits nothing".to_owned()))
    }

    /// Memory of a round in addition to the Gaussians, in bytes per Gaussian.
    pub(crate) fn bytes_per_gaussian(&self) -> usize {
        5 * size_of::<u32>() + self.sort.bytes_per_item()
    }

    /// Leaves actions and offsets on the device, and returns the counters.
    fn decide(
        &mut self,
        gaussians: &DeviceGaussians,
        DensifyInputs { grad_norm_sums, visit_counts, .. }: &DensifyInputs<'_>,
        limit: usize,
        max_added: u32,
        round: Round,
    ) -> Result<Vec<u32>> {
        let DeviceGaussians { layout, parameters, .. } = gaussians;
        let (columns, count) = (layout.words(), layout.count as u32);
        let feature_count = layout.floats().features as u32;
        if self.scratch.keys.len() < layout.count {
            self.scratch = DensifyScratch::new(&self.gpu, grad_norm_sums.len())?;
        }
        let DensifySettings { gradient_threshold, split_scale, min_opacity, near, .. } =
            self.settings;
        let camera_count = self.cameras.len() as u32;
        let score = |batch: Batch| densify_score::Params {
            gaussian_count: batch.gaussian_count(),
            column_count: columns as u32,
            feature_count,
            gradient_threshold: gradient_threshold as f32,
            min_raw_opacity: (min_opacity / (1.0 - min_opacity)).ln() as f32,
            first_gaussian: batch.first_gaussian(),
            camera_count,
            near: near as f32,
            largest_change: LARGEST_CHANGE,
        };
        let decide = |batch: Batch| densify_decide::Params {
            gaussian_count: count,
            first_gaussian: batch.first_gaussian(),
            batch_count: batch.gaussian_count(),
            max_gaussians: limit.min(u32::MAX as usize) as u32,
            rounds_left: round.rounds_left.clamp(1, u64::from(u32::MAX)) as u32,
            split_log_scale: split_scale.ln() as f32,
            max_added,
        };
        let batches = layout.batches(&self.gpu);
        let Self { scratch, sort, scan, cameras, .. } = self;
        self.gpu.write(&mut scratch.count, &[count])?;
        let counters = self.gpu.run("densify_decide", |pass| {
            pass.fill(&mut scratch.counters, 0);
            for batch in batches.iter() {
                let buffers = densify_score::Buffers {
                    parameters: batch.rows(parameters, columns)?,
                    grad_norm_sums: batch.rows(&**grad_norm_sums, 1)?,
                    visit_counts: batch.rows(&**visit_counts, 1)?,
                    keys: batch.rows_mut(&mut scratch.keys, 1)?,
                    ids: batch.rows_mut(&mut scratch.ids, 1)?,
                    counters: scratch.counters.slice_mut(),
                    cameras: cameras.slice(),
                };
                let threads = Threads::Exactly([batch.gaussian_count(), 1, 1]);
                pass.dispatch(&self.score, &score(batch), buffers, threads)?;
            }
            let counted = Count { counts: &scratch.count, index: 0 };
            sort.record(pass, counted, &mut scratch.keys, &mut scratch.ids, u32::BITS)?;
            for batch in batches.iter() {
                let buffers = densify_decide::Buffers {
                    parameters: batch.rows(parameters, columns)?,
                    sorted_keys: scratch.keys.slice(),
                    sorted_ids: scratch.ids.slice(),
                    counters: scratch.counters.slice_mut(),
                    actions: scratch.actions.slice_mut(),
                    child_counts: scratch.child_counts.slice_mut(),
                };
                let threads = Threads::Exactly([count, 1, 1]);
                pass.dispatch(&self.decide, &decide(batch), buffers, threads)?;
            }
            let DensifyScratch { child_counts, offsets, total, .. } = scratch;
            scan.record(pass, counted, child_counts, offsets, total)?;
            pass.download(&scratch.counters)
        })?;
        counters.wait()
    }

    /// Writes the new parameters to the words of `spare_buffers`, or over the gradients.
    fn scatter(
        &self,
        gaussians: &DeviceGaussians,
        inputs: &mut DensifyInputs<'_>,
        spare_buffers: &mut SpareBuffers,
        report: &DensifyReport,
        step: u64,
    ) -> Result<()> {
        let DeviceGaussians { layout, parameters, .. } = gaussians;
        let (columns, feature_count) = (layout.words(), layout.floats().features as u32);
        let seed = self.settings.seed;
        let params = |from: Batch, to: Batch| densify_scatter::Params {
            gaussian_count: from.gaussian_count(),
            new_gaussian_count: to.gaussian_count(),
            column_count: columns as u32,
            feature_count,
            seed: (seed ^ (seed >> 32)) as u32,
            step: step as u32,
            first_gaussian: from.first_gaussian(),
            first_new_gaussian: to.first_gaussian(),
        };
        if spare_buffers.words.is_none() {
            spare_buffers.widen(inputs.gradients);
        }
        let target = spare_buffers.words.as_mut().unwrap_or(inputs.gradients);
        let DensifyScratch { actions, offsets, .. } = &self.scratch;
        let pairs = self.pairs(&gaussians.layout, report);
        self.gpu.run("densify_scatter", |pass| {
            for &(from, to) in &pairs {
                let buffers = densify_scatter::Buffers {
                    parameters: from.rows(parameters, columns)?,
                    actions: from.rows(actions, 1)?,
                    offsets: from.rows(offsets, 1)?,
                    new_parameters: to.rows_mut(&mut *target, columns)?,
                };
                let threads = Threads::Exactly([from.gaussian_count(), 1, 1]);
                pass.dispatch(&self.scatter, &params(from, to), buffers, threads)?;
            }
            Ok(())
        })
    }

    /// Commits the scattered parameters and transfers the moments: the buffer of each plane set becomes the spare of
    /// the next.
    fn commit(
        &self,
        gaussians: &mut DeviceGaussians,
        inputs: DensifyInputs<'_>,
        mut spare_buffers: SpareBuffers,
        report: &DensifyReport,
    ) -> Result<()> {
        let PlaneCounts { columns, features, .. } = gaussians.layout.floats();
        let params = |from: Batch, to: Batch| densify_moments::Params {
            gaussian_count: from.gaussian_count(),
            new_gaussian_count: to.gaussian_count(),
            column_count: columns as u32,
            feature_count: features as u32,
            first_new_gaussian: to.first_gaussian(),
        };
        let DensifyInputs { moments, grad_norm_sums, visit_counts, gradients: spare } = inputs;
        let DensifyScratch { actions, offsets, .. } = &self.scratch;
        let pairs = self.pairs(&gaussians.layout, report);
        std::mem::swap(&mut gaussians.parameters, spare_buffers.words.as_mut().unwrap_or(spare));
        self.gpu.run("densify_moments", |pass| {
            for (_, moments) in moments.planes_mut() {
                spare_buffers.widen(spare);
                for &(from, to) in &pairs {
                    let buffers = densify_moments::Buffers {
                        moments: from.planes(&*moments)?.words(),
                        actions: from.rows(actions, 1)?,
                        offsets: from.rows(offsets, 1)?,
                        new_moments: to.planes_mut(&mut *spare)?.words(),
                    };
                    let threads = Threads::Exactly([from.gaussian_count(), 1, 1]);
                    pass.dispatch(&self.moments, &params(from, to), buffers, threads)?;
                }
                std::mem::swap(moments, spare);
            }
            spare_buffers.widen(spare);
            Ok(())
        })?;
        if let Some((sums, counts)) = spare_buffers.statistics {
            (*grad_norm_sums, *visit_counts) = (sums, counts);
        }
        gaussians.layout.count = report.count;
        gaussians.layout.capacity = grad_norm_sums.len();
        Ok(())
    }

    /// Every batch with each of the new batches that its Gaussians go to.
    fn pairs(&self, layout: &Layout, report: &DensifyReport) -> Vec<(Batch, Batch)> {
        let new = Layout { count: report.count, ..*layout }.batches(&self.gpu);
        let old = layout.batches(&self.gpu);
        old.iter().flat_map(|from| new.iter().map(move |to| (from, to))).collect()
    }

    /// Replacements of all buffers if one is too short for `count` Gaussians, allocated before any is freed.
    fn spare_buffers(
        &self,
        gaussians: &DeviceGaussians,
        inputs: &DensifyInputs<'_>,
        count: usize,
        limit: usize,
    ) -> Result<SpareBuffers> {
        let DeviceGaussians { layout, parameters, .. } = gaussians;
        let (columns, capacity) = (layout.floats().columns, capacity(count, limit));
        let batches = layout.batches(&self.gpu);
        let buffer = |columns| {
            let window = batches.with_columns(columns).window();
            self.gpu.uninit_in_windows("planes", capacity * columns, window)
        };
        // Parameters with halves are shorter than planes of floats, and cannot replace them.
        let (turns, words) = match layout.sh_rest {
            StorageFormat::Single => (Some(parameters), None),
            StorageFormat::Half => (None, Some(buffer(layout.words())?)),
        };
        let moments = inputs.moments.planes().into_iter().map(|(_, plane)| plane);
        let held: Vec<_> = moments.chain(turns).chain([&*inputs.gradients]).collect();
        let is_short = inputs.grad_norm_sums.len() < count
            || held.iter().any(|plane| plane.len() < count * columns);
        if !is_short {
            return Ok(SpareBuffers { planes: vec![], words, statistics: None });
        }
        let sums = self.gpu.uninit("grad_norm_sums", capacity)?;
        Ok(SpareBuffers {
            planes: held.iter().map(|_| buffer(columns)).collect::<Result<_>>()?,
            words,
            statistics: Some((sums, self.gpu.uninit("visit_counts", capacity)?)),
        })
    }
}

/// Buffers for more Gaussians.
struct SpareBuffers {
    /// One for each plane set, including the gradients; empty if the existing ones suffice.
    planes: Vec<Buffer<f32>>,
    /// The target of parameters with halves.
    words: Option<Buffer<f32>>,
    statistics: Option<(Buffer<f32>, Buffer<u32>)>,
}

impl SpareBuffers {
    /// Replaces `spare` by a longer buffer, if there is one; the old one is freed once the device is done with it.
    fn widen(&mut self, spare: &mut Buffer<f32>) {
        if let Some(longer) = self.planes.pop() {
            *spare = longer;
        }
    }
}

/// The capacity to allocate for `count` Gaussians: 1.5 times as many, within the limit.
pub(crate) fn capacity(count: usize, limit: usize) -> usize {
    (count + count / 2).min(limit).max(count)
}

fn report(count: usize, counters: &[u32]) -> DensifyReport {
    let counters = |index: u32| counters.get(index as usize).map_or(0, |&count| count as usize);
    let (cloned, split, pruned) =
        (counters(COUNTER_CLONED), counters(COUNTER_SPLIT), counters(COUNTER_PRUNED));
    DensifyReport {
        cloned,
        split,
        pruned,
        count: count - pruned + cloned + split,
        refused: counters(COUNTER_CANDIDATES) - cloned - split,
    }
}

/// A kernel that exceeds a buffer reads other data, so lengths are checked before anything is recorded.
fn check(gaussians: &DeviceGaussians, inputs: &DensifyInputs<'_>) -> Result<()> {
    let DeviceGaussians { layout, parameters, .. } = gaussians;
    let DensifyInputs { moments, grad_norm_sums, visit_counts, .. } = inputs;
    let (count, floats) = (layout.count, layout.floats().total());
    parameters.check_len(count * layout.words())?;
    moments.planes().into_iter().try_for_each(|(_, plane)| plane.check_len(floats))?;
    grad_norm_sums.check_len(count)?;
    visit_counts.check_len(count)
}
