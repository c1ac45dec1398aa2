//! From photographs to a page: the folders of its stages, what is left to do, and how long that takes.
//!
//! ```text
//! PHOTOS-splat/dataset/     the photographs with the cameras that `pose` estimates, unless they have some
//!              run/         the run directory
//!              NAME.html    the page
//! ```
//!
//! Every stage goes on where it was stopped or killed, so the same command does what is left.

use std::path::{Path, PathBuf};

use nightsplat_core::output::check_apart;
use nightsplat_photographs::dataset::{Dataset, LoadOptions};
use nightsplat_photographs::image::files::photographs_in;
use nightsplat_photographs::image::{Image, ImageFile};

use crate::results::run;
use crate::train::TrainConfig;
use crate::{Error, Result};
use nightsplat_pose::{self as pose, PoseOptions};

/// A stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MakeStage {
    /// The cameras of the photographs.
    Cameras,
    /// Diagnosis, training and scores.
    Training,
    /// The page.
    Page,
}

impl MakeStage {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cameras => "cameras",
            Self::Training => "training",
            Self::Page => "page",
        }
    }
}

/// The places of the stages.
#[derive(Clone, Debug)]
pub struct MadePaths {
    /// The folder of all.
    pub out: PathBuf,
    /// The dataset: what was given if that has cameras.
    pub dataset: PathBuf,
    /// The run directory.
    pub run: PathBuf,
    /// The page.
    pub page: PathBuf,
    /// In order; of two, the photographs have cameras.
    pub stages: Vec<MakeStage>,
}

impl MadePaths {
    /// The places for a folder of photographs, a clip or a dataset; by default beside it.
    ///
    /// # Errors
    /// The input does not exist or is a run, or the output is, holds or lies in it.
    pub fn new(input: &Path, out: Option<&Path>) -> Result<Self> {
        let whole = input.canonicalize().map_err(|_| {
            let problem = "does not exist; name a folder of photographs, a clip, or a dataset";
            Error::input(input, problem)
        })?;
        let name = if whole.is_file() { whole.file_stem() } else { whole.file_name() };
        let name = name.unwrap_or_default().to_string_lossy().into_owned();
        let out = match out {
            Some(out) => out.to_owned(),
            // Of `.`, the name is that of the folder.
            None if input.file_name().is_none() => whole.with_file_name(format!("{name}-splat")),
            None => input.with_file_name(format!("{name}-splat")),
        };
        let is_dataset = Dataset::is_at(input);
        if !is_dataset && input.is_dir() && photographs_in(input)?.is_empty() {
            // The error says what is there instead.
            Dataset::listed(input, &LoadOptions::default())?;
        }
        check_apart(&out, input, false)?;
        let stages = [MakeStage::Cameras, MakeStage::Training, MakeStage::Page];
        Ok(Self {
            dataset: if is_dataset { input.to_owned() } else { out.join("dataset") },
            run: out.join("run"),
            page: out.join(format!("{name}.html")),
            stages: stages[usize::from(is_dataset)..].to_vec(),
            out,
        })
    }

    /// Whether cameras are to be estimated with these options.
    ///
    /// # Errors
    /// There are some of other photographs or options, which are not to be replaced.
    pub fn needs_cameras(&self, options: &PoseOptions) -> Result<bool> {
        if !self.stages.contains(&MakeStage::Cameras) {
            return Ok(false);
        }
        if options.overwrite || !self.dataset.exists() {
            return Ok(true);
        }
        if pose::is_estimated(options) {
            return Ok(false);
        }
        let problem = "holds the cameras of other photographs or options; begin anew with --overwrite, or name another \
                       --out";
        Err(Error::output(&self.dataset, problem))
    }

    /// Coarse estimates of the stages that are left, in seconds, with the options of the cameras and the configuration
    /// of the training as far as known; `None` of one that nothing is known of.
    pub fn expected(
        &self,
        options: &PoseOptions,
        config: &TrainConfig,
        is_cpu: bool,
    ) -> Vec<(MakeStage, Option<f64>)> {
        let left = self.stages.iter().filter(|stage| match stage {
            MakeStage::Cameras => !pose::is_estimated(options),
            MakeStage::Training => !run::is_finished(&self.run),
            MakeStage::Page => true,
        });
        let seconds = |stage| match stage {
            MakeStage::Cameras => pose::expected(options),
            MakeStage::Training => Some(training_seconds(&options.photos, config, is_cpu)),
            MakeStage::Page => Some(10.0),
        };
        left.map(|&stage| (stage, seconds(stage))).collect()
    }
}

/// Seconds of a training, within a factor of three or so, by the table in the guide: steps of small photographs, which
/// grow by less than the pixels.
fn training_seconds(input: &Path, config: &TrainConfig, is_cpu: bool) -> f64 {
    /// Processor seconds of a step at [`PIXELS`], and of a step on a graphics card.
    const STEP: [f64; 2] = [0.025, 0.0005];
    const PIXELS: f64 = 250.0 * 188.0;
    /// Of the most steps of a run that ends when it has converged.
    const USUAL: f64 = 0.5;
    let first = match Dataset::listed(input, &config.load_options()) {
        Ok((listed, ..)) => listed.into_iter().next().map(|photograph| photograph.input),
        Err(_) => photographs_in(input).unwrap_or_default().into_iter().next(),
    };
    let first = first.and_then(|first| Image::size_of(first).ok());
    let size: [f64; 2] =
        first.map_or([1600.0, 1200.0], |(width, height)| [width.into(), height.into()]);
    let most = match config.max_resolution {
        0 => f64::INFINITY,
        most => most.into(),
    };
    let scale = (1.0 / config.downscale).min(most / size[0].max(size[1]));
    let pixels = size[0] * size[1] * scale * scale;
    let steps = config.steps as f64 * if config.stop.views > 0 { USUAL } else { 1.0 };
    let cores = std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64);
    let step = if is_cpu { STEP[0] / cores } else { STEP[1] };
    steps * step * (pixels / PIXELS).powf(0.6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_made_lies_beside_the_photographs() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("attic");
        std::fs::create_dir(&photos).unwrap();
        std::fs::write(folder.path().join("walk.mp4"), "a clip").unwrap();
        let refused = MadePaths::new(&photos, None).unwrap_err().to_string();
        assert!(refused.contains("holds no dataset"), "{refused}");
        Image::filled(8, 8, [0.1; 3]).save_png8(photos.join("a.png")).unwrap();
        let made = MadePaths::new(&photos, None).unwrap();
        assert_eq!(made.page, folder.path().join("attic-splat/attic.html"));
        assert_eq!(made.stages, [MakeStage::Cameras, MakeStage::Training, MakeStage::Page]);
        let made = MadePaths::new(&folder.path().join("walk.mp4"), None).unwrap();
        assert_eq!(made.dataset, folder.path().join("walk-splat/dataset"));
        for (input, out) in [("attic", "attic"), ("attic", "attic/splat"), ("attic", "")] {
            let (input, out) = (folder.path().join(input), folder.path().join(out));
            let refused = MadePaths::new(&input, Some(&out)).unwrap_err().to_string();
            assert!(refused.contains("choose another folder"), "{refused}");
        }
        let refused = MadePaths::new(&folder.path().join("attics"), None).unwrap_err().to_string();
        assert!(refused.contains("attics: does not exist"), "{refused}");
    }
}
