//! A training run from its first step to its last file: what the command does, without its progress bar.

mod directory;
mod events;
mod train;

#[cfg(feature = "cli")]
pub(crate) use directory::TARGET_EXPOSURE;
pub use directory::{
    RunDirectory, is_finished, load_config, load_exposures, load_metrics, load_model,
    load_networks, plan_of,
};
pub use events::Event;
pub use train::{HeldRun, Trained, train, train_planned};
