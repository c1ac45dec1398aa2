//! A training run from the first step to the last file: the `train` command without its progress bar.

mod backup;
mod directory;
mod done;
mod events;
mod files;
mod generations;
mod ledger;
mod load;
mod meter;
mod progress;
mod requests;
mod tail;
mod train;

pub use directory::{RunDirectory, RunProgress, load_progress};
pub use done::{done_steps, done_steps_by_stamp};
pub use events::{Event, RunSummary};
pub(crate) use files::{ENDED, HELD_OUT_CURVE, SPENT, TARGET_EXPOSURE, TRAINED_WITH};
pub use generations::has_checkpoint;
pub(crate) use load::{RecordedExposure, load_target_exposure};
pub use load::{
    is_finished, load_config, load_exposures, load_gaussians, load_lamp, load_metrics,
    load_networks, other_views, plan_of, stopped_at,
};
pub use meter::{ResourceUsage, energy_counters};
pub use requests::Requests;
pub(crate) use tail::{Stamp, WatchedRun, stamp};
pub use train::{IfExists, Session, train, train_in};
