//! What COLMAP is asked to do with the lifted photographs: features, matches, cameras.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::tool::Tool;
use super::{PoseArgs, create, tone_mapped};
use crate::photographs::dataset::Dataset;
use crate::photographs::image::files::photographs_in;

/// Which photographs COLMAP compares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Matcher {
    /// Each with each.
    Exhaustive,
    /// Each with those that follow it by name.
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

/// How cameras are placed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Mapper {
    /// One after the other (COLMAP's mapper).
    Incremental,
    /// All at once (GLOMAP, or COLMAP from 4.0 on).
    Global,
}

/// The programs and files of one reconstruction.
pub(super) struct Reconstruction<'a> {
    colmap: Tool<'a>,
    /// Where it is a program of its own that places cameras.
    glomap: Option<Tool<'a>>,
    args: &'a PoseArgs,
    matcher: Matcher,
    is_guided: bool,
    database: PathBuf,
    models: PathBuf,
}

/// How many photographs the largest of some models places.
fn placed_in(models: &Path) -> Result<usize> {
    Ok(Dataset::largest_model(models)?.map_or(0, |(_, placed)| placed.len()))
}

impl<'a> Reconstruction<'a> {
    /// One in a folder of its own, by programs that are there.
    ///
    /// # Errors
    /// Cameras are to be placed all at once, and neither COLMAP nor GLOMAP is there that does.
    pub(super) fn new(
        args: &'a PoseArgs,
        colmap: Tool<'a>,
        matcher: Matcher,
        work: &Path,
    ) -> Result<Self> {
        let is_apart = args.mapper == Mapper::Global && !colmap.helps_with(&["help"], GLOBAL);
        let glomap =
            is_apart.then(|| colmap.beside(&args.glomap, "glomap").found("")).transpose()?;
        let (database, models) = (work.join("database.db"), work.join("sparse"));
        create(&models)?;
        Ok(Self { colmap, glomap, args, matcher, is_guided: false, database, models })
    }

    /// The folder that holds the models, a folder each; none where the photographs show too little. Where one in ten or more is
    /// left without a camera, they are compared once more, guided: what a small set comes to is luck otherwise, and for a large
    /// one it would take twice as long.
    ///
    /// # Errors
    /// A program fails.
    pub(super) fn models(
        mut self,
        tone_mapped: &Path,
        say: impl Fn(&str) -> Result<()>,
    ) -> Result<PathBuf> {
        self.attempt(tone_mapped, &say)?;
        let all = photographs_in(tone_mapped)?.len();
        let placed = placed_in(&self.models)?;
        if 10 * placed >= 9 * all {
            return Ok(self.models);
        }
        say(&format!("{placed} of {all} have a camera: compared once more, guided"))?;
        let first = self.models.clone();
        self.is_guided = true;
        self.database.set_file_name("guided.db");
        self.models.set_file_name("guided");
        create(&self.models)?;
        match self.attempt(tone_mapped, &say) {
            // What the first comparison came to is there.
            Err(error) if placed > 0 => {
                tracing::warn!("{error}; the cameras are those of the first comparison");
                return Ok(first);
            }
            outcome => outcome?,
        }
        Ok(if placed_in(&self.models)? > placed { self.models } else { first })
    }

    fn attempt(&self, tone_mapped: &Path, say: &impl Fn(&str) -> Result<()>) -> Result<()> {
        self.extract(tone_mapped)?;
        say("features extracted")?;
        self.compare()?;
        say("features matched")?;
        // It fails where it found nothing to begin with, which is said of the photographs.
        match self.place(tone_mapped) {
            Err(_) if NOTHING.iter().any(|words| self.colmap.printed(words)) => {}
            outcome => outcome?,
        }
        say("cameras placed")
    }

    fn extract(&self, photographs: &Path) -> crate::Result<()> {
        let command = "feature_extractor";
        let is_one_camera = if tone_mapped::are_of_one_size(photographs) { "1" } else { "0" };
        self.colmap.run(
            command,
            &[
                "--database_path".as_ref(),
                self.database.as_ref(),
                "--image_path".as_ref(),
                photographs.as_ref(),
                "--ImageReader.single_camera".as_ref(),
                is_one_camera.as_ref(),
                "--ImageReader.camera_model".as_ref(),
                self.args.camera_model.as_ref(),
                self.named(command, ["FeatureExtraction", "SiftExtraction"], "use_gpu").as_ref(),
                self.gpu(),
            ],
        )
    }

    fn compare(&self) -> crate::Result<()> {
        let command = self.matcher.command();
        let use_gpu = self.named(command, ["FeatureMatching", "SiftMatching"], "use_gpu");
        // Once it is known how two photographs lie to each other, more of their features find their twins.
        let guided = self.named(command, ["FeatureMatching", "SiftMatching"], "guided_matching");
        let guided: [&OsStr; 2] = [guided.as_ref(), "1".as_ref()];
        let mut options = vec!["--database_path".as_ref(), self.database.as_ref()];
        options.extend([use_gpu.as_ref(), self.gpu()]);
        options.extend(guided.into_iter().filter(|_| self.is_guided));
        self.colmap.run(command, &options)
    }

    fn place(&self, photographs: &Path) -> crate::Result<()> {
        let files: [&OsStr; 6] = [
            "--database_path".as_ref(),
            self.database.as_ref(),
            "--image_path".as_ref(),
            photographs.as_ref(),
            "--output_path".as_ref(),
            self.models.as_ref(),
        ];
        match (self.args.mapper, &self.glomap) {
            (Mapper::Incremental, _) => self.colmap.run("mapper", &files),
            (Mapper::Global, Some(glomap)) => glomap.run("mapper", &files),
            (Mapper::Global, None) => {
                // Placed all at once, cameras need their focal lengths before.
                self.colmap.run("view_graph_calibrator", &files[..2])?;
                self.colmap.run(GLOBAL, &files)
            }
        }
    }

    /// The option by its name in this version of COLMAP: before 3.12 its group was another.
    fn named(&self, command: &str, [new, old]: [&str; 2], option: &str) -> String {
        let own = format!("{new}.{option}");
        let is_new = self.colmap.helps_with(&[command, "-h"], &own);
        if is_new { format!("--{own}") } else { format!("--{old}.{option}") }
    }

    fn gpu(&self) -> &'static OsStr {
        if self.args.colmap_gpu { "1" } else { "0" }.as_ref()
    }
}

/// The command of COLMAP, from 4.0 on, that is GLOMAP.
const GLOBAL: &str = "global_mapper";

/// What a mapper says that found nothing to begin with.
const NOTHING: [&str; 2] = ["No good initial image pair found", "failed to create sparse model"];
