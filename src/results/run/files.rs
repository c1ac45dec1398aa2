//! The names of the files of a run directory, and what is said where one cannot be written.

use std::path::Path;

use crate::Error;
use crate::gpu::Gpu;

/// The files of a run that a new run replaces; nothing else in the directory is touched.
pub(super) const FILES: [&str; 14] = [
    DONE,
    "metrics.json",
    "model.ply",
    NETWORKS,
    EXPOSURES,
    CHECKPOINT,
    CHECKPOINT_BEFORE,
    LOG,
    HELD_OUT,
    PROGRESS,
    HASHES,
    VIEWS,
    PLAN,
    "config.toml",
];

/// A line per step.
pub(super) const LOG: &str = "train.csv";

/// PSNR of the views that were kept from training, against their targets.
pub(super) const HELD_OUT: &str = "held_out.csv";

/// Scores of the test views on the way, and what it took.
pub(super) const PROGRESS: &str = "evals.csv";

/// Name, split and size of every view.
pub(super) const VIEWS: &str = "views.csv";

/// The folder of event files.
pub(super) const TENSORBOARD: &str = "tensorboard";

/// Checksums of the parameters on the way.
pub(super) const HASHES: &str = "hashes.csv";

/// What was decided for the photographs, and why.
pub(super) const PLAN: &str = "plan.toml";

/// Where `metrics.json` holds the [`crate::train::TargetExposure`].
pub(crate) const TARGET_EXPOSURE: &str = "target_exposure";

/// Where `metrics.json` holds what the steps took beside seconds.
pub(crate) const SPENT: &str = "spent";

/// How the run ended, in `metrics.json`.
pub(crate) const ENDED: &str = "ended";

/// Version of nightsplat and device of the run, in `metrics.json` and `done.json`.
pub(crate) const TRAINED_WITH: &str = "trained_with";

/// The last scores of the held-out views and their spread, in `metrics.json`.
pub(crate) const HELD_OUT_CURVE: &str = "held_out";

/// Gain and bias of the training views.
pub(super) const EXPOSURES: &str = "exposures.csv";

/// The weights of the networks.
pub(super) const NETWORKS: &str = "networks.safetensors";

/// The sign that the run is whole, and what it is of.
pub(super) const DONE: &str = "done.json";

/// The state of an unfinished run, or of a finished one that may be made longer.
pub(super) const CHECKPOINT: &str = "checkpoint.safetensors";

/// The one before.
pub(super) const CHECKPOINT_BEFORE: &str = "checkpoint.before.safetensors";

/// The value of [`TRAINED_WITH`].
pub(super) fn trained_with(gpu: &Gpu) -> serde_json::Value {
    let properties = gpu.properties();
    serde_json::json!({
        "nightsplat": env!("CARGO_PKG_VERSION"),
        "device": properties.name,
        "driver": properties.driver,
    })
}

/// The error of a file of the run that cannot be written.
pub(super) fn unwritable(path: &Path, error: &std::io::Error) -> Error {
    Error::output(path, format!("cannot be written ({error}); check the folder and the disk"))
}
