//! Runs COLMAP on the brightened photographs: features, matches, cameras.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::tool::Tool;
use super::{PoseArgs, tone_mapped};
use crate::base::output::create_folder;
use crate::photographs::dataset::Dataset;
use crate::photographs::image::files::photographs_in;

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
    database: PathBuf,
    models: PathBuf,
}

/// The number of photographs in the largest model.
fn placed_in(models: &Path) -> Result<usize> {
    Ok(Dataset::largest_model(models)?.map_or(0, |(_, placed)| placed.len()))
}

impl<'a> Reconstruction<'a> {
    /// Sets up the folder, and checks that the programs exist.
    ///
    /// # Errors
    /// `--mapper global` with neither GLOMAP nor a COLMAP that has it.
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
        create_folder(&models)?;
        Ok(Self { colmap, glomap, args, matcher, is_guided: false, database, models })
    }

    /// The folder of the models, which is empty if none was found. If more than one photograph in ten gets no camera,
    /// all are matched again with guided matching: small sets depend on luck otherwise, and for large ones it would
    /// double the time.
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
        say(&format!("{placed} of {all} have a camera: matching again, guided"))?;
        let first = self.models.clone();
        self.is_guided = true;
        self.database.set_file_name("guided.db");
        self.models.set_file_name("guided");
        create_folder(&self.models)?;
        match self.attempt(tone_mapped, &say) {
            // The first attempt found something.
            Err(error) if placed > 0 => {
                tracing::warn!("{error}; using the cameras of the first attempt");
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
        // Without an initial pair the mapper fails; the caller reports that no camera was found.
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
        // With the relative pose of two photographs known, more of their features match.
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
                // The global mapper needs focal lengths.
                self.colmap.run("view_graph_calibrator", &files[..2])?;
                self.colmap.run(GLOBAL, &files)
            }
        }
    }

    /// The name of an option in this version of COLMAP; its group changed in 3.12.
    fn named(&self, command: &str, [new, old]: [&str; 2], option: &str) -> String {
        let own = format!("{new}.{option}");
        let is_new = self.colmap.helps_with(&[command, "-h"], &own);
        if is_new { format!("--{own}") } else { format!("--{old}.{option}") }
    }

    fn gpu(&self) -> &'static OsStr {
        if self.args.colmap_gpu { "1" } else { "0" }.as_ref()
    }
}

/// GLOMAP's command in COLMAP from 4.0 on.
const GLOBAL: &str = "global_mapper";

/// Messages of a mapper that found no initial pair.
const NOTHING: [&str; 2] = ["No good initial image pair found", "failed to create sparse model"];
