//! The run directory.
//!
//! ```text
//! RUN/config.toml    every setting
//!     plan.toml      settings decided from the photographs, with reasons, if a plan was made
//!     model.ply      the Gaussians, for splat viewers
//!     networks.safetensors    the weights of the networks, if any
//!     train.csv      one line per step
//!     held_out.csv   scores of the held-out views, if any
//!     evals.csv      intermediate scores of the test views, with time and energy, if requested
//!     views.csv      name, split and size of every view
//!     tensorboard/   logs for `TensorBoard`, if requested
//!     exposures.csv  gain and bias of the training views, if learned
//!     hashes.csv     checksums of the parameters, if requested
//!     checkpoint.safetensors  state to resume from, overwritten regularly
//!     checkpoint.before.safetensors    the previous checkpoint, in case the newest is damaged
//!     metrics.json   scores of the test views
//!     done.json      marks a complete run, with checksums of configuration and dataset
//! ```
//!
//! A file appears under its name when it is complete, `metrics.json` and `done.json` last: a directory with them is
//! complete. The model is written with every checkpoint, so that an interrupted run can be viewed. `.lock` exists while
//! a process trains in the directory.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use nightsplat_core::csv;
use nightsplat_core::lock::FolderLock;
use nightsplat_core::output::{flush_to_disk, own_file, write_whole};
use nightsplat_models::gaussians::{Gaussians, ply};
use nightsplat_photographs::dataset::{Dataset, Split, View};
use nightsplat_report::tensorboard::EventFile;

use super::backup::{self, Backup};
use super::files::*;
use super::generations;
use super::ledger;
pub use super::progress::RunProgress;
use crate::gpu::Gpu;
use crate::loss::Term;
use crate::train::plan::Plan;
use crate::train::{Networks, Settings, StepReport, TrainConfig, Trainer};
use crate::{Error, Result};
use nightsplat_photographs::exposures::{Affine, table};

/// A run directory and its growing log.
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    log: BufWriter<File>,
    /// The columns of the log between loss and Gaussians.
    terms: Vec<Term>,
    /// Seconds of the steps that the log already contained.
    seconds_before: f64,
    /// Whether the run that it replaces still exists.
    is_new: bool,
    /// The previous run; restored if this is dropped before [`RunDirectory::settle`].
    backup: Backup,
    /// Declared after `backup`: the lock is released after the backup is restored.
    _lock: FolderLock,
}

impl RunDirectory {
    /// Checks that a run can begin here, before anything is loaded or written.
    pub fn check(path: &Path, overwrite: bool) -> Result<()> {
        let used = FILES.iter().find(|file| path.join(file).exists());
        match used.filter(|_| !overwrite) {
            Some(file) => FolderLock::check(path).and(Err(held(path, file))),
            None => Self::check_resumed(path),
        }
    }

    /// Checks that a run can begin or resume here.
    pub fn check_resumed(path: &Path) -> Result<()> {
        FolderLock::check(path)?;
        if let Some(file) = FILES.iter().find(|file| path.join(file).exists())
            && !is_run(path)
        {
            let problem =
                format!("contains {file}, but no config.toml of a run; name another folder");
            return Err(Error::output(path, problem));
        }
        match path.ancestors().find(|folder| folder.exists()) {
            Some(file) if !file.is_dir() => {
                Err(unwritable(path, &std::io::ErrorKind::NotADirectory.into()))
            }
            _ => Ok(()),
        }
    }

    /// Creates the directory if necessary, locks it, and cleans up after a killed process.
    pub(crate) fn lock(path: &Path) -> Result<FolderLock> {
        std::fs::create_dir_all(path).map_err(|error| unwritable(path, &error))?;
        let lock = FolderLock::take(path)?;
        backup::recover(path)?;
        Ok(lock)
    }

    /// Writes the configuration into a locked directory. A previous run is kept until [`RunDirectory::settle`].
    pub(super) fn create_locked(
        path: &Path,
        lock: FolderLock,
        config: &TrainConfig,
        overwrite: bool,
    ) -> Result<Self> {
        // A recovered run counts, too.
        if let Some(file) = FILES.iter().find(|file| path.join(file).exists() && !overwrite) {
            return Err(held(path, file));
        }
        let backup = Backup::set(path)?;
        let mut run = Self::open(path, config, "", 0.0, backup, lock)?;
        let columns: String = run.terms.iter().map(|term| format!("{},", term.column)).collect();
        run.log_line(&format!("step,view,loss,{columns}gaussians,milliseconds"))?;
        Ok(run)
    }

    /// Deletes the previous run, once this one has begun.
    pub fn settle(&mut self) -> Result<()> {
        self.backup.give_up()?;
        if std::mem::take(&mut self.is_new) { remove_events(&self.path) } else { Ok(()) }
    }

    /// Resumes a run after `step`: truncates its log there, and marks it as unfinished.
    pub(super) fn resume(
        path: &Path,
        lock: FolderLock,
        config: &TrainConfig,
        step: u64,
    ) -> Result<Self> {
        generations::keep_whole(path)?;
        let log_path = path.join(LOG);
        let text = std::fs::read_to_string(&log_path)
            .map_err(|error| Error::input(&log_path, format!("cannot be read ({error})")))?;
        // The header and a line per step; the last line may be truncated.
        let lines: Vec<&str> = text.split_inclusive('\n').take(step as usize + 1).collect();
        let last = lines.last().filter(|line| line.starts_with(&format!("{step},")));
        if last.is_none_or(|line| !line.ends_with('\n')) {
            let problem =
                format!("ends before step {step} of the checkpoint; start again with --overwrite");
            return Err(Error::input(&log_path, problem));
        }
        let milliseconds = |line: &&str| line.trim_end().rsplit(',').next()?.parse::<f64>().ok();
        let seconds_before = lines.iter().filter_map(milliseconds).sum::<f64>() / 1e3;
        remove(path, &[DONE, "metrics.json", "model.ply", NETWORKS, EXPOSURES])?;
        Self::open(path, config, &lines.concat(), seconds_before, Backup::default(), lock)
    }

    /// Writes the configuration and the header of the log.
    fn open(
        path: &Path,
        config: &TrainConfig,
        log: &str,
        seconds_before: f64,
        backup: Backup,
        lock: FolderLock,
    ) -> Result<Self> {
        let recorded = config.clone().with_absolute_paths();
        let config_path = own_file(path.join("config.toml"))?;
        write_whole(&config_path, recorded.to_toml()?.as_bytes())?;
        let log_path = own_file(path.join(LOG))?;
        write_whole(&log_path, log.as_bytes())?;
        let file = File::options().append(true).open(&log_path);
        let file = BufWriter::new(file.map_err(|error| unwritable(&log_path, &error))?);
        let terms = config.loss().terms();
        let (path, is_new) = (path.to_owned(), log.is_empty());
        Ok(Self { path, log: file, terms, seconds_before, is_new, backup, _lock: lock })
    }

    /// Writes the scores of the held-out views: step, PSNR in dB.
    pub fn save_held_out(&self, scores: &[(u64, f64)]) -> Result<()> {
        let lines = scores.iter().map(|(step, psnr)| format!("{step},{psnr}\n"));
        let text = "step,psnr\n".to_owned() + &lines.collect::<String>();
        write_whole(&self.own_file(HELD_OUT)?, text.as_bytes())
    }

    /// The intermediate scores up to a step.
    pub(super) fn progress(&self, step: u64) -> Vec<RunProgress> {
        let mut progress = load_progress(&self.path);
        progress.retain(|one| one.step <= step);
        progress
    }

    /// Writes the intermediate scores.
    pub(super) fn save_progress(&self, progress: &[RunProgress]) -> Result<()> {
        let lines: String = progress.iter().map(RunProgress::line).collect();
        let text = format!("{}\n{lines}", RunProgress::COLUMNS);
        write_whole(&self.own_file(PROGRESS)?, text.as_bytes())
    }

    /// Writes the configuration with the origin of each value.
    pub(super) fn save_config(
        &self,
        config: &TrainConfig,
        settings: &Settings,
        gpu: &Gpu,
    ) -> Result<()> {
        let text = settings.written(&config.clone().with_absolute_paths())?;
        let text = format!("# trained with {}\n{text}", trained_with(gpu));
        write_whole(&self.own_file("config.toml")?, text.as_bytes())
    }

    /// Writes the plan that the configuration follows.
    pub fn save_plan(&self, plan: &Plan) -> Result<()> {
        write_whole(&self.own_file(PLAN)?, plan.to_toml()?.as_bytes())
    }

    /// Writes the list of views, to detect that a dataset has changed.
    pub fn save_views(&self, dataset: &Dataset) -> Result<()> {
        let text = format!("name,split,width,height\n{}", view_lines(dataset).concat());
        write_whole(&self.own_file(VIEWS)?, text.as_bytes())
    }

    /// Creates event files for `TensorBoard`, for steps after `step`.
    pub(super) fn events(&self, step: u64) -> Result<EventFile> {
        EventFile::create(&self.path.join(TENSORBOARD), step)
    }

    /// Seconds of the steps before a resumed run.
    pub fn seconds_before(&self) -> f64 {
        self.seconds_before
    }

    /// Flushes to the disk what resuming needs besides the checkpoint, then writes that and the model. The previous
    /// checkpoint is kept, the only one until this is complete.
    pub fn save_checkpoint(&mut self, trainer: &mut Trainer) -> Result<()> {
        let _phase = tracing::info_span!("files").entered();
        self.flush_log()?;
        flush_to_disk(&self.path, &["config.toml", PLAN, VIEWS, LOG, HELD_OUT, PROGRESS])?;
        let newest = generations::rotate(&self.path)?;
        trainer.save_checkpoint(&newest)?;
        self.save_trained(trainer)
    }

    /// Writes the current model with its networks, lamp and exposures.
    pub(super) fn save_trained(&mut self, trainer: &mut Trainer) -> Result<()> {
        let _phase = tracing::info_span!("files").entered();
        self.save_model(trainer)?;
        if let Some(networks) = trainer.networks() {
            self.save_networks(networks)?;
        }
        if let Some(lamp) = trainer.lamp()? {
            let text = serde_json::json!(lamp);
            write_whole(&self.own_file(LAMP)?, format!("{text:#}\n").as_bytes())?;
        }
        match trainer.exposures()? {
            Some(exposures) => self.save_exposures(&exposures),
            None => Ok(()),
        }
    }

    /// The path of the directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Appends the checksum of every parameter plane to `hashes.csv`.
    pub(super) fn log_hashes(&self, step: u64, gaussians: &Gaussians) -> Result<()> {
        let path = self.own_file(HASHES)?;
        let recorded = std::fs::read_to_string(&path).unwrap_or_default();
        let text = ledger::extended(&recorded, step, gaussians);
        write_whole(&path, text.as_bytes())
    }

    /// Appends a step to `train.csv`.
    pub fn log(&mut self, report: &StepReport) -> Result<()> {
        let StepReport { step, view, loss, gaussians, milliseconds, .. } = report;
        let terms: String =
            self.terms.iter().map(|&term| format!("{:.6},", report.term(term))).collect();
        let view = csv::field(view);
        self.log_line(&format!("{step},{view},{loss:.6},{terms}{gaussians},{milliseconds:.2}"))
    }

    /// The path of a file of the run, free of links.
    fn own_file(&self, file: &str) -> Result<PathBuf> {
        own_file(self.path.join(file))
    }

    /// Flushes the log for other readers.
    pub fn flush_log(&mut self) -> Result<()> {
        self.log.flush().map_err(|error| unwritable(&self.path, &error))
    }

    /// Writes `model.ply`, in the colours that viewers expect and in the dataset's world.
    pub fn save_model(&mut self, trainer: &Trainer) -> Result<()> {
        self.flush_log()?;
        let in_frame = trainer.gaussians_in_frame()?;
        trainer.refuse_not_finite(&in_frame)?;
        let model = trainer.model_of(&in_frame);
        let comments = model.facts().comments();
        ply::save_with_comments(&model.shown(), self.own_file("model.ply")?, &comments)
    }

    /// Writes the weights of the networks.
    pub fn save_networks(&self, networks: &Networks) -> Result<()> {
        networks.save(&self.own_file(NETWORKS)?)
    }

    /// Writes the exposures of the training views.
    pub fn save_exposures(&self, exposures: &[(String, Affine)]) -> Result<()> {
        table::save(&self.own_file(EXPOSURES)?, exposures)
    }

    /// Writes `metrics.json`, which marks a complete run.
    pub fn save_metrics(&self, metrics: &serde_json::Value) -> Result<()> {
        write_whole(&self.own_file("metrics.json")?, format!("{metrics:#}\n").as_bytes())
    }

    fn log_line(&mut self, line: &str) -> Result<()> {
        writeln!(self.log, "{line}").map_err(|error| unwritable(&self.path, &error))
    }
}

/// The intermediate scores of a run; empty if the test views were scored at the end only.
pub fn load_progress(run: &Path) -> Vec<RunProgress> {
    let text = std::fs::read_to_string(run.join(PROGRESS)).unwrap_or_default();
    text.lines().filter_map(RunProgress::parse).collect()
}

/// A line for every view, with its line break.
pub(super) fn view_lines(dataset: &Dataset) -> Vec<String> {
    let line = |view: &View| {
        let split = match view.split {
            Split::Train => "train",
            Split::Test => "test",
            Split::HeldOut => "held_out",
        };
        let size = [view.camera.width, view.camera.height].map(|length| length.to_string());
        csv::line([&view.name, split, &size[0], &size[1]])
    };
    dataset.views.iter().map(line).collect()
}

/// Whether a directory contains a run of any version: a configuration with the keys that all have.
fn is_run(path: &Path) -> bool {
    let text = std::fs::read_to_string(path.join("config.toml")).unwrap_or_default();
    let table = text.parse::<toml::Table>().unwrap_or_default();
    ["dataset", "steps", "seed", "tone"].iter().all(|key| table.contains_key(*key))
}

fn held(path: &Path, file: &str) -> Error {
    let problem = format!("already contains a run ({file}); --overwrite replaces it");
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
    use glam::DAffine3;

    use super::*;
    use crate::results::run::{load_config, load_gaussians, other_views};
    use nightsplat_core::camera::Camera;

    fn create(path: &Path, config: &TrainConfig, overwrite: bool) -> Result<RunDirectory> {
        RunDirectory::check(path, overwrite)?;
        RunDirectory::create_locked(path, RunDirectory::lock(path)?, config, overwrite)
    }

    #[test]
    fn a_run_is_only_replaced_on_request() {
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
    fn views_of_any_name_are_a_field_each_and_recognised_again() {
        let folder = tempfile::tempdir().unwrap();
        let run = create(folder.path(), &TrainConfig::default(), false).unwrap();
        let view = |name| {
            View::new(
                name,
                Split::Train,
                Camera::perspective(DAffine3::IDENTITY, 1.0, [8, 4]),
                None,
            )
        };
        let views = ["a,b \"c\"", "=1+1", "two\nlines"].map(view).to_vec();
        let dataset = Dataset { root: "set".into(), views, points: vec![], skipped: vec![] };
        run.save_views(&dataset).unwrap();
        let text = std::fs::read_to_string(folder.path().join(VIEWS)).unwrap();
        let lines = ["\"a,b \"\"c\"\"\",train,8,4", "'=1+1,train,8,4", "two\\nlines,train,8,4"];
        assert_eq!(text.lines().skip(1).collect::<Vec<_>>(), lines);
        assert_eq!(other_views(folder.path(), &dataset), None);
        // As runs before quoted none.
        std::fs::write(
            folder.path().join(VIEWS),
            "name,split,width,height\na,b \"c\",train,8,4\n=1+1,train,8,4\ntwo\\nlines,train,8,4\n",
        )
        .unwrap();
        assert_eq!(other_views(folder.path(), &dataset), None);
    }

    #[test]
    fn an_unfinished_run_has_no_model() {
        let folder = tempfile::tempdir().unwrap();
        assert!(load_config(folder.path()).unwrap_err().to_string().contains("config.toml"));
        drop(create(folder.path(), &TrainConfig::default(), false).unwrap());
        let refused = load_gaussians(folder.path()).unwrap_err().to_string();
        assert!(refused.contains("neither finished"), "{refused}");
    }

    #[test]
    fn a_resumed_run_keeps_its_scores_up_to_the_checkpoint() {
        let folder = tempfile::tempdir().unwrap();
        let run = create(folder.path(), &TrainConfig::default(), false).unwrap();
        assert!(run.progress(9).is_empty());
        let progress = |step, seconds, joules| RunProgress {
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
    fn the_error_names_a_directory_that_cannot_be_created() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        let error = create(&file.join("run"), &TrainConfig::default(), false).unwrap_err();
        assert!(error.to_string().contains("file"), "{error}");
    }
}
