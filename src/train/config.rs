//! Everything that a training run depends on: the command line, a TOML file and the run directory say it alike.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::cache::CacheSize;
use super::early_stopping::StopConfig;
use super::exposures::{ExposureConfig, Learning};
use super::parts::ModelConfig;
use super::precision::PrecisionConfig;
use super::streams;
use crate::base::input;
use crate::base::random::Stream;
use crate::camera::frame::{FRAME_EXTENT, Frame};
use crate::gpu::Tile;
use crate::loss::LossConfig;
use crate::networks::Form;
use crate::photographs::dataset::{Dataset, DepthOptions, LoadOptions};
use crate::photographs::tone::ToneSettings;
use crate::splats::densify::DensityControl;
use crate::splats::optimizer::Schedule;
use crate::splats::render::RenderSettings;
use crate::splats::scene::init::Start;
use crate::splats::scene::{ATTRIBUTES, Attribute, Features, MAX_SH_DEGREE, Shape};
use crate::{Error, Result};

/// No rate of use is near it, and a step of it overflows nothing.
const MOST_RATE: f64 = 100.0;

/// Pixels of a patch; smaller ones have more border than content.
pub(super) const LEAST_PATCH: u64 = 256;

/// What is seen where no splat is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Black, as in the paper.
    #[default]
    Black,
    /// Another colour every step: dark surfaces cannot hide in the background.
    Random,
}

impl std::str::FromStr for Background {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "black" => Ok(Self::Black),
            "random" => Ok(Self::Random),
            _ => Err(Error::Usage(format!("unknown background `{name}`; black or random"))),
        }
    }
}

/// A training run. The defaults are the paper's protocol for LOM but for the curve, the first Gaussians, density control and
/// its schedule, which reach a better score in less time ([`super::Preset::Lom`] has the paper's).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// The dataset's folder.
    pub dataset: PathBuf,
    /// A folder of reference images by name, in place of what lies beside the input.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reference: Option<PathBuf>,
    /// A PLY whose Gaussians the training begins with, in place of first ones at the points; every SH degree is in use from the
    /// first step.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub init: Option<PathBuf>,
    /// Masks hide what is white, not what is black.
    #[serde(skip_serializing_if = "is_off")]
    pub invert_masks: bool,
    /// Photographs of a fisheye are undistorted to a pinhole's, cropped to 60 degrees off the axis.
    pub undistort: bool,
    /// Steps; each renders one training view.
    pub steps: u64,
    /// Factor by which photographs shrink.
    pub downscale: f64,
    /// The longest side of a view, pixels; photographs beyond it shrink to it. 0: no limit.
    pub max_resolution: u32,
    /// The most pixels that a step takes: larger photographs are trained on in patches. Left out: as many as the device can
    /// bind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patch_pixels: Option<u64>,
    /// Every so many views by name are held out in place of the dataset's own split; 0: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test_every: Option<usize>,
    /// What the photographs may take, on the device and decoded on the host; what does not fit waits on disk, and no bit
    /// changes. Left out: a quarter of the memory of each.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cache: Option<CacheSize>,
    /// The most memory that buffers may take on the device: growth stops in time, and what exceeds it all the same ends the
    /// run, saved. Left out: all that there is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_vram: Option<CacheSize>,
    /// The most memory that the process is to take on the host, as far as that can be foreseen: growth stops in time. Left
    /// out: all that there is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_ram: Option<CacheSize>,
    /// The folder for what exceeds the cache; none: that of the system's temporary files.
    #[serde(skip)]
    pub spool: Option<PathBuf>,
    /// Everything random follows from it.
    pub seed: u64,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: u32,
    /// Weight w of 1 - SSIM beside (1 - w) L1.
    pub ssim_weight: f64,
    /// Density control stops growing here.
    pub max_gaussians: usize,
    /// What is seen where no splat is, during training; scores and renders use black.
    pub background: Background,
    /// Scores the test views every so many steps; 0: at the end only.
    pub eval_every: u64,
    /// Writes a checkpoint every so many steps; 0: never.
    pub checkpoint_every: u64,
    /// Writes one whenever the last is so many minutes old, too; 0: never.
    pub checkpoint_minutes: f64,
    /// Saves and stops after so many minutes, to go on another time; 0: trains to the end.
    pub max_minutes: f64,
    /// Logs a checksum of every plane of the parameters every so many steps; 0: never.
    pub hash_every: u64,
    /// Leaves event files for `TensorBoard`.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub tensorboard: bool,
    /// Steps whose every pass is compared with its CPU reference.
    pub check: CheckConfig,
    /// The device: `uuid:` or `pci:` and which, `cpu`, its index, or a part of its name; empty: the best.
    pub device: String,
    /// The tile that a workgroup renders: width and height in pixels and, where more than one subgroup share it, their
    /// number; left out, it is the fastest known on the device, and recorded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tile: Option<Tile>,
    /// Nothing nearer to a camera is seen, in units of the extent, which is taken as the power of two of which it is 0.75 to
    /// 1.5 times.
    pub near: f64,
    /// Where the model is trained; left out, it is found from the cameras, and recorded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<Frame>,
    /// Random points to begin with where the dataset has none.
    pub random_points: usize,
    /// The curve that lifts each photograph.
    pub tone: ToneSettings,
    /// What the first Gaussians look like.
    pub start: Start,
    /// Learning rates, and what else changes with the step.
    pub schedule: Schedule,
    /// Density control.
    pub density: DensityConfig,
    /// What the model has beside colour.
    pub model: ModelConfig,
    /// When a run ends before its last step.
    pub stop: StopConfig,
    /// Gain and bias of each training view.
    pub exposure: ExposureConfig,
    /// In how many bits things are kept.
    pub precision: PrecisionConfig,
}

/// Steps whose every pass is compared with its CPU reference.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CheckConfig {
    /// Every so many; 0: none.
    pub every: u64,
    /// A difference ends the run; else it is a warning.
    pub stops: bool,
}

/// Which Gaussians multiply and which go; [`Schedule`] says when.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DensityConfig {
    /// What comes of those that multiply.
    pub control: DensityControl,
    /// Mean norm of the screen-space gradient, in normalised device units, from which a Gaussian multiplies.
    pub gradient_threshold: f64,
    /// Larger than this fraction of the extent: split; smaller: cloned. Of the paper's control alone.
    pub split_scale: f64,
    /// Fainter Gaussians are removed.
    pub min_opacity: f64,
    /// So many Gaussians come of few, a tenth of them or fewer: random points up to that tenth, and in the first round
    /// Gaussians at the depths of what the views show. Of the conserving control alone; 0: none are added.
    pub fill: usize,
}

/// What a configuration need not say.
fn is_off(flag: &bool) -> bool {
    !flag
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            dataset: PathBuf::new(),
            reference: None,
            init: None,
            invert_masks: false,
            undistort: false,
            steps: 5000,
            downscale: 1.0,
            max_resolution: 1600,
            patch_pixels: None,
            test_every: None,
            cache: None,
            max_vram: None,
            max_ram: None,
            spool: None,
            seed: 10,
            sh_degree: MAX_SH_DEGREE,
            ssim_weight: 0.2,
            max_gaussians: 1_000_000,
            background: Background::Black,
            eval_every: 0,
            checkpoint_every: 1000,
            checkpoint_minutes: 10.0,
            max_minutes: 0.0,
            hash_every: 0,
            tensorboard: false,
            check: CheckConfig::default(),
            device: String::new(),
            tile: None,
            near: 0.1,
            frame: None,
            random_points: 20_000,
            tone: ToneSettings::default(),
            start: Start::default(),
            schedule: Schedule::default(),
            density: DensityConfig::default(),
            model: ModelConfig::default(),
            stop: StopConfig::default(),
            exposure: ExposureConfig::default(),
            precision: PrecisionConfig::default(),
        }
    }
}

impl Default for DensityConfig {
    fn default() -> Self {
        Self {
            control: DensityControl::Conserving,
            gradient_threshold: 4e-4,
            split_scale: 0.01,
            min_opacity: 0.005,
            fill: 0,
        }
    }
}

impl DensityConfig {
    /// The most first Gaussians that are few.
    pub(super) fn few(&self) -> usize {
        match self.control {
            DensityControl::Conserving => self.fill / 10,
            DensityControl::Paper => 0,
        }
    }

    /// Those of LITA-GS.
    pub fn paper() -> Self {
        Self { control: DensityControl::Paper, gradient_threshold: 2e-4, ..Self::default() }
    }
}

impl TrainConfig {
    /// Reads a TOML file; what it leaves out keeps its default.
    ///
    /// # Errors
    /// The file cannot be read, or says something that no run has.
    pub fn load(path: &Path) -> Result<Self> {
        let text = input::text(path)?;
        let config =
            Self::from_toml(&text).and_then(|config| config.check_finite().map(|()| config));
        config.map_err(|problem| Error::input(path, problem.to_string()))
    }

    /// Reads TOML; what it leaves out keeps its default.
    ///
    /// # Errors
    /// It says something that no run has.
    pub fn from_toml(text: &str) -> Result<Self> {
        toml::from_str(text).map_err(|error| {
            let line = error.span().map(|span| text[..span.start].matches('\n').count() + 1);
            let place = line.map(|line| format!(" (line {line})")).unwrap_or_default();
            Error::Usage(format!("is no configuration: {}{place}", error.message()))
        })
    }

    /// The configuration as TOML.
    ///
    /// # Errors
    /// None for values that [`TrainConfig::check`] accepts.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|error| Error::Usage(error.to_string()))
    }

    /// How the dataset is to be loaded.
    pub fn load_options(&self) -> LoadOptions {
        LoadOptions {
            downscale: self.downscale,
            max_resolution: self.max_resolution,
            test_every: self.test_every,
            keep: CacheSize::on_host(self.cache, self.max_ram),
            reference: self.reference.clone(),
            invert_masks: self.invert_masks,
            undistort: self.undistort,
            hold_out: self.stop.views,
            depth: DepthOptions {
                load: self.model.depth,
                folder: self.model.depth_folder.clone(),
                is_disparity: self.model.depth_is_disparity,
            },
            ..LoadOptions::default()
        }
    }

    /// Switches off the depth part where no training view has a depth map, and says so.
    pub fn leave_out_what_is_missing(&mut self, dataset: &Dataset) {
        if !self.model.depth {
            return;
        }
        let count = dataset.train_views().filter(|view| view.depth.is_some()).count();
        if count == 0 {
            tracing::warn!(
                "no view has a depth map (depth/NAME.png, or in model.depth_folder): no depth term"
            );
            self.model.depth = false;
        } else {
            tracing::info!(
                "{count} of {} training views have a depth map",
                dataset.train_views().count()
            );
        }
    }

    /// The same run of another copy of its dataset; what lay in its folder lies there, too.
    pub fn move_dataset(&mut self, dataset: &Path) {
        let from = std::mem::replace(&mut self.dataset, dataset.to_owned());
        let inside = [&mut self.reference, &mut self.model.depth_folder, &mut self.exposure.start];
        for folder in inside.into_iter().flatten() {
            if let Ok(place) = folder.strip_prefix(&from) {
                *folder = dataset.join(place);
            }
        }
    }

    /// What the rasteriser is specialised for.
    pub fn render_settings(&self) -> RenderSettings {
        RenderSettings {
            shape: Shape { sh_degree: self.sh_degree, features: self.model.features() },
            raw_colors: self.model.raw_colors,
            observes: self.model.network.form == Form::Identity,
            tile: self.tile,
            patch_pixels: self.patch_pixels,
            near: (self.near * FRAME_EXTENT) as f32,
            ..RenderSettings::default()
        }
    }

    /// What the loss terms of the model are built from.
    pub fn loss(&self) -> LossConfig {
        LossConfig {
            tone_curve: self.tone.loss_curve(),
            ssim_weight: self.ssim_weight,
            weights: self.model.weights,
            depth_box: self.model.depth_box,
            boxes: Stream::new(self.seed, streams::BOXES),
            // The denoiser's terms are there without a noise map, too.
            features: Features { noise: self.model.denoiser, ..self.model.features() },
        }
    }

    /// Refuses values that make no sense, naming the field.
    ///
    /// # Errors
    /// [`Error::Usage`].
    pub fn check(&self) -> Result<()> {
        self.tone.check()?;
        self.start.check()?;
        self.model.check()?;
        self.stop.check()?;
        self.loss().check()?;
        self.exposure.check()?;
        if self.exposure.learn == Learning::On && self.model.tonemapper {
            let problem = "`ExposureConfig::learn` is on, and the tonemapper holds the model to the dark photographs, whose \
                exposures a gain on their lifted targets does not describe; leave one of them out";
            return Err(Error::Usage(problem.to_owned()));
        }
        if i64::try_from(self.seed).is_err() {
            let (seed, most) = (self.seed, i64::MAX);
            let problem = format!("`TrainConfig::seed` is {seed}; it must be at most {most}");
            return Err(Error::Usage(problem));
        }
        self.check_finite()?;
        let (density, schedule) = (&self.density, &self.schedule);
        let minutes = |minutes: f64| (0.0..=1e9).contains(&minutes);
        let rules = [
            ("density.split_scale", density.split_scale, density.split_scale >= 0.0, "0 or more"),
            (
                "density.min_opacity",
                density.min_opacity,
                (0.0..1.0).contains(&density.min_opacity),
                "0 or more and below 1",
            ),
            ("`TrainConfig::near`", self.near, (1e-6..=1.0).contains(&self.near), "0.000001 to 1"),
            (
                "frame.scale",
                self.frame.unwrap_or_default().scale,
                self.frame.unwrap_or_default().is_sound(),
                "above 0, and the centre finite",
            ),
            (
                "schedule.final_means_rate",
                schedule.final_means_rate,
                schedule.final_means_rate > 0.0 && schedule.final_means_rate <= MOST_RATE,
                "above 0 and at most 100",
            ),
            (
                "`TrainConfig::checkpoint_minutes`",
                self.checkpoint_minutes,
                minutes(self.checkpoint_minutes),
                "0 to 1e9",
            ),
            ("`TrainConfig::max_minutes`", self.max_minutes, minutes(self.max_minutes), "0 to 1e9"),
            ("`TrainConfig::steps`", self.steps as f64, self.steps >= 1, "at least 1"),
            (
                "`TrainConfig::patch_pixels`",
                self.patch_pixels.unwrap_or_default() as f64,
                self.patch_pixels.is_none_or(|pixels| pixels >= LEAST_PATCH),
                "at least 256",
            ),
            (
                "`TrainConfig::sh_degree`",
                f64::from(self.sh_degree),
                self.sh_degree <= MAX_SH_DEGREE,
                "0 to 3",
            ),
            (
                "`TrainConfig::max_gaussians`",
                self.max_gaussians as f64,
                self.max_gaussians >= 1,
                "at least 1",
            ),
            ("random_points", self.random_points as f64, self.random_points >= 1, "at least 1"),
            (
                "density.gradient_threshold",
                density.gradient_threshold,
                density.gradient_threshold > 0.0,
                "above 0",
            ),
            (
                "schedule.boost",
                self.schedule.boost,
                (1e-3..=1e3).contains(&self.schedule.boost),
                "0.001 to 1000",
            ),
            (
                "schedule.settle_rate",
                self.schedule.settle_rate,
                self.schedule.settle_rate > 0.0 && self.schedule.settle_rate <= 1.0,
                "above 0 and at most 1",
            ),
        ];
        for (spec, rate) in ATTRIBUTES.iter().zip(schedule.initial_rates.0) {
            // The decay of the means' rate divides by it.
            let least = if spec.attribute == Attribute::Means { f64::MIN_POSITIVE } else { 0.0 };
            if !(least..=MOST_RATE).contains(&rate) {
                let (name, rule) = (spec.name, if least > 0.0 { "above 0" } else { "0 or more" });
                let problem = format!(
                    "schedule.initial_rates.{name} is {rate}; it must be {rule} and at most {MOST_RATE}"
                );
                return Err(Error::Usage(problem));
            }
        }
        for (name, value, holds, rule) in rules {
            if !(holds && value.is_finite()) {
                return Err(Error::Usage(format!("{name} is {value}; it must be {rule}")));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_configuration_survives_its_toml() {
        let config = TrainConfig { seed: 3, background: Background::Random, ..Default::default() };
        let text = config.to_toml().unwrap();
        assert_eq!(toml::from_str::<TrainConfig>(&text).unwrap(), config);
    }

    #[test]
    fn an_unknown_key_names_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        std::fs::write(&path, "steps = 3\nstepz = 4\n").unwrap();
        let message = TrainConfig::load(&path).unwrap_err().to_string();
        assert!(message.contains("stepz") && message.contains("line 2"), "{message}");
    }

    #[test]
    fn values_that_make_no_sense_are_refused_by_name() {
        let refused = |config: TrainConfig| config.check().unwrap_err().to_string();
        assert!(
            refused(TrainConfig { steps: 0, ..Default::default() })
                .contains("`TrainConfig::steps` is 0")
        );
        assert!(
            refused(TrainConfig { ssim_weight: f64::NAN, ..Default::default() }).contains("ssim")
        );
        assert!(
            refused(TrainConfig { sh_degree: 4, ..Default::default() }).contains("::sh_degree`")
        );
        for rate in [f64::NAN, f64::INFINITY, -1e-3, 0.0, 1e9] {
            let mut config = TrainConfig::default();
            config.schedule.initial_rates[Attribute::Means] = rate;
            assert!(refused(config).contains("schedule.initial_rates.means"), "{rate}");
        }
        let mut config = TrainConfig::default();
        config.model.weights.low_ssim = 1.5;
        assert!(refused(config).contains("low_ssim"));
    }
}
