//! The run directory: what a run leaves behind.
//!
//! ```text
//! RUN/config.toml    everything the run used
//!     plan.toml      what was decided for these photographs and why, where a plan was made
//!     model.ply      the Gaussians, as splat viewers open them
//!     networks.safetensors    the weights of the networks, where the model has any
//!     train.csv      one line per step
//!     held_out.csv   scores of the views that were kept from training, where there are any
//!     evals.csv      scores of the test views on the way, with what it took, where they are asked for
//!     views.csv      every view, what it is for and how large it is
//!     tensorboard/   the same for `TensorBoard`, where that is asked for
//!     exposures.csv  gain and bias of the training views, where they are learned
//!     hashes.csv     checksums of the parameters on the way, where they are asked for
//!     checkpoint.safetensors  what the run goes on from, overwritten every so many steps
//!     checkpoint.before.safetensors    the one before, for where that is damaged
//!     metrics.json   scores of the test views
//!     done.json      that the run is whole, and of which configuration and dataset it is
//! ```
//!
//! A file appears under its name only once it is complete, `metrics.json` and `done.json` last: a directory that has them is
//! whole. The model is written with every checkpoint, too: a run that was stopped can be looked at. While a process trains
//! in it, it holds `.lock`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::backup::{self, Backup};
use super::files::*;
use super::generations;
use super::ledger;
use super::lock::RunLock;
pub use super::progress::Progress;
use super::tensorboard::EventFile;
use crate::base::output::{csv_field, write_whole};
use crate::gpu::Gpu;
use crate::loss::Term;
use crate::loss::exposure::{Affine, table};
use crate::photographs::dataset::{Dataset, Split, View};
use crate::splats::scene::{Gaussians, ply};
use crate::train::diagnose::Plan;
use crate::train::{Networks, Settings, StepReport, TrainConfig, Trainer};
use crate::{Error, Result};

/// A run directory and the log that grows in it.
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    log: BufWriter<File>,
    /// The columns of the log between loss and Gaussians.
    terms: Vec<Term>,
    /// What the steps took that the log held already.
    seconds_before: f64,
    /// Whether what it replaces is still there.
    is_new: bool,
    /// The run that was here before; back in its place if this is dropped before [`RunDirectory::settle`].
    backup: Backup,
    /// Behind `backup`: nobody else begins before that is in order.
    _lock: RunLock,
}

impl RunDirectory {
    /// Refuses a place where no run can begin, before anything is loaded or written.
    ///
    /// # Errors
    /// Another process trains there; it holds a run already and `overwrite` is false; it holds files of a run's names that
    /// are no run's; or it lies beneath a file.
    pub fn check(path: &Path, overwrite: bool) -> Result<()> {
        let used = FILES.iter().find(|file| path.join(file).exists());
        match used.filter(|_| !overwrite) {
            Some(file) => RunLock::check(path).and(Err(held(path, file))),
            None => Self::check_resumed(path),
        }
    }

    /// Refuses a place where no run can begin or go on.
    ///
    /// # Errors
    /// Another process trains there, or it holds files of a run's names that are no run's, or lies beneath a file.
    pub fn check_resumed(path: &Path) -> Result<()> {
        RunLock::check(path)?;
        if let Some(file) = FILES.iter().find(|file| path.join(file).exists())
            && !is_run(path)
        {
            let problem = format!(
                "holds {file}, but no config.toml of a run: it is somebody else's; name another folder"
            );
            return Err(Error::output(path, problem));
        }
        match path.ancestors().find(|folder| folder.exists()) {
            Some(file) if !file.is_dir() => {
                Err(unwritable(path, &std::io::ErrorKind::NotADirectory.into()))
            }
            _ => Ok(()),
        }
    }

    /// Locks the directory, which comes to be where it is not there, and puts it in order.
    ///
    /// # Errors
    /// Another process trains there, or it cannot be written.
    pub(super) fn lock(path: &Path) -> Result<RunLock> {
        std::fs::create_dir_all(path).map_err(|error| unwritable(path, &error))?;
        let lock = RunLock::take(path)?;
        backup::recover(path)?;
        Ok(lock)
    }

    /// Writes the configuration into a directory that is locked. A run that was there before stays until [`RunDirectory::settle`].
    ///
    /// # Errors
    /// It holds a run already and `overwrite` is false, or it cannot be written.
    pub(super) fn create_locked(
        path: &Path,
        lock: RunLock,
        config: &TrainConfig,
        overwrite: bool,
    ) -> Result<Self> {
        // What was recovered is a run, too.
        if let Some(file) = FILES.iter().find(|file| path.join(file).exists() && !overwrite) {
            return Err(held(path, file));
        }
        let backup = Backup::set(path)?;
        let mut run = Self::open(path, config, "", 0.0, backup, lock)?;
        let columns: String = run.terms.iter().map(|term| format!("{},", term.column)).collect();
        run.log_line(&format!("step,view,loss,{columns}gaussians,milliseconds"))?;
        Ok(run)
    }

    /// The run has come to be: what was there before goes.
    ///
    /// # Errors
    /// The directory cannot be written.
    pub fn settle(&mut self) -> Result<()> {
        self.backup.give_up()?;
        if std::mem::take(&mut self.is_new) { remove_events(&self.path) } else { Ok(()) }
    }

    /// Takes up a run again after `step`: its log is cut there, and it is unfinished.
    ///
    /// # Errors
    /// The directory cannot be written, or its log does not reach `step`.
    pub(super) fn resume(
        path: &Path,
        lock: RunLock,
        config: &TrainConfig,
        step: u64,
    ) -> Result<Self> {
        generations::keep_whole(path)?;
        let log_path = path.join(LOG);
        let text = std::fs::read_to_string(&log_path)
            .map_err(|error| Error::input(&log_path, format!("cannot be read ({error})")))?;
        // The header and a line per step; the last line may be cut short.
        let lines: Vec<&str> = text.split_inclusive('\n').take(step as usize + 1).collect();
        let last = lines.last().filter(|line| line.starts_with(&format!("{step},")));
        if last.is_none_or(|line| !line.ends_with('\n')) {
            let problem =
                format!("ends before step {step} of the checkpoint; begin anew with --overwrite");
            return Err(Error::input(&log_path, problem));
        }
        let milliseconds = |line: &&str| line.trim_end().rsplit(',').next()?.parse::<f64>().ok();
        let seconds_before = lines.iter().filter_map(milliseconds).sum::<f64>() / 1e3;
        remove(path, &[DONE, "metrics.json", "model.ply", NETWORKS, EXPOSURES])?;
        Self::open(path, config, &lines.concat(), seconds_before, Backup::default(), lock)
    }

    /// Writes the configuration and what the log begins with.
    fn open(
        path: &Path,
        config: &TrainConfig,
        log: &str,
        seconds_before: f64,
        backup: Backup,
        lock: RunLock,
    ) -> Result<Self> {
        let recorded = config.clone().with_absolute_paths();
        write_whole(&path.join("config.toml"), recorded.to_toml()?.as_bytes())?;
        let log_path = path.join(LOG);
        write_whole(&log_path, log.as_bytes())?;
        let file = File::options().append(true).open(&log_path);
        let file = BufWriter::new(file.map_err(|error| unwritable(&log_path, &error))?);
        let terms = config.loss().terms();
        let (path, is_new) = (path.to_owned(), log.is_empty());
        Ok(Self { path, log: file, terms, seconds_before, is_new, backup, _lock: lock })
    }

    /// Writes the scores of the held-out views: step, PSNR in dB.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn save_held_out(&self, scores: &[(u64, f64)]) -> Result<()> {
        let lines = scores.iter().map(|(step, psnr)| format!("{step},{psnr}\n"));
        let text = "step,psnr\n".to_owned() + &lines.collect::<String>();
        write_whole(&self.path.join(HELD_OUT), text.as_bytes())
    }

    /// How the run came up to a step.
    pub(super) fn progress(&self, step: u64) -> Vec<Progress> {
        let mut progress = load_progress(&self.path);
        progress.retain(|one| one.step <= step);
        progress
    }

    /// Writes how the run came so far.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub(super) fn save_progress(&self, progress: &[Progress]) -> Result<()> {
        let lines: String = progress.iter().map(Progress::line).collect();
        let text = format!("{}\n{lines}", Progress::COLUMNS);
        write_whole(&self.path.join(PROGRESS), text.as_bytes())
    }

    /// Writes the configuration with who says each value.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub(super) fn save_config(
        &self,
        config: &TrainConfig,
        settings: &Settings,
        gpu: &Gpu,
    ) -> Result<()> {
        let text = settings.written(&config.clone().with_absolute_paths())?;
        let text = format!("# trained with {}\n{text}", trained_with(gpu));
        write_whole(&self.path.join("config.toml"), text.as_bytes())
    }

    /// Writes the plan that the configuration follows.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn save_plan(&self, plan: &Plan) -> Result<()> {
        write_whole(&self.path.join(PLAN), plan.to_toml()?.as_bytes())
    }

    /// Writes which views there are, for whoever opens the run with another copy of them.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn save_views(&self, dataset: &Dataset) -> Result<()> {
        let lines: String = view_lines(dataset).into_iter().map(|line| line + "\n").collect();
        let text = format!("name,split,width,height\n{lines}");
        write_whole(&self.path.join(VIEWS), text.as_bytes())
    }

    /// Begins event files for `TensorBoard`, behind a step.
    pub(super) fn events(&self, step: u64) -> Result<EventFile> {
        EventFile::create(&self.path.join(TENSORBOARD), step)
    }

    /// What the steps took that a resumed run had behind it, in seconds.
    pub fn seconds_before(&self) -> f64 {
        self.seconds_before
    }

    /// Writes what the run can go on from, behind a log that reaches as far, and the model as it is now. The checkpoint
    /// before stays; while this is written it is the only one.
    ///
    /// # Errors
    /// The disk is full or gone, the device was lost, or a parameter is not finite.
    pub fn save_checkpoint(&mut self, trainer: &mut Trainer) -> Result<()> {
        self.log.flush().map_err(|error| unwritable(&self.path, &error))?;
        let newest = generations::rotate(&self.path)?;
        trainer.save_checkpoint(&newest)?;
        self.save_trained(trainer)
    }

    /// Writes the model and what belongs to it, as it is now.
    ///
    /// # Errors
    /// The disk is full or gone, the device was lost, or a parameter is not finite.
    pub(super) fn save_trained(&mut self, trainer: &mut Trainer) -> Result<()> {
        self.save_model(trainer)?;
        if let Some(networks) = trainer.networks() {
            self.save_networks(networks)?;
        }
        match trainer.exposures()? {
            Some(exposures) => self.save_exposures(&exposures),
            None => Ok(()),
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Appends the checksum of every plane of the parameters to `hashes.csv`.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub(super) fn log_hashes(&self, step: u64, gaussians: &Gaussians) -> Result<()> {
        let path = self.path.join(HASHES);
        let known = std::fs::read_to_string(&path).unwrap_or_default();
        let text = ledger::extended(&known, step, gaussians);
        write_whole(&path, text.as_bytes())
    }

    /// Appends a step to `train.csv`.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn log(&mut self, report: &StepReport) -> Result<()> {
        let StepReport { step, view, loss, gaussians, milliseconds, .. } = report;
        let terms: String =
            self.terms.iter().map(|&term| format!("{:.6},", report.term(term))).collect();
        let view = csv_field(view);
        self.log_line(&format!("{step},{view},{loss:.6},{terms}{gaussians},{milliseconds:.2}"))
    }

    /// What was logged is in the file, for whoever watches.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn flush_log(&mut self) -> Result<()> {
        self.log.flush().map_err(|error| unwritable(&self.path, &error))
    }

    /// Writes `model.ply`, in the colours that viewers show and in the dataset's world.
    ///
    /// # Errors
    /// The disk is full or gone, or a parameter is not finite.
    pub fn save_model(&mut self, trainer: &Trainer) -> Result<()> {
        self.flush_log()?;
        let in_frame = trainer.gaussians_in_frame()?;
        trainer.refuse_not_finite(&in_frame)?;
        let model = trainer.model_of(&in_frame);
        let comments = model.facts().comments();
        ply::save_with_comments(&model.shown(), self.path.join("model.ply"), &comments)
    }

    /// Writes the weights of the networks.
    ///
    /// # Errors
    /// The disk is full or gone, or the device was lost.
    pub fn save_networks(&self, networks: &Networks) -> Result<()> {
        networks.save(&self.path.join(NETWORKS))
    }

    /// Writes the exposures of the training views.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn save_exposures(&self, exposures: &[(String, Affine)]) -> Result<()> {
        table::save(&self.path.join(EXPOSURES), exposures)
    }

    /// Writes `metrics.json`, the sign that the run is whole.
    ///
    /// # Errors
    /// The disk is full or gone.
    pub fn save_metrics(&self, metrics: &serde_json::Value) -> Result<()> {
        write_whole(&self.path.join("metrics.json"), format!("{metrics:#}\n").as_bytes())
    }

    fn log_line(&mut self, line: &str) -> Result<()> {
        writeln!(self.log, "{line}").map_err(|error| unwritable(&self.path, &error))
    }
}

/// How a run came to where it is; nothing where its test views were scored at the end alone.
pub fn load_progress(run: &Path) -> Vec<Progress> {
    let text = std::fs::read_to_string(run.join(PROGRESS)).unwrap_or_default();
    text.lines().filter_map(Progress::parse).collect()
}

/// A line for every view.
pub(super) fn view_lines(dataset: &Dataset) -> Vec<String> {
    let line = |view: &View| {
        let split = match view.split {
            Split::Train => "train",
            Split::Test => "test",
            Split::HeldOut => "held_out",
        };
        format!("{},{split},{},{}", view.name, view.camera.width, view.camera.height)
    };
    dataset.views.iter().map(line).collect()
}

/// Whether a directory holds a run, be it of another version: a configuration with what every one has.
fn is_run(path: &Path) -> bool {
    let text = std::fs::read_to_string(path.join("config.toml")).unwrap_or_default();
    let table = text.parse::<toml::Table>().unwrap_or_default();
    ["dataset", "steps", "seed", "tone"].iter().all(|key| table.contains_key(*key))
}

fn held(path: &Path, file: &str) -> Error {
    let problem = format!("already holds a run ({file}); --overwrite replaces it");
    Error::output(path, problem)
}

fn remove(run: &Path, files: &[&str]) -> Result<()> {
    for file in files.iter().map(|file| run.join(file)).filter(|file| file.exists()) {
        std::fs::remove_file(&file).map_err(|error| unwritable(&file, &error))?;
    }
    Ok(())
}

fn remove_events(run: &Path) -> Result<()> {
    let folder = run.join(TENSORBOARD);
    let Ok(entries) = std::fs::read_dir(&folder) else { return Ok(()) };
    for file in entries.flatten().map(|entry| entry.path()) {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with("events.out.tfevents.") && name.ends_with(".nightsplat") {
            std::fs::remove_file(&file).map_err(|error| unwritable(&file, &error))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::run::{load_config, load_gaussians};

    fn create(path: &Path, config: &TrainConfig, overwrite: bool) -> Result<RunDirectory> {
        RunDirectory::check(path, overwrite)?;
        RunDirectory::create_locked(path, RunDirectory::lock(path)?, config, overwrite)
    }

    #[test]
    fn a_run_is_only_replaced_when_asked() {
        let folder = tempfile::tempdir().unwrap();
        let config = TrainConfig::default();
        drop(create(folder.path(), &config, false).unwrap());
        std::fs::write(folder.path().join("notes.txt"), "mine").unwrap();
        let error = create(folder.path(), &config, false).unwrap_err();
        assert!(error.to_string().contains("--overwrite"), "{error}");
        drop(create(folder.path(), &config, true).unwrap());
        assert!(folder.path().join("notes.txt").exists());
        assert_eq!(load_config(folder.path()).unwrap(), config);
    }

    #[test]
    fn an_unfinished_run_has_no_model() {
        let folder = tempfile::tempdir().unwrap();
        assert!(load_config(folder.path()).unwrap_err().to_string().contains("config.toml"));
        drop(create(folder.path(), &TrainConfig::default(), false).unwrap());
        let refused = load_gaussians(folder.path()).unwrap_err().to_string();
        assert!(refused.contains("did not finish"), "{refused}");
    }

    #[test]
    fn a_run_that_goes_on_keeps_its_progress_up_to_there() {
        let folder = tempfile::tempdir().unwrap();
        let run = create(folder.path(), &TrainConfig::default(), false).unwrap();
        assert!(run.progress(9).is_empty());
        let progress = |step, seconds, joules| Progress {
            step,
            views: 2,
            psnr: 24.5,
            psnr_channel_mean: 25.0,
            ssim: 0.75,
            seconds,
            processor_seconds: None,
            joules,
            gaussians: 7,
        };
        let progress = [progress(2, 0.5, None), progress(4, 1.25, Some(30.5))];
        run.save_progress(&progress).unwrap();
        assert_eq!(load_progress(folder.path()), progress);
        assert_eq!(run.progress(3), progress[..1]);
    }

    #[test]
    fn a_directory_that_cannot_be_made_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        let error = create(&file.join("run"), &TrainConfig::default(), false).unwrap_err();
        assert!(error.to_string().contains("file"), "{error}");
    }
}
