//! Names of the files of a run directory, and the error if one cannot be written.

use std::path::Path;

use crate::Error;
use crate::gpu::Gpu;

/// The files of a run that a new run replaces; nothing else in the directory is touched.
pub(super) const FILES: [&str; 15] = [
    DONE,
    "metrics.json",
    "model.ply",
    NETWORKS,
    EXPOSURES,
    LAMP,
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

/// PSNR of the held-out views against their targets.
pub(super) const HELD_OUT: &str = "held_out.csv";

/// Intermediate scores of the test views, with time and energy.
pub(super) const PROGRESS: &str = "evals.csv";

/// Name, split and size of every view.
pub(super) const VIEWS: &str = "views.csv";

/// The folder of event files.
pub(super) const TENSORBOARD: &str = "tensorboard";

/// Checksums of the parameters.
pub(super) const HASHES: &str = "hashes.csv";

/// Settings decided from the photographs, with reasons.
pub(super) const PLAN: &str = "plan.toml";

/// Key of the gain of the model, the exposure of the photographs and the gains of the views, in `metrics.json`.
pub(crate) const TARGET_EXPOSURE: &str = "target_exposure";

/// Key of the resources of the steps, other than seconds, in `metrics.json`.
pub(crate) const SPENT: &str = "spent";

/// How the run ended, in `metrics.json`.
pub(crate) const ENDED: &str = "ended";

/// Version of nightsplat and device of the run, in `metrics.json` and `done.json`.
pub(crate) const TRAINED_WITH: &str = "trained_with";

/// The last scores of the held-out views and their spread, in `metrics.json`.
pub(crate) const HELD_OUT_CURVE: &str = "held_out";

/// Gain and bias of the training views.
pub(super) const EXPOSURES: &str = "exposures.csv";

/// The lamp that moves with the camera.
pub(super) const LAMP: &str = "lamp.json";

/// The weights of the networks.
pub(super) const NETWORKS: &str = "networks.safetensors";

/// Marks a complete run.
pub(super) const DONE: &str = "done.json";

/// The state of an unfinished run, or of a finished one that may be extended.
pub(super) const CHECKPOINT: &str = "checkpoint.safetensors";

/// The previous checkpoint.
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

/// The error for a file of the run that cannot be written.
pub(super) fn unwritable(path: &Path, error: &std::io::Error) -> Error {
    Error::output(path, format!("cannot be written ({error}); check the folder and the disk"))
}
