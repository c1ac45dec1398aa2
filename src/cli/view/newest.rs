//! The models that a window shows: of files, or of a training on the same device.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::Result;
use crate::camera::TrainingFrame;
use crate::gpu::Gpu;
use crate::results::run::{Requests, RunTail, Stamp, WatchedRun, stamp};
use crate::splats::model::Model;
use crate::splats::render::{Purpose, RenderSettings};
use crate::train::ShownModel;

/// What a window shows.
pub(crate) trait Newest {
    /// The model, if it is newer than the last one.
    fn newest(&mut self, gpu: &Gpu) -> Result<Option<ShownModel>>;

    /// Progress in words that follow the name of the model.
    fn progress(&mut self) -> String;

    /// Pauses a training, or continues it.
    fn pause(&mut self) {}

    /// Whether there is nothing more to show, and the window closes.
    fn has_ended(&self) -> bool {
        false
    }
}

/// A model file, or a run whose training, if any, is in another process.
#[derive(Debug)]
pub(crate) struct Files {
    /// What is opened.
    path: PathBuf,
    file: PathBuf,
    run: Option<WatchedRun>,
    /// Time and length of the file of `model`.
    stamp: Option<Stamp>,
    model: Model,
    is_new: bool,
}

impl Files {
    /// Reads a run or a model file.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let (file, run) = match path.is_dir() {
            true => (path.join("model.ply"), Some(WatchedRun::new(path.to_owned()))),
            false => (path.to_owned(), None),
        };
        // Before reading: a file that changes meanwhile is read again.
        let stamp = stamp(&file).ok();
        let model = Model::load(path)?;
        Ok(Self { path: path.to_owned(), file, run, stamp, model, is_new: true })
    }

    pub(crate) fn model(&self) -> &Model {
        &self.model
    }
}

impl Newest for Files {
    /// A file that has vanished or is damaged leaves the last model.
    fn newest(&mut self, gpu: &Gpu) -> Result<Option<ShownModel>> {
        let found = stamp(&self.file).ok();
        if found.is_some() && found != self.stamp {
            self.stamp = found;
            match Model::load(&self.path) {
                Ok(model) => (self.model, self.is_new) = (model, true),
                Err(error) => tracing::warn!("{error}; the last model is shown"),
            }
        }
        if !std::mem::take(&mut self.is_new) {
            return Ok(None);
        }
        let model = &self.model;
        Ok(Some(ShownModel {
            gaussians: model.gaussians.upload(gpu)?,
            settings: RenderSettings { purpose: Purpose::Show, ..model.render_settings() },
            sh_degree: model.gaussians.shape.sh_degree,
            frame: TrainingFrame { center: model.gaussians.origin.to_array(), scale: 1.0 },
        }))
    }

    fn progress(&mut self) -> String {
        self.run.as_mut().map(|run| words(&run.tail())).unwrap_or_default()
    }
}

/// A training of this process, in another thread.
#[derive(Debug)]
pub(crate) struct InTraining {
    requests: Requests,
    run: WatchedRun,
    has_ended: Arc<AtomicBool>,
}

impl InTraining {
    /// `has_ended` tells that the training is over.
    pub(crate) fn new(run: &Path, requests: Requests, has_ended: Arc<AtomicBool>) -> Self {
        Self { requests, run: WatchedRun::new(run.to_owned()), has_ended }
    }
}

impl Newest for InTraining {
    fn newest(&mut self, _: &Gpu) -> Result<Option<ShownModel>> {
        let shown = self.requests.take_shown();
        if !self.requests.is_paused() || shown.is_none() {
            self.requests.show();
        }
        Ok(shown)
    }

    fn progress(&mut self) -> String {
        let paused = if self.requests.is_paused() { ", paused" } else { "" };
        words(&self.run.tail()) + paused
    }

    fn pause(&mut self) {
        self.requests.pause(!self.requests.is_paused());
    }

    fn has_ended(&self) -> bool {
        self.has_ended.load(Ordering::Acquire)
    }
}

fn words(tail: &RunTail) -> String {
    let step = tail.step.map(|step| format!(": step {step}"));
    let loss = tail.loss.map(|loss| format!(", loss {loss:.4}"));
    let score = tail.held_out.last().map(|(_, psnr)| format!(", {psnr:.2} dB"));
    let count = tail.gaussians.map(|count| format!(", {count} Gaussians"));
    let time = tail.milliseconds.map(|time| format!(", {time:.0} ms a step"));
    [step, loss, score, count, time].into_iter().flatten().collect()
}
