//! `--window`: of a run, a model, or a training in this process.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::ViewArgs;
use super::newest::{Files, InTraining};
use super::window::Opening;
pub(in crate::cli) use super::window::Screen;
use crate::Result;
use crate::cli::live::Pictures;
use crate::gpu::DeviceChoice;
use crate::photographs::dataset::Dataset;
use crate::results::finished_run::{config_of_file, is_model};
use crate::results::run::{self, Requests};

/// Shows a run or a model until the window is closed.
pub(super) fn run(args: &ViewArgs) -> Result<()> {
    let path = &args.path;
    let mut files = Files::open(path)?;
    let config = match (is_model(path), &args.dataset) {
        (true, None) => None,
        (true, dataset) => {
            let model = files.model();
            Some(config_of_file(&model.gaussians, &model.facts(), dataset.as_deref()))
        }
        (false, dataset) => {
            let mut config = run::load_config(path)?;
            dataset.iter().for_each(|dataset| config.move_dataset(dataset));
            Some(config)
        }
    };
    let title = path.display().to_string();
    let opening = match config {
        Some(config) => Opening::of_dataset(title, Pictures::load(config, None)?.dataset()),
        None => Opening::of_gaussians(title, &files.model().gaussians),
    };
    let (frames, screenshot) = (args.frames, args.screenshot.clone());
    let choice = args.device.clone().unwrap_or(DeviceChoice::Best);
    Screen::open(&choice)?.show(Opening { frames, screenshot, ..opening }, &mut files)
}

/// The display of this machine, for a training that is watched in a window.
pub(in crate::cli) fn screen(choice: &DeviceChoice) -> Result<Screen> {
    Screen::open(choice)
}

/// Trains in another thread, and shows the model in a window until it is closed or the training is over.
pub(in crate::cli) fn beside<T: Send>(
    screen: Screen,
    (run, dataset): (&Path, &Dataset),
    requests: &Requests,
    train: impl FnOnce() -> Result<T> + Send,
) -> Result<T> {
    let has_ended = Arc::new(AtomicBool::new(false));
    let mut models = InTraining::new(run, requests.clone(), Arc::clone(&has_ended));
    let opening = Opening::of_dataset(run.display().to_string(), dataset);
    std::thread::scope(|scope| {
        let training = scope.spawn(|| {
            let trained = train();
            has_ended.store(true, Ordering::Release);
            trained
        });
        if let Err(error) = screen.show(opening, &mut models) {
            tracing::warn!("{error}; the training goes on without a window");
        }
        requests.pause(false);
        match training.join() {
            Ok(trained) => trained,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}
