//! The progress of a run, by the last lines of its files: for who watches a run of another process.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use nightsplat_core::csv;
use nightsplat_core::lock::FolderLock;
use serde::Serialize;

use super::files::{ENDED, HELD_OUT, LOG};
use super::load::{is_finished, load_config, load_metrics};

/// The state of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Phase {
    /// A process works in its directory.
    Training,
    /// Its directory is complete.
    Finished,
    /// Neither: it was stopped or killed.
    Stopped,
}

/// The progress of a run. Numbers that its files do not have are `None`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct RunTail {
    pub(crate) phase: Phase,
    /// The last step in the log.
    pub(crate) step: Option<u64>,
    /// The most steps that the run may take.
    pub(crate) steps: Option<u64>,
    pub(crate) loss: Option<f64>,
    pub(crate) gaussians: Option<u64>,
    /// Mean time of a step, over the last lines of the log.
    pub(crate) milliseconds: Option<f64>,
    /// PSNR of the held-out views against their targets, dB, by step.
    pub(crate) held_out: Vec<(u64, f64)>,
    /// How the run ended.
    pub(crate) ended: Option<serde_json::Value>,
}

/// The bytes at the end of the log that are read: some 60 lines.
const TAIL: u64 = 4096;

/// A run whose progress is read again and again.
#[derive(Debug)]
pub(crate) struct WatchedRun {
    path: PathBuf,
    /// Time and length of the configuration, and its steps: a resumed run may have more.
    steps: Option<(Stamp, Option<u64>)>,
}

impl WatchedRun {
    pub(crate) fn new(path: PathBuf) -> Self {
        Self { path, steps: None }
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the ends of its files. What is missing or being written is left out.
    pub(crate) fn tail(&mut self) -> RunTail {
        let stamp = stamp(&self.path.join("config.toml")).ok();
        if self.steps.map(|(stamp_read, _)| stamp_read) != stamp {
            let steps = load_config(&self.path).ok().map(|config| config.steps);
            self.steps = stamp.map(|stamp| (stamp, steps));
        }
        RunTail::read(&self.path, self.steps.and_then(|(_, steps)| steps))
    }
}

/// When a file was changed, and its length.
pub(crate) type Stamp = (SystemTime, u64);

/// The stamp of a file, by which it is read again once it changes.
pub(crate) fn stamp(path: &Path) -> std::io::Result<Stamp> {
    let file = path.metadata()?;
    Ok((file.modified()?, file.len()))
}

impl RunTail {
    fn read(run: &Path, steps: Option<u64>) -> Self {
        let rows = last_rows(&run.join(LOG)).unwrap_or_default();
        let last = rows.last();
        let times: Vec<f64> = rows.iter().map(|row| row.milliseconds).collect();
        let held_out = std::fs::read_to_string(run.join(HELD_OUT)).unwrap_or_default();
        let score = |line: &str| {
            let (step, psnr) = line.split_once(',')?;
            Some((step.parse().ok()?, psnr.parse().ok()?))
        };
        let is_training = FolderLock::check(run).is_err();
        Self {
            phase: match (is_training, is_finished(run)) {
                (true, _) => Phase::Training,
                (false, true) => Phase::Finished,
                (false, false) => Phase::Stopped,
            },
            step: last.map(|row| row.step),
            steps,
            loss: last.map(|row| row.loss).filter(|loss| loss.is_finite()),
            gaussians: last.map(|row| row.gaussians),
            milliseconds: last.map(|_| times.iter().sum::<f64>() / times.len() as f64),
            held_out: held_out.lines().filter_map(score).collect(),
            ended: is_finished(run)
                .then(|| load_metrics(run)[ENDED].take())
                .filter(|ended| !ended.is_null()),
        }
    }
}

struct RunLogRow {
    step: u64,
    loss: f64,
    gaussians: u64,
    milliseconds: f64,
}

impl RunLogRow {
    /// Parses a whole line of the log: step, view, loss, the terms, Gaussians, milliseconds.
    fn parse(line: &str) -> Option<Self> {
        let cells = csv::cells(line);
        let [gaussians, milliseconds] = cells.last_chunk()?;
        Some(Self {
            step: cells[0].parse().ok()?,
            loss: cells.get(2)?.parse().ok()?,
            gaussians: gaussians.parse().ok()?,
            milliseconds: milliseconds.parse().ok()?,
        })
    }
}

/// The whole lines at the end of the log.
fn last_rows(log: &Path) -> std::io::Result<Vec<RunLogRow>> {
    let mut file = File::open(log)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
    let mut bytes = Vec::new();
    file.take(TAIL).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    // The first line may be cut; the last may not be written to its end.
    let lines = text.split_inclusive('\n').skip(1).filter_map(|line| line.strip_suffix('\n'));
    Ok(lines.filter_map(RunLogRow::parse).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tail_of_a_log_is_read_while_its_last_line_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let long: String = (1..=200)
            .map(|step| format!("{step},\"a,\"\"b\",0.25,0.1,0.2,{},8.00\n", 10 * step))
            .collect();
        let log =
            format!("step,view,loss,l1,ssim,gaussians,milliseconds\n{long}201,\"a,\"\"b\",0.2");
        std::fs::write(folder.path().join(LOG), log).unwrap();
        std::fs::write(folder.path().join(HELD_OUT), "step,psnr\n100,20.5\n200,2").unwrap();
        let tail = WatchedRun::new(folder.path().into()).tail();
        let known = (tail.step, tail.loss, tail.gaussians, tail.milliseconds);
        assert_eq!(known, (Some(200), Some(0.25), Some(2000), Some(8.0)));
        assert_eq!((tail.phase, tail.steps), (Phase::Stopped, None));
        assert_eq!(tail.held_out[0], (100, 20.5));
    }

    #[test]
    fn the_steps_of_a_run_are_read_again_once_its_configuration_changes() {
        let folder = tempfile::tempdir().unwrap();
        let mut run = WatchedRun::new(folder.path().into());
        assert_eq!(run.tail().steps, None);
        let write = |steps: u64| {
            let config = crate::train::TrainConfig { steps, ..Default::default() };
            std::fs::write(folder.path().join("config.toml"), config.to_toml().unwrap()).unwrap();
        };
        write(700);
        assert_eq!(run.tail().steps, Some(700));
        let known = run.steps;
        assert_eq!((run.tail().steps, run.steps), (Some(700), known));
        write(12_000);
        assert_eq!(run.tail().steps, Some(12_000));
    }

    #[test]
    fn a_folder_without_files_of_a_run_has_no_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let tail = WatchedRun::new(folder.path().into()).tail();
        assert_eq!((tail.step, tail.loss, tail.held_out.len()), (None, None, 0));
        assert_eq!(serde_json::json!(tail)["phase"], "stopped");
    }
}
