//! Runs COLMAP on the brightened photographs: features, matches, cameras.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::stages::Stage;
use super::tool::Tool;
use super::{PoseArgs, cameras, tone_mapped};
use crate::Error;
use crate::base::output::create_folder;
use crate::photographs::dataset::Dataset;

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
    /// If GLOMAP registers the cameras.
    glomap: Option<Tool<'a>>,
    args: &'a PoseArgs,
    matcher: Matcher,
    is_guided: bool,
    /// How the mapper begins where it found nothing to begin with.
    relaxed: &'static [(&'static str, &'static str)],
    /// Options of the user's, of one command each.
    asked: Vec<(&'static str, String, String)>,
    work: &'a Path,
    database: PathBuf,
    models: PathBuf,
}

/// The number of photographs in the largest model.
fn placed_in(models: &Path) -> Result<usize> {
    Ok(Dataset::largest_model(models)?.map_or(0, |(_, placed)| placed.len()))
}

/// How the mapper may begin with few photographs: their first pair may be closer together, along the view, and have
/// less in common than COLMAP asks for.
const RELAXED: [&[(&str, &str)]; 2] = [
    &[("Mapper.init_min_tri_angle", "6"), ("Mapper.init_min_num_inliers", "50")],
    &[
        ("Mapper.init_min_tri_angle", "2"),
        ("Mapper.init_max_forward_motion", "1"),
        ("Mapper.init_min_num_inliers", "50"),
    ],
];

/// Options with their values.
type Options = Vec<(String, OsString)>;

impl<'a> Reconstruction<'a> {
    /// Sets up the folder, and checks that the programs exist.
    ///
    /// # Errors
    /// Cameras are to be placed all at once, and neither COLMAP nor GLOMAP is there that does; no command has an
    /// option that is asked for.
    pub(super) fn new(
        args: &'a PoseArgs,
        colmap: Tool<'a>,
        matcher: Matcher,
        work: &'a Path,
    ) -> Result<Self> {
        let is_apart = args.mapper == Mapper::Global && !colmap.helps_with(&["help"], GLOBAL);
        let glomap =
            is_apart.then(|| colmap.beside(&args.glomap, "glomap").found("")).transpose()?;
        let (database, models) = (work.join("database.db"), work.join("sparse"));
        create_folder(&models)?;
        let mapper = if args.mapper == Mapper::Global && !is_apart { GLOBAL } else { "mapper" };
        let commands = ["feature_extractor", matcher.command(), mapper];
        let mut asked = vec![];
        for option in &args.colmap_option {
            let (name, value) = option.split_once('=').ok_or_else(|| {
                Error::Usage(format!("--colmap-option {option} is no NAME=VALUE"))
            })?;
            let name = name.trim_start_matches("--");
            let tool = |command| {
                if command == mapper { glomap.as_ref().unwrap_or(&colmap) } else { &colmap }
            };
            let command =
                commands.into_iter().find(|command| tool(*command).has_option(command, name));
            let command = command.ok_or_else(|| {
                Error::Usage(format!(
                    "--colmap-option {option}: of {} none has {name}; `colmap mapper -h` lists those of the mapper",
                    commands.join(", ")
                ))
            })?;
            asked.push((command, name.to_owned(), value.to_owned()));
        }
        Ok(Self {
            colmap,
            glomap,
            args,
            matcher,
            is_guided: false,
            relaxed: &[],
            asked,
            work,
            database,
            models,
        })
    }

    /// The folder that holds the models, a folder each; none where the photographs show too little. Where one in ten
    /// or more is left without a camera, they are compared once more, guided: what a small set comes to is luck
    /// otherwise, and for a large one it would take twice as long. Where most are still left, the mapper begins with
    /// less.
    ///
    /// # Errors
    /// A program fails.
    pub(super) fn models(
        mut self,
        (tone_mapped, photographs): (&Path, &[PathBuf]),
        say: impl Fn(&str) -> Result<()>,
    ) -> Result<PathBuf> {
        self.extract((tone_mapped, photographs), &say)?;
        // COLMAP compares no pair twice: another comparison begins with the features alone.
        let features = self.work.join("guided.db");
        if self.database.is_file() {
            std::fs::copy(&self.database, &features)
                .map_err(|error| Error::output(&features, format!("cannot be written: {error}")))?;
        }
        self.compare(photographs.len(), &say)?;
        self.place(tone_mapped, &say)?;
        let all = photographs.len();
        let mut placed = placed_in(&self.models)?;
        let mut best = self.models.clone();
        if 10 * placed >= 9 * all {
            return Ok(best);
        }
        say(&format!("{placed} of {all} have a camera: compared once more, guided"))?;
        self.is_guided = true;
        self.use_folder("guided")?;
        self.database = features;
        match self.compare(all, &say).and_then(|()| self.place(tone_mapped, &say)) {
            // What the first comparison came to is there.
            Err(error) if placed > 0 => {
                tracing::warn!("{error}; using the cameras of the first attempt");
                return Ok(best);
            }
            outcome => outcome?,
        }
        for (step, relaxed) in [&[][..]].into_iter().chain(RELAXED).enumerate() {
            if !relaxed.is_empty() {
                if 2 * placed >= all || self.args.mapper == Mapper::Global {
                    break;
                }
                say(&format!(
                    "{placed} of {all} have a camera: placed once more, from a closer pair"
                ))?;
                self.relaxed = relaxed;
                self.use_folder(&format!("relaxed{step}"))?;
                self.place(tone_mapped, &say)?;
            }
            let found = placed_in(&self.models)?;
            if found > placed {
                (placed, best) = (found, self.models.clone());
            }
        }
        Ok(best)
    }

    /// Models go into another folder from here on.
    fn use_folder(&mut self, name: &str) -> Result<()> {
        self.models = self.work.join(name);
        Ok(create_folder(&self.models)?)
    }

    /// Features of each photograph. Photographs of one lens share a camera; each of a lens of its own has its own.
    fn extract(
        &self,
        (tone_mapped, photographs): (&Path, &[PathBuf]),
        say: &impl Fn(&str) -> Result<()>,
    ) -> Result<()> {
        let command = "feature_extractor";
        let groups = cameras::groups(photographs);
        let (shared, alone): (Vec<_>, Vec<_>) =
            groups.into_iter().partition(|group| group.len() > 1);
        let alone: Vec<&Path> = alone.concat();
        let mut runs: Vec<(Vec<&Path>, &str)> =
            shared.into_iter().map(|group| (group, "1")).collect();
        if !alone.is_empty() {
            runs.push((alone, "0"));
        }
        let use_gpu = self.named(command, ["FeatureExtraction", "SiftExtraction"], "use_gpu");
        for (at, (group, is_one_camera)) in runs.iter().enumerate() {
            let mut options = self.files(tone_mapped);
            options.extend([
                ("ImageReader.single_camera".to_owned(), (*is_one_camera).into()),
                ("ImageReader.camera_model".to_owned(), self.args.camera_model.as_str().into()),
                (use_gpu.clone(), self.gpu().into()),
            ]);
            if runs.len() > 1 {
                let list = self.work.join(format!("camera{at}.txt"));
                let names = group.iter().map(|path| tone_mapped::name(path)).collect::<Vec<_>>();
                std::fs::write(&list, names.join("\n") + "\n")
                    .map_err(|error| Error::output(&list, format!("cannot be written: {error}")))?;
                options.push(("image_list_path".to_owned(), list.into()));
            }
            self.run(&self.colmap, command, options, ("features", say))?;
        }
        say(&match runs.len() {
            1 => "features extracted".to_owned(),
            count => format!(
                "features extracted; {count} groups of photographs by size, lens and focal length"
            ),
        })
    }

    fn compare(&self, count: usize, say: &impl Fn(&str) -> Result<()>) -> Result<()> {
        let command = self.matcher.command();
        let of_matching = |option| self.named(command, ["FeatureMatching", "SiftMatching"], option);
        let mut options = vec![("database_path".to_owned(), self.database.clone().into())];
        options.push((of_matching("use_gpu"), self.gpu().into()));
        // Once it is known how two photographs lie to each other, more of their features find their twins.
        if self.is_guided {
            options.push((of_matching("guided_matching"), "1".into()));
        }
        if self.matcher == Matcher::Exhaustive {
            // What COLMAP says of its progress it says block by block.
            let block = (count / 6).clamp(4, 50);
            options.push(("ExhaustiveMatching.block_size".to_owned(), block.to_string().into()));
        }
        self.run(&self.colmap, command, options, ("matching", say))?;
        say("features matched")
    }

    fn place(&self, tone_mapped: &Path, say: &impl Fn(&str) -> Result<()>) -> Result<()> {
        let mut files = self.files(tone_mapped);
        files.push(("output_path".to_owned(), self.models.clone().into()));
        let stage = ("placing", say);
        let placed = match (self.args.mapper, &self.glomap) {
            (Mapper::Incremental, _) => {
                let relaxed = self.relaxed.iter();
                files.extend(relaxed.map(|(name, value)| ((*name).to_owned(), (*value).into())));
                self.run(&self.colmap, "mapper", files, stage)
            }
            (Mapper::Global, Some(glomap)) => self.run(glomap, "mapper", files, stage),
            (Mapper::Global, None) => {
                // Placed all at once, cameras need their focal lengths before.
                let database = files[..1].to_vec();
                let calibrated =
                    self.run(&self.colmap, "view_graph_calibrator", database, ("calibrating", say));
                calibrated.and_then(|()| self.run(&self.colmap, GLOBAL, files, stage))
            }
        };
        // COLMAP fails without an initial pair; the error then names the photographs.
        match placed {
            Err(_) if NOTHING.iter().any(|words| self.colmap.printed(words)) => {}
            outcome => outcome?,
        }
        say("cameras placed")
    }

    /// Runs a command with its own options and those that the user asks for, whose values win, and says how far it is.
    fn run(
        &self,
        tool: &Tool<'_>,
        command: &str,
        mut options: Options,
        (what, say): (&str, &impl Fn(&str) -> Result<()>),
    ) -> Result<()> {
        for (_, name, value) in self.asked.iter().filter(|(of, ..)| *of == command) {
            options.retain(|(own, _)| own != name);
            options.push((name.clone(), value.into()));
        }
        let options: Vec<[OsString; 2]> =
            options.into_iter().map(|(name, value)| [format!("--{name}").into(), value]).collect();
        let arguments: Vec<&OsStr> = options.iter().flatten().map(OsString::as_os_str).collect();
        let mut stage = Stage::new(what);
        let mut told = Ok(());
        tool.run_and_watch(command, &arguments, |printed| {
            if let Some(line) = stage.due(printed) {
                told = say(&line);
            }
        })?;
        told
    }

    fn files(&self, tone_mapped: &Path) -> Options {
        vec![
            ("database_path".to_owned(), self.database.clone().into()),
            ("image_path".to_owned(), tone_mapped.into()),
        ]
    }

    /// The name of an option in this version of COLMAP; its group changed in 3.12.
    fn named(&self, command: &str, [new, old]: [&str; 2], option: &str) -> String {
        let own = format!("{new}.{option}");
        if self.colmap.has_option(command, &own) { own } else { format!("{old}.{option}") }
    }

    fn gpu(&self) -> &'static str {
        if self.args.colmap_gpu { "1" } else { "0" }
    }
}

/// GLOMAP's command in COLMAP from 4.0 on.
const GLOBAL: &str = "global_mapper";

/// Messages of a mapper that found no initial pair.
const NOTHING: [&str; 2] = ["No good initial image pair found", "failed to create sparse model"];
