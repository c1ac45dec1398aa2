//! Training, step by step.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use nightsplat::train::{PlanSource, PlannedRun, RequestedSettings};
use nightsplat::{Ended, Preset, StepReport, Trainer};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::device::{PyDevice, opened};
use crate::model::PyModel;
use crate::{assignments, call, objects};

/// A step of a training.
#[pyclass(frozen, get_all, name = "Step", module = "nightsplat")]
pub(crate) struct PyStep {
    /// Its number, from 1.
    step: u64,
    /// The name of the view that was rendered.
    view: String,
    /// The loss: the weighted sum of the terms.
    loss: f64,
    /// The number of Gaussians rendered.
    gaussians: usize,
    /// Its share of the submission's time, milliseconds.
    milliseconds: f64,
}

impl From<StepReport> for PyStep {
    fn from(report: StepReport) -> Self {
        let StepReport { step, view, loss, gaussians, milliseconds, .. } = report;
        Self { step, view, loss, gaussians, milliseconds }
    }
}

/// A model in training: an iterator of its steps, which are done in batches of half a second, so that the model may be
/// ahead. Other threads of Python run meanwhile. Ctrl-C raises KeyboardInterrupt between two batches; the training can
/// go on then, or be saved.
#[pyclass(frozen, name = "Training", module = "nightsplat")]
pub(crate) struct PyTraining {
    state: Mutex<TrainingState>,
    /// Every setting, as config.toml has them.
    #[pyo3(get)]
    settings: Py<PyAny>,
    /// What the photographs decided, with reasons; None without a plan.
    #[pyo3(get)]
    plan: Py<PyAny>,
}

struct TrainingState {
    trainer: Trainer,
    /// Steps that are done, and not returned yet.
    reports: VecDeque<StepReport>,
    ended: Option<Ended>,
}

impl TrainingState {
    /// Trains for about half a second; at the end of the run, chooses its best model.
    fn advance(&mut self) -> nightsplat::Result<()> {
        if self.trainer.has_ended() {
            self.ended = Some(self.trainer.end()?);
        } else {
            self.reports.extend(self.trainer.advance(self.trainer.last_step())?);
        }
        Ok(())
    }
}

#[pymethods]
impl PyTraining {
    fn __iter__(training: PyRef<'_, Self>) -> PyRef<'_, Self> {
        training
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<PyStep>> {
        loop {
            py.check_signals()?;
            let (report, has_ended) = call(py, || {
                let mut state = self.lock();
                Ok((state.reports.pop_front(), state.ended.is_some()))
            })?;
            if report.is_some() || has_ended {
                return Ok(report.map(PyStep::from));
            }
            call(py, || self.lock().advance())?;
        }
    }

    /// The model as it is now; after the last step, the best of the run.
    fn model(&self, py: Python<'_>) -> PyResult<PyModel> {
        call(py, || self.lock().trainer.model()).map(PyModel)
    }

    /// Writes a checkpoint, from which `train(..., resume=path)` continues to the same bits.
    fn save_checkpoint(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        call(py, || self.lock().trainer.save_checkpoint(&path))
    }

    /// Why and where the training ended, in words; None before its end.
    #[getter]
    fn ended(&self, py: Python<'_>) -> PyResult<Option<String>> {
        call(py, || Ok(self.lock().ended.map(|ended| ended.to_string())))
    }
}

impl PyTraining {
    fn lock(&self) -> MutexGuard<'_, TrainingState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Trains on a folder with transforms*.json or a COLMAP model, as `nightsplat train` does: an iterator of steps, which
/// has the model. Settings are keys of config.toml, such as `steps=500` or `tone={"curve": "ap3"}`; the photographs
/// decide what is not set, unless `plan` is False or the preset sets everything. `resume` is a checkpoint to continue.
#[pyfunction]
#[pyo3(signature = (dataset, *, preset = None, plan = true, resume = None, device = None, **settings))]
pub(crate) fn train(
    py: Python<'_>,
    dataset: PathBuf,
    preset: Option<&str>,
    plan: bool,
    resume: Option<PathBuf>,
    device: Option<&Bound<'_, PyDevice>>,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<PyTraining> {
    let settings = settings.map_or_else(|| Ok(PyDict::new(py)), |given| given.copy())?;
    settings.set_item("dataset", dataset)?;
    // As the option: a stated length switches early stopping off, and with it the held-out views.
    let stated = settings.contains("steps")?.then(|| "stop.views=0".to_owned());
    let given = assignments(py, Some(&settings))?;
    let device = opened(py, device)?;
    let (trainer, run) = call(py, || {
        let preset = preset.map(str::parse::<Preset>).transpose()?;
        let mut requested = RequestedSettings { preset, ..RequestedSettings::default() };
        stated.iter().chain(&given).try_for_each(|one| requested.set.assign(one))?;
        let is_planned = plan && preset.is_none_or(Preset::is_planned);
        let source = if is_planned { PlanSource::Diagnosis } else { PlanSource::Nothing };
        let run = requested.planned(source, &device)?;
        let mut trainer = Trainer::new(&device, run.config.clone(), &run.dataset)?;
        if let Some(checkpoint) = resume {
            trainer.restore(&checkpoint)?;
        }
        Ok((trainer, run))
    })?;
    let PlannedRun { config, plan, .. } = run;
    Ok(PyTraining {
        state: Mutex::new(TrainingState { trainer, reports: VecDeque::new(), ended: None }),
        settings: objects(py, &config)?.unbind(),
        plan: objects(py, &plan)?.unbind(),
    })
}
