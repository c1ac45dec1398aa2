//! Checkpoints, from which a run resumes bit for bit.
//!
//! Random numbers are functions of seed and step, so a checkpoint holds only the state after a step: all learned
//! parameters with their moments, and the statistics of density control. A header shows whether the file is complete
//! and belongs to the run.

use std::collections::HashMap;
use std::path::Path;

use nightsplat_core::hash::{self, Hasher};
use nightsplat_core::input;
use nightsplat_core::output::write_whole_with;
use nightsplat_models::gaussians::{Gaussians, Shape, width};
use nightsplat_photographs::dataset::Fingerprint;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, TensorView};
use serde::{Deserialize, Serialize};

use super::config::TrainConfig;
use super::decisions::Decisions;
use super::gaussians::TrainedGaussians;
use super::lamp::LEARNED;
use super::model::{Snapshot, Tensor, TrainedModel};
use super::trainer::Trainer;
use crate::gpu::{Gpu, SliceMut};
use crate::kernels::lamp::{LAMP_NUMBERS, LAMP_WIDTH};
use crate::networks::TensorFile;
use crate::splats::batches::Batches;
use crate::splats::optimizer::{AdamBuffers, Moments};
use crate::{Error, Result};

/// The metadata key of the [`CheckpointHeader`], as JSON; a single key, since several would be written in random order.
const HEADER: &str = "checkpoint";

const FORMAT: &str = "nightsplat checkpoint 1";

/// The prefix of the best model's tensors.
const BEST: &str = "best.";

const VISIT_COUNTS: &str = "density.visit_counts";

/// The header of a checkpoint.
#[derive(Serialize, Deserialize)]
struct CheckpointHeader {
    format: String,
    /// Steps done.
    step: u64,
    /// The settings of the run, as TOML.
    config: String,
    /// The decisions of the held-out views so far.
    decisions: Decisions,
    /// Views left out of training.
    left_out: Vec<String>,
    /// The dataset's fingerprint.
    dataset: Fingerprint,
    /// The checksum of the rest of the header and of the tensors.
    checksum: String,
}

impl CheckpointHeader {
    /// The checksum of a file with this header and these tensors, in the order of their names.
    fn checksum_with(&self, mut tensors: Vec<(String, &[u8])>) -> String {
        let Self { format, step, config, decisions, left_out, dataset, .. } = self;
        let mut hasher = Hasher::default();
        let header = serde_json::json!([format, step, config, decisions, left_out, dataset]);
        hasher.write(header.to_string().as_bytes());
        tensors.sort_unstable();
        for (name, bytes) in tensors {
            hasher.write(name.as_bytes());
            hasher.write(bytes);
        }
        hash::text(hasher.finish())
    }

    /// Whether the header's checksum matches the file.
    fn describes(&self, file: &TensorFile<'_>) -> bool {
        self.checksum == self.checksum_with(file.tensors())
    }
}

/// Verifies a checkpoint's checksum.
pub fn check_checkpoint(path: &Path) -> Result<()> {
    let bytes = input::bytes(path)?;
    let damaged =
        |problem: &str| Error::input(path, format!("is not an intact checkpoint ({problem})"));
    let file = TensorFile::parse(&bytes).map_err(|error| damaged(&error.to_string()))?;
    let header =
        file.note(HEADER).and_then(|header| serde_json::from_str::<CheckpointHeader>(header).ok());
    match header {
        Some(header) if header.describes(&file) => Ok(()),
        Some(_) => Err(damaged("its checksum does not match")),
        None => Err(damaged("its header is damaged")),
    }
}

/// A tensor of the training state.
pub(super) struct StateTensor<'a> {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    buffer: SliceMut<'a, f32>,
    /// The layout of the buffer, if it differs from the file's.
    batches: Option<Batches>,
}

impl StateTensor<'_> {
    fn read(&self, gpu: &Gpu) -> Result<Vec<f32>> {
        if let Some(batches) = self.batches {
            return batches.read(gpu, self.buffer.as_slice());
        }
        let mut values = gpu.read(self.buffer.as_slice())?;
        values.truncate(self.shape.iter().product());
        Ok(values)
    }

    pub(super) fn write(self, gpu: &Gpu, values: &[f32]) -> Result<()> {
        match self.batches {
            Some(batches) => batches.write(gpu, self.buffer, values),
            None => gpu.write(self.buffer, values),
        }
    }
}

impl Trainer {
    /// Writes the state that the next step depends on, as one safetensors file.
    ///
    /// # Errors
    /// The file cannot be written, or the device was lost.
    pub fn save_checkpoint(&mut self, path: &Path) -> Result<()> {
        let gpu = self.gpu.clone();
        let mut header = CheckpointHeader {
            format: FORMAT.to_owned(),
            step: self.clock.step,
            config: self.config.to_toml()?,
            decisions: self.clock.decisions.clone(),
            left_out: self.supervision.views.left_out(),
            dataset: self.scene.fingerprint.clone(),
            checksum: String::new(),
        };
        let downloads = self.tensors(|_| true)?;
        for (name, _, values) in &downloads {
            self.refuse_values(name, values)?;
        }
        let current = downloads.iter().map(|tensor| (tensor.0.clone(), tensor));
        let best = self.model.best.iter().map(|tensor| (format!("{BEST}{}", tensor.0), tensor));
        let named: Vec<(String, &Tensor)> = current.chain(best).collect();
        let mut visits = gpu.read(&self.model.gaussians.visit_counts)?;
        visits.truncate(self.model.count());
        let tensors =
            named.iter().map(|(name, (_, _, values))| (name.clone(), bytemuck::cast_slice(values)));
        let visit_counts = (VISIT_COUNTS.to_owned(), bytemuck::cast_slice(&visits));
        header.checksum = header.checksum_with(tensors.chain([visit_counts]).collect());
        let header = serde_json::json!(header).to_string();
        let metadata = HashMap::from([(HEADER.to_owned(), header)]);
        let view = |name: &str, shape: &[usize], dtype, bytes| -> std::io::Result<_> {
            let view = TensorView::new(dtype, shape.to_vec(), bytes);
            Ok((name.to_owned(), view.map_err(std::io::Error::other)?))
        };
        write_whole_with(path, |path| {
            let mut views = vec![view(
                VISIT_COUNTS,
                &[visits.len()],
                Dtype::U32,
                bytemuck::cast_slice(&visits),
            )?];
            for (name, (_, shape, values)) in &named {
                views.push(view(name, shape, Dtype::F32, bytemuck::cast_slice(values))?);
            }
            // With the permissions of other files: safetensors makes it readable by the owner alone.
            let permissions = std::fs::File::create(path)?.metadata()?.permissions();
            safetensors::serialize_to_file(views, Some(metadata), path)
                .map_err(std::io::Error::other)?;
            std::fs::set_permissions(path, permissions)?;
            // A checkpoint must survive a power failure.
            std::fs::File::open(path)?.sync_all()
        })
    }

    /// Reads back the tensors of the state whose names `wants` accepts.
    pub(super) fn tensors(&mut self, wants: impl Fn(&str) -> bool) -> Result<Vec<Tensor>> {
        let gpu = self.gpu.clone();
        let state = self.state().into_iter().filter(|state| wants(&state.name));
        let tensors = state.map(|state| {
            let values = state.read(&gpu)?;
            Ok((state.name, state.shape, values))
        });
        tensors.collect()
    }

    /// Restores the state that [`Trainer::save_checkpoint`] wrote: further steps give the bits of an uninterrupted run.
    /// With a larger number of steps, the run may differ from one that had it from the start: near the old end there
    /// was no density control, and perhaps a cooldown.
    ///
    /// # Errors
    /// The file is missing, damaged, beyond the end of this run, or made with other settings; the trainer is then
    /// unchanged.
    pub fn restore(&mut self, path: &Path) -> Result<()> {
        let bytes = input::bytes(path)?;
        let damaged = |problem: String| {
            Error::input(path, format!("is not an intact checkpoint ({problem})"))
        };
        let file = TensorFile::parse(&bytes).map_err(|error| damaged(error.to_string()))?;
        let (header, begun) = self.header_of(path, &file)?;
        let visits: Vec<u32> = values(&file, VISIT_COUNTS, Dtype::U32, None).map_err(damaged)?;
        let gpu = self.gpu.clone();
        let sh_degree = self.sh_degree_of(&file);
        let mut restored = self.model.gaussians.zeros_like(&gpu, visits.len(), sh_degree)?;
        gpu.write(&mut restored.visit_counts, &visits)?;
        let best = best_of(&file).map_err(damaged)?;
        let fresh = std::mem::replace(&mut self.model.gaussians, restored);
        if let Err(error) = self.read_state(&gpu, &file, &header, &damaged) {
            self.model.gaussians = fresh;
            return Err(error);
        }
        self.supervision.views.viewpoints.forget_lists();
        self.supervision.views.set_left_out(&header.left_out);
        (self.clock.step, self.clock.decisions, self.model.best) =
            (header.step, header.decisions, best);
        if begun.steps != self.config.steps {
            (self.clock.decisions.goes_on, self.clock.decisions.finish) = (true, None);
        }
        if let Some(change) = begun.stop.change(&self.config.stop) {
            tracing::warn!("{change}; this applies from step {} on", self.clock.step);
        }
        self.model.renderer.set_sh_degree(self.model.gaussians.shape().sh_degree)?;
        self.model.reserve(&self.supervision.views)
    }

    /// Reads back the current parameters.
    pub(super) fn snapshot(&mut self) -> Result<Snapshot> {
        self.tensors(|name| name.ends_with(".parameters"))
    }

    /// Restores the parameters; moments and statistics are reset.
    pub(super) fn restore_snapshot(&mut self, snapshot: &Snapshot) -> Result<()> {
        let gpu = self.gpu.clone();
        let shape = |(name, shape, _): &Tensor| {
            (name == TrainedGaussians::PARAMETERS).then(|| shape.clone())
        };
        if let Some([words, count]) = snapshot.iter().find_map(shape).as_deref() {
            let TrainedModel { gaussians, renderer, .. } = &mut self.model;
            let sh_degree = gaussians.sh_degree_of_words(*words);
            *gaussians = gaussians.zeros_like(&gpu, *count, sh_degree)?;
            renderer.set_sh_degree(gaussians.shape().sh_degree)?;
        }
        for state in self.state() {
            let kept = snapshot.iter().find(|(name, _, _)| *name == state.name);
            kept.map_or(Ok(()), |(_, _, values)| state.write(&gpu, values))?;
        }
        self.model.reserve(&self.supervision.views)
    }

    /// The SH degree of a checkpoint's Gaussians, from the columns of their moments.
    fn sh_degree_of(&self, file: &TensorFile<'_>) -> u32 {
        let gaussians = &self.model.gaussians;
        let whole = gaussians.whole_shape();
        let columns = gaussians.moments.planes().first().and_then(|(name, _)| {
            file.tensor(&format!("gaussians.{name}"))?.0.shape.first().copied()
        });
        let fits = |&sh_degree: &u32| Some(width(Shape { sh_degree, ..whole })) == columns;
        // If none fits, reading the tensor reports it.
        (0..=whole.sh_degree).find(fits).unwrap_or(gaussians.shape().sh_degree)
    }

    /// The header and settings of a checkpoint that this run can resume from.
    fn header_of(
        &self,
        path: &Path,
        file: &TensorFile<'_>,
    ) -> Result<(CheckpointHeader, TrainConfig)> {
        let refused = |problem: String| Error::input(path, problem);
        let anew = "start again with --overwrite";
        let header = file.note(HEADER).and_then(|header| serde_json::from_str(header).ok());
        let Some(header) = header.filter(|h: &CheckpointHeader| h.format == FORMAT) else {
            return Err(refused(format!("is not a `{FORMAT}`; {anew}")));
        };
        let CheckpointHeader { step, config, dataset, .. } = &header;
        let config = TrainConfig::from_toml(config)
            .map_err(|error| refused(format!("was made by another version ({error}); {anew}")))?;
        if let Some(difference) = config.difference(&self.config) {
            return Err(refused(format!(
                "was made with {difference}; give the settings of the run, or {anew}"
            )));
        }
        if let Some(difference) = dataset.difference(&self.scene.fingerprint) {
            return Err(refused(format!(
                "was trained on another dataset ({difference}); give the dataset of the run, or {anew}"
            )));
        }
        let steps = self.config.steps;
        if *step > steps {
            return Err(refused(format!(
                "is at step {step}, but this run ends at {steps}; raise steps"
            )));
        }
        Ok((header, config))
    }

    /// Refuses Gaussians with NaN or infinity.
    pub(crate) fn refuse_not_finite(&self, gaussians: &Gaussians) -> Result<()> {
        match first_not_finite(&gaussians.parameters) {
            Some(at) => Err(self.not_finite_in(at, width(gaussians.shape))),
            None => Ok(()),
        }
    }

    fn refuse_values(&self, name: &str, values: &[f32]) -> Result<()> {
        match first_not_finite(values) {
            Some(at) => Err(self.not_finite(name, at)),
            None => Ok(()),
        }
    }

    /// The error for a value of the state, from its tensor's name.
    pub(super) fn not_finite(&self, name: &str, at: usize) -> Error {
        let layout = self.model.gaussians.values.layout;
        match name.strip_prefix("gaussians.") {
            Some("parameters") => self.not_finite_in(at, layout.words()),
            Some(_) => self.not_finite_in(at, layout.floats().columns),
            None => {
                let (step, plane) = (self.clock.step, name.to_owned());
                Error::ParameterNotFinite { step, plane, gaussian: at }
            }
        }
    }

    /// [`Self::not_finite`] for Gaussians with `columns` columns.
    fn not_finite_in(&self, at: usize, columns: usize) -> Error {
        let (plane, gaussian) = self.model.gaussians.place_of(at, columns);
        Error::ParameterNotFinite { step: self.clock.step, plane, gaussian }
    }

    /// Reads every tensor before changing any but the model's.
    fn read_state(
        &mut self,
        gpu: &Gpu,
        file: &TensorFile<'_>,
        header: &CheckpointHeader,
        damaged: &dyn Fn(String) -> Error,
    ) -> Result<()> {
        let read = |state: StateTensor<'_>| {
            let values: Vec<f32> =
                values(file, &state.name, Dtype::F32, Some(&state.shape)).map_err(damaged)?;
            if values.iter().all(|value: &f32| value.is_finite()) {
                return Ok(values);
            }
            Err(damaged(format!("`{}` holds values that are not finite", state.name)))
        };
        let values = self.state().into_iter().map(read).collect::<Result<Vec<_>>>()?;
        if !header.describes(file) {
            return Err(damaged("its checksum does not match".to_owned()));
        }
        self.state()
            .into_iter()
            .zip(values)
            .try_for_each(|(state, values)| state.write(gpu, &values))
    }

    /// The state that the next step depends on, except the visit counts, which are integers.
    pub(super) fn state(&mut self) -> Vec<StateTensor<'_>> {
        let TrainedModel { gaussians, renderer, optimizer, .. } = &mut self.model;
        let trained = gaussians.trained_planes(&self.gpu);
        let TrainedGaussians { values, moments, grad_norm_sums, .. } = gaussians;
        let layout = values.layout;
        let of_parameters =
            (vec![layout.words(), layout.count], layout.parameter_batches(&self.gpu));
        let of_moments = (vec![layout.floats().columns, layout.count], trained);
        let name = "density.grad_norm_sums".to_owned();
        let shape = vec![layout.count];
        let buffer = grad_norm_sums.slice_mut();
        let mut state = vec![StateTensor { name, shape, buffer, batches: None }];
        let (parameters, moments) = (values.parameters.slice_mut(), moments.slice_mut());
        state.extend(optimized("gaussians", parameters, moments).enumerate().map(
            |(plane, (name, buffer))| {
                let (shape, batches) = if plane == 0 { &of_parameters } else { &of_moments };
                StateTensor { name, shape: shape.clone(), buffer, batches: Some(*batches) }
            },
        ));
        for learnable in self.supervision.learnables() {
            let name = learnable.name();
            let AdamBuffers { parameters, moments, .. } = learnable.buffers();
            let shape = vec![parameters.len()];
            state.extend(optimized(name, parameters, moments).map(|(name, buffer)| StateTensor {
                name,
                shape: shape.clone(),
                buffer,
                batches: None,
            }));
        }
        if let Some((learning, (lamp, _))) = optimizer.lamp.as_mut().zip(renderer.lamp_and_status())
        {
            let (numbers, moments) = (lamp.numbers.slice_mut(), learning.moments.slice_mut());
            state.extend(optimized(LEARNED, numbers, moments).enumerate().map(
                |(plane, (name, buffer))| {
                    let len = if plane == 0 { LAMP_NUMBERS } else { LAMP_WIDTH };
                    StateTensor { name, shape: vec![len as usize], buffer, batches: None }
                },
            ));
        }
        state
    }
}

fn first_not_finite(values: &[f32]) -> Option<usize> {
    values.par_iter().position_first(|value| !value.is_finite())
}

/// The best model in a checkpoint.
fn best_of(file: &TensorFile<'_>) -> std::result::Result<Snapshot, String> {
    let of_best = |(name, _): &(String, &[u8])| name.starts_with(BEST);
    let tensors = file.tensors().into_iter().filter(of_best).map(|(name, _)| {
        let shape = file.tensor(&name).map_or(vec![], |(info, _)| info.shape.clone());
        let values = values(file, &name, Dtype::F32, None)?;
        Ok((name[BEST.len()..].to_owned(), shape, values))
    });
    tensors.collect()
}

/// The parameters and their moments, by tensor name.
fn optimized<'a>(
    owner: &str,
    parameters: SliceMut<'a, f32>,
    moments: Moments<SliceMut<'a, f32>>,
) -> impl Iterator<Item = (String, SliceMut<'a, f32>)> {
    let all = std::iter::once(("parameters", parameters)).chain(moments.into_planes());
    all.map(move |(name, buffer)| (format!("{owner}.{name}"), buffer))
}

/// The elements of a tensor, or its defect.
fn values<T: bytemuck::Pod>(
    file: &TensorFile<'_>,
    name: &str,
    dtype: Dtype,
    shape: Option<&[usize]>,
) -> std::result::Result<Vec<T>, String> {
    let (found, bytes) = file.tensor(name).ok_or_else(|| format!("it has no tensor `{name}`"))?;
    if found.dtype != dtype || shape.is_some_and(|shape| shape != found.shape) {
        return Err(format!("tensor `{name}` cannot be {:?} {}", found.shape, found.dtype));
    }
    Ok(bytemuck::pod_collect_to_vec(bytes))
}
