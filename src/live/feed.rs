//! The model and the progress that the live page shows: of a run, by its files or by the training in this process, or
//! of a model file.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::Vec3;
use hyper::body::Bytes;
use nightsplat_models::edit::operation::fingerprint;
use nightsplat_models::export::page::packed;
use nightsplat_models::gaussians::{Gaussians, ModelFacts};
use serde_json::{Value, json};

use crate::results::models;
use crate::results::run::{Event, Requests, Stamp, WatchedRun, stamp};
use crate::{Result, Stop};

/// The most Gaussians that are sent: those that cover most, by opacity and size.
const MOST_GAUSSIANS: usize = 500_000;
/// The shortest time between two snapshots of a training.
const SNAPSHOT_EVERY: Duration = Duration::from_secs(1);
/// The largest share of the training's time that snapshots may take.
const SNAPSHOT_SHARE: f64 = 0.04;
/// Progress is read from files at most this often, however many pages ask.
const STATE_EVERY: Duration = Duration::from_millis(250);
/// A page that has not asked for so long is closed, or hidden; others ask once a second.
const WATCHED_WITHIN: Duration = Duration::from_secs(2);

/// What is shown.
#[derive(Debug)]
enum FeedSource {
    Run(WatchedRun),
    /// A model file, read again when it changes.
    File(PathBuf),
    /// What does not change.
    Fixed,
}

/// The source of the model and the progress.
#[derive(Debug)]
pub(crate) struct Feed {
    /// To the training in this process.
    requests: Option<Requests>,
    state: Mutex<FeedState>,
}

#[derive(Debug)]
struct FeedState {
    source: FeedSource,
    /// Counts the models; 0: there is none yet.
    version: u64,
    model: Bytes,
    /// Steps of the model, if it is of the training in this process.
    step: Option<u64>,
    /// The last step of that training, once it is certain.
    last: Option<u64>,
    /// Time and length of the file that it was read from.
    file: Option<Stamp>,
    /// The checksum by which edit lists name a model file; `None` of a model that is no file, or not sent whole.
    fingerprint: Option<String>,
    /// Why the newest model cannot be shown, on one line.
    problem: Option<String>,
    /// How the training in this process ended.
    ended: Option<String>,
    /// When the next snapshot may be requested.
    next: Option<Instant>,
    /// When a page last asked.
    asked: Option<Instant>,
    /// The last answer.
    told: Option<(Instant, Value)>,
}

impl Feed {
    /// Of a run directory; `requests`: to its training, if that is in this process.
    pub(crate) fn of_run(run: &Path, requests: Option<Requests>) -> Self {
        let state = Mutex::new(FeedState::new(FeedSource::Run(WatchedRun::new(run.to_owned()))));
        Self { requests, state }
    }

    /// Of a model file, with its Gaussians.
    pub(crate) fn of_file(path: &Path) -> Result<(Self, Gaussians, ModelFacts)> {
        let mut state = FeedState::new(FeedSource::File(path.to_owned()));
        // Before reading: a file that changes meanwhile is read again.
        state.file = stamp(path).ok();
        let (gaussians, facts) = models::read(path)?;
        state.show_file(&gaussians);
        Ok((Self { requests: None, state: Mutex::new(state) }, gaussians, facts))
    }

    /// Of Gaussians that do not change.
    pub(crate) fn of_gaussians(gaussians: &Gaussians) -> Self {
        let mut state = FeedState::new(FeedSource::Fixed);
        state.show(gaussians, None);
        Self { requests: None, state: Mutex::new(state) }
    }

    /// Whether the model never changes.
    pub(crate) fn is_fixed(&self) -> bool {
        matches!(self.lock().source, FeedSource::Fixed)
    }

    /// Takes how the training in this process ended, on one line, and gives a page that is open the time to ask for it.
    pub(crate) fn end(&self, ended: &str) {
        let is_watched = {
            let mut state = self.lock();
            (state.told, state.ended) = (None, Some(ended.to_owned()));
            state.asked.is_some_and(|at| at.elapsed() < WATCHED_WITHIN)
        };
        if is_watched {
            std::thread::sleep(WATCHED_WITHIN);
        }
    }

    /// Takes what the training in this process reports.
    pub(crate) fn observe(&self, event: Event<'_>) {
        let begin = Instant::now();
        let mut state = self.lock();
        let (step, model, seconds) = match event {
            Event::Snapshot { step, model, seconds } => (step, model, seconds),
            Event::LastStep { last, .. } => return state.last = Some(last),
            _ => return,
        };
        state.show(&model.shown(), Some(step));
        let spent = seconds + begin.elapsed().as_secs_f64();
        let rest = Duration::from_secs_f64(spent / SNAPSHOT_SHARE).max(SNAPSHOT_EVERY);
        state.next = Some(Instant::now() + rest);
    }

    /// Fulfils a request of the page; false if there is no such request, or no training in this process.
    pub(super) fn follow(&self, what: &str) -> bool {
        let Some(requests) = &self.requests else { return false };
        match what {
            "pause" => requests.pause(true),
            "resume" => requests.pause(false),
            "save" => requests.save(),
            "finish" => requests.finish(),
            "stop" => requests.stop(Stop::Interrupted),
            _ => return false,
        }
        self.lock().told = None;
        true
    }

    /// The newest model, as the viewer reads it.
    pub(super) fn model(&self) -> Option<Bytes> {
        let state = self.lock();
        (state.version > 0).then(|| state.model.clone())
    }

    /// The file of the model, as it was saved last; `None` if there is none.
    pub(super) fn saved(&self) -> Option<Bytes> {
        let path = self.lock().path()?;
        std::fs::read(path).ok().map(Bytes::from)
    }

    /// Progress and the version of the model, as JSON. A page that asks is being watched, so a training in this process
    /// is asked for a snapshot.
    pub(super) fn state(&self) -> Value {
        let mut state = self.lock();
        state.asked = Some(Instant::now());
        if let Some((_, answer)) = state.told.as_ref().filter(|(at, _)| at.elapsed() < STATE_EVERY)
        {
            return answer.clone();
        }
        let now = Instant::now();
        match &self.requests {
            Some(requests) if state.next.is_none_or(|next| next <= now) => {
                requests.snapshot();
                state.next = Some(now + SNAPSHOT_EVERY);
            }
            Some(_) => {}
            None => state.read(),
        }
        let mut told = match &mut state.source {
            FeedSource::Run(run) => json!(run.tail()),
            FeedSource::File(_) | FeedSource::Fixed => json!({ "phase": "model" }),
        };
        let paused = self.requests.as_ref().is_some_and(Requests::is_paused);
        if paused {
            told["phase"] = "paused".into();
        }
        if state.last.is_some() {
            told["steps"] = state.last.into();
        }
        told["model"] = state.version.into();
        told["modelStep"] = state.step.into();
        told["fingerprint"] = state.fingerprint.clone().into();
        told["canControl"] = self.requests.is_some().into();
        told["problem"] = state.problem.clone().into();
        told["file"] = state.path().as_deref().and_then(saved_file).into();
        if state.ended.is_some() {
            (told["endedBy"], told["canControl"]) = (state.ended.clone().into(), false.into());
        }
        state.told = Some((now, told.clone()));
        told
    }

    fn lock(&self) -> MutexGuard<'_, FeedState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl FeedState {
    fn new(source: FeedSource) -> Self {
        Self {
            source,
            version: 0,
            model: Bytes::new(),
            step: None,
            last: None,
            file: None,
            fingerprint: None,
            problem: None,
            ended: None,
            next: None,
            asked: None,
            told: None,
        }
    }

    /// The file of the model.
    fn path(&self) -> Option<PathBuf> {
        match &self.source {
            FeedSource::Run(run) => Some(run.path().join("model.ply")),
            FeedSource::File(path) => Some(path.clone()),
            FeedSource::Fixed => None,
        }
    }

    /// Reads the model file if it has changed. A file that has vanished or is damaged leaves the last model.
    fn read(&mut self) {
        let Some(path) = self.path() else { return };
        let from = match &self.source {
            FeedSource::Run(run) => run.path().to_owned(),
            _ => path.clone(),
        };
        match stamp(&path) {
            Ok(found) if self.file == Some(found) => self.problem = None,
            Ok(found) => {
                self.file = Some(found);
                match models::read(&from) {
                    Ok((gaussians, _)) => self.show_file(&gaussians),
                    Err(error) => self.problem = Some(error.to_string()),
                }
            }
            Err(error) if self.version > 0 => {
                self.problem =
                    Some(format!("{} is gone ({error}); the last model is shown", path.display()));
            }
            // The first checkpoint of a run is still to come.
            Err(_) => {}
        }
    }

    /// Shows the model of a file.
    fn show_file(&mut self, gaussians: &Gaussians) {
        self.show(gaussians, None);
        let is_whole = gaussians.count <= MOST_GAUSSIANS;
        self.fingerprint = is_whole.then(|| fingerprint(gaussians));
    }

    fn show(&mut self, gaussians: &Gaussians, step: Option<u64>) {
        self.model = packed(&most_visible(gaussians, MOST_GAUSSIANS)).into();
        (self.step, self.problem) = (step, None);
        self.version += 1;
    }
}

/// The name of a file, and what changes when it is written.
fn saved_file(path: &Path) -> Option<Value> {
    let (time, bytes) = stamp(path).ok()?;
    let name = path.file_name()?.to_string_lossy();
    Some(json!({ "name": name, "saved": format!("{time:?} {bytes}") }))
}

/// The `most` Gaussians with the largest product of opacity and area, in their order.
fn most_visible(gaussians: &Gaussians, most: usize) -> Cow<'_, Gaussians> {
    if gaussians.count <= most {
        return Cow::Borrowed(gaussians);
    }
    let opacity = |raw: f32| 1.0 / (1.0 + (-raw).exp());
    let area = |scale: Vec3| (scale.element_sum() - scale.min_element()).exp();
    let scales = gaussians.log_scales().iter();
    let seen: Vec<f32> = gaussians
        .raw_opacities()
        .iter()
        .zip(scales)
        .map(|(&raw, &scale)| opacity(raw) * area(scale))
        .collect();
    let mut order: Vec<usize> = (0..seen.len()).collect();
    order.select_nth_unstable_by(most, |&a, &b| seen[b].total_cmp(&seen[a]).then(a.cmp(&b)));
    let mut keep = vec![false; seen.len()];
    order[..most].iter().for_each(|&index| keep[index] = true);
    let mut kept = gaussians.clone();
    kept.retain(&keep);
    Cow::Owned(kept)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_models::gaussians::{Features, Shape};

    fn model(opacities: &[f32]) -> Gaussians {
        let shape = Shape { sh_degree: 0, features: Features::NONE };
        let mut gaussians = Gaussians::zeros(opacities.len(), shape);
        gaussians.raw_opacities_mut().copy_from_slice(opacities);
        gaussians.quats_mut().fill([1.0, 0.0, 0.0, 0.0]);
        gaussians
    }

    #[test]
    fn of_too_many_gaussians_those_that_cover_most_are_sent_in_their_order() {
        let mut gaussians = model(&[3.0, -2.0, 1.0, 2.0]);
        gaussians.log_scales_mut()[1] = Vec3::splat(4.0);
        let kept = most_visible(&gaussians, 3);
        assert_eq!(kept.raw_opacities(), [3.0, -2.0, 2.0]);
        assert_eq!(most_visible(&gaussians, 4).count, 4);
    }

    #[test]
    fn a_model_file_is_shown_again_when_it_changes_and_stays_when_it_vanishes() {
        let folder = tempfile::tempdir().unwrap();
        let feed = Feed::of_run(folder.path(), None);
        assert_eq!((feed.state()["model"].as_u64(), feed.model()), (Some(0), None));
        let path = folder.path().join("model.ply");
        assert!(Feed::of_file(&path).is_err());
        model(&[0.5]).save(&path).unwrap();
        let (feed, gaussians, _) = Feed::of_file(&path).unwrap();
        assert_eq!((feed.lock().version, gaussians), (1, model(&[0.5])));
        assert_eq!(feed.state()["model"], 1, "the file is read once");
        let state = || {
            feed.lock().told = None;
            feed.state()
        };
        model(&[1.0]).save(&path).unwrap();
        std::fs::write(&path, "ply").unwrap();
        state();
        model(&[1.0]).save(&path).unwrap();
        let shown = state();
        assert_eq!((shown["model"].as_u64(), shown["fingerprint"].is_string()), (Some(2), true));
        let first = feed.model().unwrap();
        assert_eq!(state()["model"], 2);
        assert_eq!(feed.saved().unwrap(), std::fs::read(&path).unwrap());
        let before = state()["file"].clone();
        assert_eq!(before["name"], "model.ply");
        model(&[1.0, 2.0]).save(&path).unwrap();
        assert_ne!(state()["file"], before);
        assert_eq!(state()["model"], 3);
        assert_ne!(feed.model().unwrap(), first);
        std::fs::write(&path, "ply\n").unwrap();
        assert!(state()["problem"].as_str().unwrap().contains("model.ply"));
        std::fs::remove_file(&path).unwrap();
        let gone = state();
        assert!(gone["problem"].as_str().unwrap().contains("is gone"), "{gone}");
        assert!(gone["file"].is_null() && feed.saved().is_none());
        assert_eq!((gone["model"].as_u64(), gone["canControl"].as_bool()), (Some(3), Some(false)));
        assert!(!feed.follow("stop"));
    }

    #[test]
    fn a_page_asks_the_training_for_a_model_at_a_bounded_rate_and_controls_it() {
        let requests = Requests::default();
        let feed = Feed::of_run(Path::new("no such run"), Some(requests.clone()));
        assert_eq!(feed.state()["model"], 0);
        assert!(requests.takes_snapshot());
        feed.lock().told = None;
        feed.state();
        assert!(!requests.takes_snapshot(), "within a second");
        let model = crate::splats::model::Model::of_shown(model(&[1.0]), &Default::default());
        feed.observe(Event::Snapshot { step: 7, model: &model, seconds: 10.0 });
        feed.lock().told = None;
        let state = feed.state();
        assert_eq!((state["model"].as_u64(), state["modelStep"].as_u64()), (Some(1), Some(7)));
        let wait = feed.lock().next.unwrap() - Instant::now();
        assert!(wait > Duration::from_secs(200), "a slow snapshot is repeated after {wait:?}");
        assert!(feed.follow("pause") && requests.is_paused());
        assert_eq!(feed.state()["phase"], "paused");
        assert!(feed.follow("resume") && !requests.is_paused());
        feed.observe(Event::LastStep { step: 7, last: 12 });
        assert!(feed.follow("finish") && feed.state()["steps"] == 12);
        assert!(feed.follow("stop") && requests.stops() == Some(Stop::Interrupted));
        assert!(!feed.follow("format"));
    }
}
