//! `done.json` marks a complete run, with checksums of its configuration and dataset, for schedulers and for repeated
//! commands.

use std::path::Path;

use nightsplat_core::output::{flush_to_disk, own_file, write_whole};
use nightsplat_photographs::dataset::{Dataset, Fingerprint};
use serde::{Deserialize, Serialize};

use super::files::{DONE, FILES, trained_with};
use crate::gpu::Gpu;
use crate::train::{Ended, TrainConfig};
use crate::{Error, Result};

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Done {
    /// Checksum of the settings that affect the result.
    configuration: String,
    /// Checksum of the training data.
    dataset: String,
    /// [`Dataset::stamp`]; `None` if the dataset is not in a folder.
    #[serde(skip_serializing_if = "Option::is_none")]
    stamp: Option<String>,
    /// The last step.
    steps: u64,
    /// How it ended.
    ended: Ended,
    /// Version and device.
    trained_with: serde_json::Value,
}

/// Writes the file, once all others are on the disk.
pub(super) fn save(
    run: &Path,
    config: &TrainConfig,
    dataset: &Fingerprint,
    stamp: Option<String>,
    ended: &Ended,
    gpu: &Gpu,
) -> Result<()> {
    let done = Done {
        configuration: config.checksum()?,
        dataset: dataset.checksum(),
        stamp,
        steps: ended.step,
        ended: *ended,
        trained_with: trained_with(gpu),
    };
    let text =
        serde_json::to_string_pretty(&done).map_err(|error| Error::Usage(error.to_string()))?;
    flush_to_disk(run, &FILES)?;
    write_whole(&own_file(run.join(DONE))?, (text + "\n").as_bytes())?;
    flush_to_disk(run, &[DONE])
}

/// The file, if it exists and those of the run do.
fn load(run: &Path) -> Option<Done> {
    let text = std::fs::read_to_string(run.join(DONE)).unwrap_or_default();
    let is_whole = ["model.ply", "metrics.json"].iter().all(|file| run.join(file).is_file());
    serde_json::from_str::<Done>(&text).ok().filter(|_| is_whole)
}

/// The last step of the run in a directory, if it is complete and of this configuration and dataset.
pub fn done_steps(run: &Path, config: &TrainConfig, dataset: &Dataset) -> Result<Option<u64>> {
    let Some(done) = load(run) else { return Ok(None) };
    let is_same = done.configuration == config.checksum()?
        && done.dataset == Fingerprint::compute(dataset)?.checksum();
    Ok(is_same.then_some(done.steps))
}

/// [`done_steps`] without reading a photograph: `None` if the modification times of the dataset's files have changed,
/// whatever their contents.
pub fn done_steps_by_stamp(run: &Path, config: &TrainConfig) -> Result<Option<u64>> {
    let Some(Done { stamp: Some(stamp), configuration, steps, .. }) = load(run) else {
        return Ok(None);
    };
    let is_same = configuration == config.checksum()?
        && Dataset::stamp(&config.dataset, &config.load_options())
            .is_ok_and(|current| current == stamp);
    Ok(is_same.then_some(steps))
}
