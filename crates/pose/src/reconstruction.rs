//! Runs COLMAP on the brightened photographs: features, matches, cameras.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nightsplat_core::output::{create_folder, duration};
use nightsplat_photographs::dataset::Dataset;

use super::pictures::{PosePhotographs, is_dark};
use super::stages::StageProgress;
use super::tool::Tool;
use super::unfinished::Unfinished;
use super::{PoseOptions, PoseProgress, cameras};
use nightsplat_core::{Error, Result};

/// The pairs of photographs that COLMAP matches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Matcher {
    /// Every pair
    Exhaustive,
    /// Neighbours by name
    Sequential,
}

impl Matcher {
    fn command(self) -> &'static str {
        match self {
            Self::Exhaustive => "exhaustive_matcher",
            Self::Sequential => "sequential_matcher",
        }
    }
}

/// The features that are found in photographs, and matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PoseFeatures {
    /// SIFT, matched by distance
    Sift,
    /// ALIKED, matched by LightGlue: networks that COLMAP fetches once (COLMAP from 4.0 on, built with ONNX)
    Learned,
}

/// The mapper that registers cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Mapper {
    /// One by one (COLMAP's mapper)
    Incremental,
    /// All at once (GLOMAP, or COLMAP from 4.0 on)
    Global,
}

/// The programs and files of one reconstruction.
pub(super) struct Reconstruction<'a> {
    colmap: Tool<'a>,
    /// GLOMAP, if it registers the cameras.
    glomap: Option<Tool<'a>>,
    options: &'a PoseOptions,
    /// How many, dark and bright.
    photographs: usize,
    matcher: Matcher,
    features: PoseFeatures,
    /// Whether this COLMAP has learned features.
    can_learn: bool,
    /// Whether matching uses the two-view geometry that it found before.
    is_guided: bool,
    /// Options of the mapper that relax the choice of the initial pair.
    relaxed: &'static [(&'static str, &'static str)],
    /// The user's options: command, name and value.
    user_options: Vec<(&'static str, String, String)>,
    out: &'a Unfinished,
    /// The end of the time for further attempts.
    until: Option<Instant>,
    /// Of the features, with their matches.
    database: PathBuf,
    models: PathBuf,
}

/// The models of an attempt, and the number of dark photographs in the one with the most of them: 0 if its calibration
/// cannot be.
struct Attempt {
    models: PathBuf,
    placed: usize,
}

impl Attempt {
    fn read(models: &Path) -> Result<Self> {
        let mut attempt = Self { models: models.to_owned(), placed: 0 };
        if let Some((model, placed)) = Dataset::largest_model(models, is_dark)? {
            match cameras::mostly_impossible(&Dataset::lenses(&model)?) {
                Some(problem) => {
                    tracing::warn!(
                        "cameras without a possible calibration do not count, {problem}"
                    );
                }
                None => attempt.placed = placed.iter().filter(|name| is_dark(name)).count(),
            }
        }
        Ok(attempt)
    }

    /// Takes another that has more.
    fn improve(&mut self, models: &Path) -> Result<()> {
        let found = Self::read(models)?;
        if found.placed > self.placed {
            *self = found;
        }
        Ok(())
    }
}

/// Relaxations of the initial pair, for few photographs: a smaller baseline, motion along the viewing direction, and
/// fewer common features than COLMAP requires by default.
const RELAXED: [&[(&str, &str)]; 2] = [
    &[("Mapper.init_min_tri_angle", "6"), ("Mapper.init_min_num_inliers", "50")],
    &[
        ("Mapper.init_min_tri_angle", "2"),
        ("Mapper.init_max_forward_motion", "1"),
        ("Mapper.init_min_num_inliers", "50"),
    ],
];

/// The least time of a first attempt that those after it are measured by, seconds: enough to fetch networks.
const LEAST_FIRST: f64 = 60.0;

/// The option of learned features in `feature_extractor`, and what a COLMAP prints that cannot use them.
const LEARNED_OPTION: &str = "AlikedExtraction.max_num_features";
const NO_NETWORKS: &str = "requires ONNX support";
const NOT_FETCHED: [&str; 2] = ["Failed to download file", "Download failed after"];

/// Options with their values.
type Options = Vec<(String, OsString)>;

impl<'a> Reconstruction<'a> {
    /// Sets up the folder, and checks that the programs exist.
    pub(super) fn new(
        settings: &'a PoseOptions,
        colmap: Tool<'a>,
        matcher: Matcher,
        out: &'a Unfinished,
    ) -> Result<Self> {
        let is_global = settings.mapper == Mapper::Global;
        let needs_glomap = is_global && !colmap.help_contains(&["help"], GLOBAL);
        let glomap = || colmap.beside(&settings.glomap, "glomap").found();
        let glomap = needs_glomap.then(glomap).transpose()?;
        let can_learn = colmap.has_option("feature_extractor", LEARNED_OPTION);
        if settings.features == Some(PoseFeatures::Learned) && !can_learn {
            let problem = "--features learned: this COLMAP has no ALIKED features; name COLMAP 4.0 or later with \
                           --colmap PATH, or take --features sift";
            return Err(Error::Usage(problem.to_owned()));
        }
        let mapper = if is_global && !needs_glomap { GLOBAL } else { "mapper" };
        let commands = ["feature_extractor", matcher.command(), mapper];
        let mut user_options = vec![];
        for option in &settings.colmap_options {
            let (name, value) = option.split_once('=').ok_or_else(|| {
                Error::Usage(format!("--colmap-option {option} is not NAME=VALUE"))
            })?;
            let name = name.trim_start_matches("--");
            let tool = |command| {
                if command == mapper { glomap.as_ref().unwrap_or(&colmap) } else { &colmap }
            };
            let command =
                commands.into_iter().find(|command| tool(*command).has_option(command, name));
            let command = command.ok_or_else(|| {
                Error::Usage(format!(
                    "--colmap-option {option}: none of {} has {name}; `colmap mapper -h` lists those of the mapper",
                    commands.join(", ")
                ))
            })?;
            user_options.push((command, name.to_owned(), value.to_owned()));
        }
        Ok(Self {
            colmap,
            glomap,
            options: settings,
            photographs: 0,
            matcher,
            features: settings.features.unwrap_or(PoseFeatures::Sift),
            can_learn,
            is_guided: false,
            relaxed: &[],
            user_options,
            out,
            until: None,
            database: PathBuf::new(),
            models: PathBuf::new(),
        })
    }

    /// The features of the attempts, in a line.
    pub(super) fn plan(&self) -> Option<&'static str> {
        match (self.features, self.tries_learned()) {
            (PoseFeatures::Learned, _) => Some("learned features: ALIKED, matched by LightGlue"),
            (_, true) => {
                Some("SIFT features; if most photographs have no camera, learned ones too")
            }
            _ => None,
        }
    }

    /// Whether the first attempt, if it finds few, is followed by one with learned features.
    fn tries_learned(&self) -> bool {
        self.options.features.is_none() && self.can_learn
    }

    /// The folder of the models, each a folder; it is empty if nothing could be reconstructed.
    ///
    /// If most of the dark photographs have no camera, learned features are tried where this COLMAP has them, and kept
    /// if they give more. If more than a tenth have none, all are matched again, guided: without it, the result of a
    /// small set depends on chance; always matching guided would double the time of a large one. If most still have
    /// none, the choice of the initial pair is relaxed. Cameras whose calibration cannot be count as none: another
    /// attempt mostly finds another one. All of this together takes [`PoseOptions::patience`] times the time of the
    /// first attempt at most. Stages that an earlier call has done are not repeated.
    pub(super) fn models(
        mut self,
        pictures: &PosePhotographs,
        report: &dyn Fn(PoseProgress<'_>),
    ) -> Result<PathBuf> {
        self.photographs = pictures.dark.len() + pictures.bright.len();
        self.attempt(pictures, report)?;
        let all = pictures.dark.len();
        let mut best = Attempt::read(&self.models)?;
        if 10 * best.placed >= 9 * all || self.options.patience == 0.0 {
            return Ok(best.models);
        }
        let first = ["matching", "registering"].map(|stage| self.seconds_of(stage));
        let first: f64 = first.into_iter().flatten().sum();
        let patience = Duration::from_secs_f64(self.options.patience * first.max(LEAST_FIRST));
        self.until = Some(Instant::now() + patience);
        let most = duration(patience.as_secs_f64());
        let again = |placed: usize, how: &str| {
            report(PoseProgress::Line(&format!("{placed} of {all} have a camera: {how}")));
        };
        if 2 * best.placed < all && self.tries_learned() {
            again(best.placed, &format!("learned features, for at most {most}"));
            self.features = PoseFeatures::Learned;
            match self.attempt(pictures, report) {
                Err(error) if error.is_stop() => return Err(error),
                Err(error) => tracing::warn!("{error}; going on with SIFT"),
                Ok(()) => best.improve(&self.models)?,
            }
            if best.models != self.models {
                self.features = PoseFeatures::Sift;
            }
        }
        if 10 * best.placed < 9 * all && !self.is_late() {
            again(best.placed, &format!("matching again, guided, for at most {most}"));
            match self.guided(&pictures.copies, report) {
                Err(error) if error.is_stop() => return Err(error),
                // There are still models of an attempt.
                Err(error) if best.placed > 0 => {
                    tracing::warn!("{error}; using the cameras found so far");
                    return Ok(best.models);
                }
                outcome => outcome?,
            }
            best.improve(&self.models)?;
        }
        for (step, relaxed) in (1..).zip(RELAXED) {
            if 2 * best.placed >= all || self.options.mapper == Mapper::Global || self.is_late() {
                break;
            }
            again(best.placed, "registering again, from a closer pair");
            self.relaxed = relaxed;
            let stage = format!("relaxed{step}");
            self.models = self.file(&stage);
            self.once(&stage, || self.register(&pictures.copies, report))?;
            best.improve(&self.models)?;
        }
        if self.is_late() {
            report(PoseProgress::Line(&format!(
                "{} of {all} have a camera, and the time for further attempts is up (--patience {} allows more)",
                best.placed,
                2.0 * self.options.patience
            )));
        }
        if 2 * best.placed < all && !self.can_learn {
            report(PoseProgress::Line(
                "COLMAP 4 has learned features, which find more in dark photographs; this one has none",
            ));
        }
        Ok(best.models)
    }

    /// Features, matches and cameras.
    fn attempt(
        &mut self,
        pictures: &PosePhotographs,
        report: &dyn Fn(PoseProgress<'_>),
    ) -> Result<()> {
        (self.database, self.models) = (self.file("database.db"), self.file("sparse"));
        let attempt = self
            .once("features", || self.extract(pictures, report))
            .and_then(|()| self.once("matching", || self.match_features(report)));
        attempt.map_err(|error| self.without_networks(error))?;
        self.once("registering", || self.register(&pictures.copies, report))
    }

    /// Matches the features again, and registers cameras.
    fn guided(&mut self, copies: &Path, report: &dyn Fn(PoseProgress<'_>)) -> Result<()> {
        self.is_guided = true;
        (self.database, self.models) = (self.file("guided.db"), self.file("guided"));
        self.once("guided-matching", || self.match_features(report))?;
        self.once("guided", || self.register(copies, report))
    }

    /// A file of the attempts with these features.
    fn file(&self, name: &str) -> PathBuf {
        self.out.work.join(self.stage(name))
    }

    /// The name of a stage with these features.
    fn stage(&self, name: &str) -> String {
        match self.features {
            PoseFeatures::Sift => name.to_owned(),
            PoseFeatures::Learned => format!("learned-{name}"),
        }
    }

    fn seconds_of(&self, stage: &str) -> Option<f64> {
        self.out.seconds_of(&self.stage(stage))
    }

    /// An error, with the remedy where it is that COLMAP has no networks.
    fn without_networks(&self, error: Error) -> Error {
        if error.is_stop() || self.features == PoseFeatures::Sift {
            return error;
        }
        let problem = if self.colmap.printed(NO_NETWORKS) {
            "this COLMAP is built without ONNX, which learned features need; take one that has it \
             (-DONNX_ENABLED=ON), or --features sift"
        } else if NOT_FETCHED.iter().any(|words| self.colmap.printed(words)) {
            "COLMAP could not fetch the networks of ALIKED and LightGlue; connect for the first call, or name files by \
             --colmap-option AlikedExtraction.n16rot_model_path=FILE and AlikedMatching.lightglue_model_path=FILE"
        } else {
            return error;
        };
        Error::Usage(format!("--features learned: {problem}"))
    }

    /// Does a stage that no earlier call has done. One that ran out of time is not done.
    fn once(&self, stage: &str, work: impl FnOnce() -> Result<()>) -> Result<()> {
        if self.seconds_of(stage).is_some() {
            return Ok(());
        }
        let begin = Instant::now();
        work()?;
        let seconds = begin.elapsed().as_secs_f64();
        if self.is_late() { Ok(()) } else { self.out.done(&self.stage(stage), seconds) }
    }

    /// Whether the time for further attempts is up.
    fn is_late(&self) -> bool {
        self.until.is_some_and(|until| until <= Instant::now())
    }

    /// Extracts the features of each photograph into the database, and copies that: COLMAP matches no pair twice, so
    /// matching again begins with the features alone. Those of one group share a camera, for which an interrupted call
    /// has to begin anew.
    fn extract(&self, pictures: &PosePhotographs, report: &dyn Fn(PoseProgress<'_>)) -> Result<()> {
        for ending in ["", "-shm", "-wal"] {
            let mut file = self.database.as_os_str().to_owned();
            file.push(ending);
            // Most often there is none.
            let _ = std::fs::remove_file(file);
        }
        let command = "feature_extractor";
        let photographs = pictures.all();
        let groups = cameras::groups(&photographs);
        let (shared, single): (Vec<_>, Vec<_>) =
            groups.into_iter().partition(|group| group.len() > 1);
        let single: Vec<&Path> = single.concat();
        let mut runs: Vec<(Vec<&Path>, &str)> =
            shared.into_iter().map(|group| (group, "1")).collect();
        if !single.is_empty() {
            runs.push((single, "0"));
        }
        let use_gpu = self.named(command, ["FeatureExtraction", "SiftExtraction"], "use_gpu");
        for (at, (group, is_one_camera)) in runs.iter().enumerate() {
            let mut options = self.files(&pictures.copies);
            options.extend([
                ("ImageReader.single_camera".to_owned(), (*is_one_camera).into()),
                ("ImageReader.camera_model".to_owned(), self.options.camera_model.as_str().into()),
                (use_gpu.clone(), self.gpu().into()),
            ]);
            if self.features == PoseFeatures::Learned {
                options.push(("FeatureExtraction.type".to_owned(), "ALIKED_N16ROT".into()));
            }
            if pictures.masks.is_dir() {
                options.push(("ImageReader.mask_path".to_owned(), pictures.masks.clone().into()));
            }
            if runs.len() > 1 {
                let list = self.out.work.join(format!("camera{at}.txt"));
                let names = group.iter().map(|path| pictures.name(path)).collect::<Vec<_>>();
                std::fs::write(&list, names.join("\n") + "\n")
                    .map_err(|error| Error::output(&list, format!("cannot be written: {error}")))?;
                options.push(("image_list_path".to_owned(), list.into()));
            }
            self.run(&self.colmap, command, options, "features", report)?;
        }
        if self.database.is_file() {
            let copy = self.file("guided.db");
            std::fs::copy(&self.database, &copy)
                .map_err(|error| Error::output(&copy, format!("cannot be written: {error}")))?;
        }
        let groups = match runs.len() {
            1 => String::new(),
            count => format!("; {count} groups of photographs by size, lens and focal length"),
        };
        self.tell(&format!("features extracted{groups}"), report);
        Ok(())
    }

    fn match_features(&self, report: &dyn Fn(PoseProgress<'_>)) -> Result<()> {
        let command = self.matcher.command();
        let of_matching = |option| self.named(command, ["FeatureMatching", "SiftMatching"], option);
        let mut options = vec![("database_path".to_owned(), self.database.clone().into())];
        options.push((of_matching("use_gpu"), self.gpu().into()));
        if self.features == PoseFeatures::Learned {
            options.push(("FeatureMatching.type".to_owned(), "ALIKED_LIGHTGLUE".into()));
        }
        // With the relative pose of two photographs, more of their features are matched.
        if self.is_guided {
            options.push((of_matching("guided_matching"), "1".into()));
        }
        if self.matcher == Matcher::Exhaustive {
            // COLMAP reports its progress block by block.
            let block = (self.photographs / 6).clamp(4, 50);
            options.push(("ExhaustiveMatching.block_size".to_owned(), block.to_string().into()));
        }
        self.run(&self.colmap, command, options, "matching", report)?;
        self.tell("features matched", report);
        Ok(())
    }

    fn register(&self, tone_mapped: &Path, report: &dyn Fn(PoseProgress<'_>)) -> Result<()> {
        // Of an earlier call that was stopped.
        let _ = std::fs::remove_dir_all(&self.models);
        create_folder(&self.models)?;
        let mut files = self.files(tone_mapped);
        files.push(("output_path".to_owned(), self.models.clone().into()));
        let run = |tool, command, files| self.run(tool, command, files, "registering", report);
        let registered = match (self.options.mapper, &self.glomap) {
            (Mapper::Incremental, _) => {
                let relaxed = self.relaxed.iter();
                files.extend(relaxed.map(|(name, value)| ((*name).to_owned(), (*value).into())));
                run(&self.colmap, "mapper", files)
            }
            (Mapper::Global, Some(glomap)) => run(glomap, "mapper", files),
            (Mapper::Global, None) => {
                // Global registration requires focal lengths.
                let (command, database) = ("view_graph_calibrator", files[..1].to_vec());
                let calibrated = self.run(&self.colmap, command, database, "calibrating", report);
                calibrated.and_then(|()| run(&self.colmap, GLOBAL, files))
            }
        };
        // COLMAP fails without an initial pair; the error then names the photographs.
        match registered {
            Err(_) if NO_INITIAL_PAIR.iter().any(|words| self.colmap.printed(words)) => {}
            outcome => outcome?,
        }
        self.tell("cameras placed", report);
        Ok(())
    }

    /// Tells the end of a stage, unless its time was up.
    fn tell(&self, line: &str, report: &dyn Fn(PoseProgress<'_>)) {
        if !self.is_late() {
            report(PoseProgress::Line(line));
        }
    }

    /// Runs a command and reports its progress. The user's options override `options`.
    fn run(
        &self,
        tool: &Tool<'_>,
        command: &str,
        mut options: Options,
        what: &str,
        report: &dyn Fn(PoseProgress<'_>),
    ) -> Result<()> {
        for (_, name, value) in self.user_options.iter().filter(|(of, ..)| *of == command) {
            options.retain(|(option, _)| option != name);
            options.push((name.clone(), value.into()));
        }
        let options: Vec<[OsString; 2]> =
            options.into_iter().map(|(name, value)| [format!("--{name}").into(), value]).collect();
        let arguments: Vec<&OsStr> = options.iter().flatten().map(OsString::as_os_str).collect();
        let mut stage = StageProgress::new(what, self.photographs);
        let watch = |printed: &str| {
            if let Some(line) = stage.due(printed) {
                report(PoseProgress::Line(&line));
            }
        };
        // What is late looks at the time itself.
        tool.run(command, &arguments, self.until, watch).map(drop)
    }

    fn files(&self, tone_mapped: &Path) -> Options {
        vec![
            ("database_path".to_owned(), self.database.clone().into()),
            ("image_path".to_owned(), tone_mapped.into()),
        ]
    }

    /// The name of an option in this version of COLMAP; its group changed in 3.12.
    fn named(&self, command: &str, [new, old]: [&str; 2], option: &str) -> String {
        let name = format!("{new}.{option}");
        if self.colmap.has_option(command, &name) { name } else { format!("{old}.{option}") }
    }

    fn gpu(&self) -> &'static str {
        if self.options.colmap_gpu { "1" } else { "0" }
    }
}

/// GLOMAP's command in COLMAP from 4.0 on.
const GLOBAL: &str = "global_mapper";

/// Messages of a mapper that found no initial pair.
const NO_INITIAL_PAIR: [&str; 2] =
    ["No good initial image pair found", "failed to create sparse model"];
