//! Everything that a training run depends on, the same on the command line, in a TOML file and in the run directory.

mod antialiasing;
mod exposure;
mod freeze;
mod lamp;
mod schedule;
mod stop;

use std::ops::Bound;
use std::path::{Path, PathBuf};

use glam::DVec3;
use nightsplat_core::camera::frame::{FRAME_EXTENT, TrainingFrame};
use nightsplat_core::random::Stream;
use nightsplat_core::settings;
use nightsplat_core::settings::Rule;
use nightsplat_models::attributes::Attribute;
use nightsplat_models::gaussians::init::Initialization;
use nightsplat_models::gaussians::{MAX_SH_DEGREE, ModelFacts, Shape};
use nightsplat_photographs::dataset::{
    DOWNSCALE, Dataset, DepthOptions, LoadOptions, MeasuredSize, NormalOptions, PixelOrientation,
    RowBands,
};
use nightsplat_photographs::image::StoredLight;
use nightsplat_photographs::tone::ToneSettings;
use nightsplat_photographs::white_balance::WhiteBalance;
use serde::{Deserialize, Serialize};

use super::cache::CacheSize;
use super::parts::ModelConfig;
use super::precision::PrecisionConfig;
use super::streams;
use crate::gpu::Tile;
use crate::loss::{LossConfig, ParameterWeights};
use crate::networks::NetworkVariant;
use crate::splats::batches::freezes_splats;
use crate::splats::densify::DensityControl;
use crate::splats::lamp::Lamp;
use crate::splats::optimizer::Schedule;
use crate::splats::packed_sh::StorageFormat;
use crate::splats::render::RenderSettings;
use crate::{Error, Result};
pub use antialiasing::AntialiasingConfig;
pub use exposure::ExposureConfig;
pub use freeze::Freeze;
pub use lamp::{LampConfig, LampRates};
pub use stop::{NotFinite, StopConfig};

/// Pixels of a patch; smaller ones have more border than content.
pub(super) const MIN_PATCH: u64 = 256;

/// The background of a render.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Black, as in the paper.
    #[default]
    Black,
    /// Another colour every step, so that dark surfaces cannot be left empty.
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

settings! {
""
/// A training run. The defaults are those of the preset `balanced`: the best score per second.
///
/// ```
/// use nightsplat::{Tone, ToneSettings, TrainConfig};
///
/// let curve: Tone = "ase".parse()?;
/// let config = TrainConfig { tone: ToneSettings::new(curve), ..TrainConfig::default() };
/// config.check()?;
/// # Ok::<(), nightsplat::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct TrainConfig {
    /// The dataset's folder.
    dataset: PathBuf = PathBuf::new() => Rule::PATH;
    /// The folder that holds the photographs by their listed names.
    images: Option<PathBuf> = None, "where the dataset's listing says" => Rule::PATH, "--images DIR";
    /// Which pixels the dataset's cameras are of, where a photograph's Exif turns or mirrors it and its size does not
    /// tell: those that are stored, or those that Exif shows; auto: found from the points that photographs share.
    orientation: PixelOrientation = PixelOrientation::Auto
        => Rule::OneOf(&PixelOrientation::NAMES), "--orientation PIXELS";
    /// Folder of reference images, under the names of the photographs, for scores only.
    reference: Option<PathBuf> = None, "found beside the photographs" => Rule::PATH, "--reference DIR";
    /// Initial Gaussians from a PLY in the dataset's coordinates, instead of the dataset's points; all SH degrees are
    /// in use from the first step.
    init: Option<PathBuf> = None, "the dataset's points" => Rule::PATH, "--init MODEL.ply";
    /// Leave these attributes of the initial model as they are: with means,quats,scales,opacities, only its colours
    /// learn, without density control, and leading attributes cost neither memory nor passes. For night colours on
    /// geometry from day.
    freeze: Option<Freeze> = None, "nothing" => FREEZE, "--freeze PLANES";
    /// Masks (masks/NAME.png or masks/NAME.jpg.png) hide white instead of black.
    invert_masks: bool = false => Rule::Flag, "--invert-masks";
    /// Mask black borders and corners that the photographs have in the same place, as undistorting leaves them.
    mask_borders: bool = true => Rule::Flag;
    /// How the integer files of the photographs store light: srgb, as their formats say, or linear, as RAW converters
    /// and machine vision write sensor values; with srgb, levels are those of the format. Without either, files count
    /// as sRGB, with the levels that all of them together show: 10, 12 or 14 of 16 bits, the range of video, or a
    /// narrow range, and in float files a unit of their own.
    light: Option<StoredLight> = None, "srgb, and levels that the values show"
        => Rule::OneOf(&StoredLight::NAMES), "--light LIGHT";
    /// Mask what hardly changes between views that move, such as a date burnt into every photograph, with the black bar
    /// around it.
    mask_overlays: bool = true => Rule::Flag;
    /// White balance of the photographs before they are measured: gains R,G,B of linear light; the colour temperature
    /// of the light in kelvin; VIEW,x,y,w,h, a neutral area of one photograph in pixels as stored; or
    /// VIEW,x1,y1,..,x4,y4, the corners of a chart of 24 patches, at the dark skin, bluish green, black and white
    /// patch, which also gives a matrix for the colours.
    white_balance: Option<WhiteBalance> = None, "none" => WHITE_BALANCE, "--white-balance WHITE";
    /// The fall-off of the lens: with u = 1 - cos of the angle off the axis, the light of the photographs is multiplied
    /// by exp(falloff u), and by the square of u as well; 0: left as it is.
    falloff: Option<f64> = None, "found from the points where corners are dark" => Rule::from_to(0.0, 1000.0);
    /// The part of the fall-off with the square of u.
    falloff_squared: f64 = 0.0 => Rule::from_to(-1000.0, 1000.0);
    /// The bands of rows that lamps on mains leave under a rolling shutter: the number in the height of a photograph,
    /// and by the name of its view the parts c and s of the light, which is divided by 1 + c cos + s sin; {}: left as
    /// they are.
    bands: Option<RowBands> = None, "found from the points where rows differ"
        => Rule::Table("a table with count and waves");
    /// Undistort fisheye photographs to pinhole ones, cropped to 60 degrees off the axis, instead of training with the
    /// fisheye model; other distorted photographs are always undistorted.
    undistort: bool = false => Rule::Flag, "--undistort";
    /// Training steps (iterations), one view each.
    steps: u64 = 5000 => Rule::at_least(1), in "steps", "--steps N";
    /// Resize the photographs by 1/F.
    downscale: f64 = 1.0 => DOWNSCALE, "--downscale F";
    /// Maximum longest side of the photographs, to which larger ones are shrunk; 0 or none: no limit. The tone curve is
    /// applied at full resolution.
    max_resolution: u32 = 1600 => Rule::Whole(0, u32::MAX as u64), in "pixels", "--max-resolution N|none";
    /// Train larger photographs in patches of at most this size, with less memory per step and more steps per epoch.
    patch_pixels: Option<u64> = None, "the most that the device can bind"
        => Rule::at_least(MIN_PATCH), in "pixels", "--patch-pixels N";
    /// Use every Nth view by name as a test view, instead of the dataset's split; 0: no test views.
    test_every: Option<usize> = None, "the dataset's split, else every 8th, and none of fewer than 8"
        => Rule::COUNT, in "views", "--test-every N";
    /// Patterns of photographs to leave out, by name or by path as listed: `*`, `?` and `[abc]` match. Others keep
    /// their split.
    exclude: Vec<String> = vec![] => Rule::List(0, 1_000_000, &PATTERN);
    /// Memory for photographs on the device and on the host, such as 4G; the rest is kept on disk, which takes time but
    /// changes no result.
    cache: Option<CacheSize> = None, "a quarter of each memory" => MEMORY, in "bytes", "--cache SIZE";
    /// Device memory limit, such as 4G; densification stops below it, and exceeding it saves and exits with code 4.
    max_vram: Option<CacheSize> = None, "all" => MEMORY, in "bytes", "--max-vram SIZE";
    /// Estimated host memory limit, such as 16G; densification stops below it.
    max_ram: Option<CacheSize> = None, "all" => MEMORY, in "bytes", "--max-ram SIZE";
    /// Random seed; the same seed gives the same bits.
    seed: u64 = 10 => Rule::COUNT, "--seed S";
    /// Degree of the spherical harmonics.
    sh_degree: u32 = MAX_SH_DEGREE => Rule::Whole(0, MAX_SH_DEGREE as u64), "--sh-degree D";
    /// Weight of the loss 1 - SSIM; L1 has the remaining weight.
    ssim_weight: f64 = 0.2 => Rule::SHARE, "--ssim-weight W";
    /// Maximum number of Gaussians.
    max_gaussians: usize = 1_000_000 => Rule::at_least(1), in "Gaussians", "--max-gaussians N";
    /// Background during training: black, or random, a new colour every step; the plan chooses black below a black sky,
    /// which then needs no Gaussians. Scores and renders use black.
    background: Background = Background::Random => Rule::OneOf(&["black", "random"]), "--background BACKGROUND";
    /// Also score the test views every N steps, to evals.csv; 0: at the end only.
    eval_every: u64 = 0 => Rule::COUNT, in "steps", "--eval-every N";
    /// Write a checkpoint and the model every N steps; 0: never.
    checkpoint_every: u64 = 1000 => Rule::COUNT, in "steps", "--checkpoint-every N";
    /// Also write a checkpoint when the last one is this old; 0: never.
    checkpoint_minutes: f64 = 10.0 => MINUTES, in "minutes", "--checkpoint-minutes MINUTES";
    /// Save and stop after this time, with exit code 75, for --resume; 0: no limit.
    max_minutes: f64 = 0.0 => MINUTES, in "minutes", "--max-minutes MINUTES";
    /// Log checksums of the parameters to hashes.csv every N steps; 0: never.
    hash_every: u64 = 0 => Rule::COUNT, in "steps", "--hash-every N";
    /// Write logs for `tensorboard --logdir RUN`.
    tensorboard: bool = false => Rule::Flag, "--tensorboard";
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu.
    device: String = String::new(), "the best" => Rule::Text("a device", |_| true), "--device DEVICE";
    /// The tile that a workgroup renders: width and height in pixels, the number of subgroups that share it, the
    /// splats of a segment of the backward pass, and 1 for its sums in shared memory or 0.
    tile: Option<Tile> = None, "the fastest known on the device; recorded"
        => Rule::List(2, 5, &Rule::Whole(0, u32::MAX as u64));
    /// Near plane, in units of the scene extent: the distance of the cameras from their centre, rounded to a power of
    /// two.
    near: f64 = 0.1 => Rule::from_to(1e-6, 1.0), "--near N";
    /// The scene's extent in world units, which learning rates and density control are relative to: 1.1 times the
    /// largest distance of a camera from their mean.
    extent: Option<f64> = None, "found from the cameras" => Rule::POSITIVE, in "world units";
    /// The up direction in the dataset's world, for paths and exported files.
    up: Option<[f64; 3]> = None, "found from the cameras, and recorded"
        => Rule::List(3, 3, &Rule::Number(Bound::Unbounded, Bound::Unbounded));
    /// Random points to start from if the dataset has none.
    random_points: usize = 20_000 => Rule::at_least(1), in "points";
}
sections {
    /// The folder of the cache's spool file; `None`: the system's temporary folder.
    #[serde(skip)]
    spool: Option<PathBuf>;
    /// The training frame; by default from the cameras, and recorded.
    frame: Option<TrainingFrame>;
    /// The tone curve.
    tone: ToneSettings;
    /// Comparison of passes with their CPU references.
    check: CheckConfig;
    /// The first Gaussians.
    start: Initialization;
    /// Learning rates and schedule.
    schedule: Schedule;
    /// Density control.
    density: DensityConfig;
    /// Parts of the model in addition to colour.
    model: ModelConfig;
    /// Loss terms on the parameters of the Gaussians.
    loss: ParameterWeights;
    /// Early stopping.
    stop: StopConfig;
    /// Gain and bias of each training view.
    exposure: ExposureConfig;
    /// A lamp that moves with the camera.
    lamp: LampConfig;
    /// Filters against aliasing.
    antialiasing: AntialiasingConfig;
    /// Storage precision.
    precision: PrecisionConfig;
}
}

/// A size of memory.
const MEMORY: Rule =
    Rule::Text("a size of memory with its unit, such as 512M, 4G or 1.5G", |text| {
        text.parse::<CacheSize>().is_ok()
    });

const FREEZE: Rule = Rule::Text(Freeze::FORM, |text| text.parse::<Freeze>().is_ok());

const WHITE_BALANCE: Rule =
    Rule::Text(WhiteBalance::FORM, |text| text.parse::<WhiteBalance>().is_ok());

/// A pattern of photographs' names.
const PATTERN: Rule = Rule::Text(
    "a pattern of file names, such as IMG_01*.jpg",
    nightsplat_photographs::dataset::exclude::is_pattern,
);

const MINUTES: Rule = Rule::from_to(0.0, 1e9);

settings! {
"check."
/// Steps whose every pass is compared with its CPU reference.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckConfig {
    /// Compare every pass of every Nth step with its CPU reference, and warn of differences; 0: never.
    every: u64 = 0 => Rule::COUNT, in "steps", "--check-every N";
    /// Stop if a checked step differs.
    stops: bool = false => Rule::Flag, "--check-stops";
}
}

settings! {
"density."
/// Density control; [`Schedule`] has its steps.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityConfig {
    /// Densification: conserving splits a Gaussian into two that cover the same area; paper clones and splits as
    /// LITA-GS.
    control: DensityControl = DensityControl::Conserving => Rule::OneOf(&DensityControl::NAMES), "--density NAME";
    /// Densify Gaussians whose screen-space gradient, in normalised device coordinates, has more than this norm in the
    /// mean of the steps; conserving: the sum of the norms of all pixels, paper: the norm of their sum.
    gradient_threshold: Option<f64> = None, "0.0012; paper: 0.0002" => Rule::POSITIVE;
    /// Paper's control only: split Gaussians larger than this fraction of the extent, clone smaller ones.
    split_scale: f64 = 0.01 => Rule::POSITIVE_OR_0;
    /// Prune Gaussians of lower opacity.
    min_opacity: f64 = 0.005 => Rule::Number(Bound::Included(0.0), Bound::Excluded(1.0));
    /// Depth seeding, conserving control only: if the dataset has at most a tenth of this many points, add random
    /// points up to that tenth, and in the first round Gaussians at rendered depths up to this number; 0: off.
    depth_seeding: usize = 5_000 => Rule::COUNT, in "Gaussians";
}
}

impl DensityConfig {
    /// At most this many first Gaussians count as sparse.
    pub(super) fn sparse_threshold(&self) -> usize {
        if self.control.strategy().seeds_depths { self.depth_seeding / 10 } else { 0 }
    }

    /// The values of LITA-GS.
    #[doc(hidden)]
    pub fn paper() -> Self {
        Self { control: DensityControl::Paper, depth_seeding: 0, ..Self::default() }
    }
}

impl TrainConfig {
    /// The plain method, for measurements and tests: black background, 32-bit storage, no held-out views, no depth
    /// seeding, no cooldown.
    pub fn bare() -> Self {
        Self {
            background: Background::Black,
            schedule: Schedule { cooldown_steps: 0, ..Schedule::default() },
            density: DensityConfig { depth_seeding: 0, ..DensityConfig::default() },
            stop: StopConfig { views: 0, ..StopConfig::default() },
            precision: PrecisionConfig {
                rest: StorageFormat::Single,
                moments: StorageFormat::Single,
                ..PrecisionConfig::default()
            },
            ..Self::default()
        }
    }

    /// The configuration as TOML.
    ///
    /// # Errors
    /// Never for values that [`TrainConfig::check`] accepts.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|error| Error::Usage(error.to_string()))
    }

    /// The options to load the dataset with.
    pub fn load_options(&self) -> LoadOptions {
        LoadOptions {
            downscale: self.downscale,
            max_resolution: self.max_resolution,
            test_every: self.test_every,
            exclude: self.exclude.clone(),
            keep: CacheSize::on_host(self.cache, self.max_ram),
            images: self.images.clone(),
            orientation: self.orientation,
            reference: self.reference.clone(),
            targets: self.tone.targets().map(Path::to_owned),
            invert_masks: self.invert_masks,
            mask_borders: self.mask_borders,
            light: self.light,
            mask_overlays: self.mask_overlays,
            white_balance: self.white_balance.clone(),
            falloff: self.falloff.map(|falloff| [falloff, self.falloff_squared]),
            bands: self.bands.clone(),
            undistort: self.undistort,
            measured: match &self.tone {
                ToneSettings { law: Some(_), .. } => MeasuredSize::None,
                ToneSettings { full_resolution: true, .. } => MeasuredSize::Own,
                _ => MeasuredSize::Loaded,
            },
            hold_out: self.stop.views,
            depth: DepthOptions {
                load: self.model.depth,
                folder: self.model.depth_folder.clone(),
                is_disparity: self.model.depth_is_disparity,
            },
            normals: NormalOptions {
                load: self.model.normals,
                folder: self.model.normal_folder.clone(),
                axes: self.model.normal_axes,
            },
            ..LoadOptions::default()
        }
    }

    /// The scene's extent, world units: as given, or that of the cameras.
    pub(crate) fn extent_of(&self, dataset: &Dataset) -> f64 {
        self.extent.unwrap_or_else(|| dataset.extent())
    }

    /// Disables the parts depth and normals, with a warning, if no training view has such a map.
    pub(crate) fn disable_missing_parts(&mut self, dataset: &Dataset) {
        let ModelConfig { depth, normals, .. } = &mut self.model;
        let depth_maps = dataset.train_views().filter(|view| view.depth.is_some()).count();
        let normal_maps = dataset.train_views().filter(|view| view.normals.is_some()).count();
        let parts =
            [(depth, "depth", "depth", depth_maps), (normals, "normals", "normal", normal_maps)];
        for (part, folder, map, count) in parts {
            if *part && count == 0 {
                tracing::warn!(
                    "no view has a {map} map ({folder}/NAME.png, or in model.{map}_folder): no {map} term"
                );
                *part = false;
            } else if *part {
                let all = dataset.train_views().count();
                tracing::info!("{count} of {all} training views have a {map} map");
            }
        }
    }

    /// Moves the run to another copy of its dataset, with the paths inside its folder.
    pub(crate) fn move_dataset(&mut self, dataset: &Path) {
        let from = std::mem::replace(&mut self.dataset, dataset.to_owned());
        let inside = [
            &mut self.images,
            &mut self.reference,
            &mut self.model.depth_folder,
            &mut self.model.normal_folder,
            &mut self.exposure.start,
        ];
        for folder in inside.into_iter().flatten() {
            if let Ok(below) = folder.strip_prefix(&from) {
                *folder = dataset.join(below);
            }
        }
    }

    /// The settings of the rasteriser.
    #[doc(hidden)]
    pub fn render_settings(&self) -> RenderSettings {
        RenderSettings {
            shape: Shape { sh_degree: self.sh_degree, features: self.model.features() },
            raw_colors: self.model.raw_colors,
            antialiased: self.antialiasing.compensation,
            lamp: self.model.lamp.then_some(Lamp::AT_CAMERA),
            detach_geometry: self.model.network.variant == NetworkVariant::Identity,
            trains_depth: self.model.effective_weights().normals > 0.0,
            tile: self.tile,
            patch_pixels: self.patch_pixels,
            near: (self.near * FRAME_EXTENT) as f32,
            ..RenderSettings::default()
        }
    }

    /// What the file of a model of this configuration states, in the world of its training frame.
    pub(crate) fn facts(&self, frame: &TrainingFrame) -> ModelFacts {
        let RenderSettings { near, max_alpha, raw_colors, antialiased, .. } =
            self.render_settings();
        let near = (f64::from(near) / frame.scale) as f32;
        ModelFacts {
            // The unit of some worlds is too large or too small for the number.
            near: Some(near).filter(|near| near.is_normal()),
            max_alpha: Some(max_alpha),
            raw_colors: Some(raw_colors),
            antialiased,
            targets: self.stated_targets(),
            ..ModelFacts::default()
        }
    }

    /// Steps from one score of the held-out views to the next. Colours on frozen geometry converge within some hundred
    /// steps.
    pub(super) fn scored_every(&self) -> u64 {
        const FROZEN: u64 = 50;
        if self.freezes_geometry() { self.stop.every.min(FROZEN) } else { self.stop.every }
    }

    /// Whether the shape or the place of the Gaussians is frozen.
    pub(super) fn freezes_geometry(&self) -> bool {
        self.freeze.as_ref().is_some_and(Freeze::has_geometry)
    }

    /// Whether an attribute is frozen.
    pub(super) fn freezes(&self, attribute: Attribute) -> bool {
        self.freeze.as_ref().is_some_and(|freeze| freeze.has(attribute))
    }

    /// Whether every view has the same splats in every step.
    pub(super) fn freezes_splats(&self) -> bool {
        freezes_splats(self.frozen_columns())
    }

    /// The columns of the Gaussians' attributes, from the first, that no pass updates.
    pub(crate) fn frozen_columns(&self) -> u32 {
        self.freeze.as_ref().map_or(0, Freeze::leading_columns)
    }

    /// Whether the colours are frozen.
    pub(super) fn learns_no_colour(&self) -> bool {
        self.frozen_columns() as usize > Attribute::Dc.column(0)
    }

    /// The configuration of the loss.
    pub(crate) fn loss(&self) -> LossConfig {
        LossConfig {
            ssim_weight: self.ssim_weight,
            weights: self.model.effective_weights(),
            low: f64::from(u8::from(self.model.tonemapper)),
            parameters: self.loss,
            depth_box: self.model.depth_box,
            boxes: Stream::new(self.seed, streams::BOXES),
            features: self.model.features(),
            steps: self.steps,
        }
    }

    /// Refuses invalid values, by name.
    ///
    /// # Errors
    /// [`Error::Setting`], or [`Error::Usage`] for settings that exclude each other.
    pub fn check(&self) -> Result<()> {
        self.check_rows()?;
        self.tone.check()?;
        self.check.check_rows()?;
        self.start.check()?;
        self.schedule.check()?;
        self.density.check_rows()?;
        self.model.check()?;
        self.loss.check_rows()?;
        self.stop.check_rows()?;
        self.exposure.check_rows()?;
        self.exposure.rates.check_rows()?;
        self.lamp.check_rows()?;
        self.lamp.rates.check_rows()?;
        self.antialiasing.check_rows()?;
        self.precision.check_rows()?;
        if let Some(frame) = self.frame {
            frame.check_rows()?;
        }
        let refused = |key: &str, value: &str, rule: &str| {
            let [key, value, rule] = [key, value, rule].map(str::to_owned);
            Err(Error::Setting { key, value, rule })
        };
        if self.up.is_some_and(|up| DVec3::from_array(up).try_normalize().is_none()) {
            let rule = "a direction: three numbers that are not all 0";
            return refused("up", "no direction", rule);
        }
        if let Some(freeze) = self.freeze.as_ref().filter(|_| self.init.is_none()) {
            let rule = "of a given model: name one with init";
            return refused("freeze", &freeze.to_string(), rule);
        }
        if self.model.lamp && self.learns_no_colour() {
            let rule = "off where the colours are frozen, whose gradients it learns from";
            return refused("model.lamp", "true", rule);
        }
        if self.exposure.learn && self.model.tonemapper {
            let rule = "off with a tonemapper, which fits the dark photographs: a gain of the targets does not \
                        describe their exposures";
            return refused("exposure.learn", "true", rule);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_exclude_each_other_are_named_by_key() {
        let mut config = TrainConfig::default();
        (config.exposure.learn, config.model.tonemapper) = (true, true);
        let message = config.check().unwrap_err().to_string();
        assert!(message.starts_with("exposure.learn is true; it must be off with"), "{message}");
    }

    #[test]
    fn frozen_attributes_are_those_of_a_given_model() {
        let freeze = Some("means".parse().unwrap());
        let mut config = TrainConfig { freeze, ..Default::default() };
        let refused = config.check().unwrap_err().to_string();
        assert!(refused.contains("freeze is means; it must be of a given model"), "{refused}");
        config.init = Some("day.ply".into());
        config.check().unwrap();
        config.model.lamp = true;
        config.check().unwrap();
        let all = "means,quats,scales,opacities,dc".parse().unwrap();
        let frozen = TrainConfig { freeze: Some(all), ..config.clone() };
        let refused = frozen.check().unwrap_err().to_string();
        assert!(refused.contains("model.lamp is true; it must be off where"), "{refused}");
        assert_eq!(toml::from_str::<TrainConfig>(&config.to_toml().unwrap()).unwrap(), config);
    }

    #[test]
    fn invalid_values_are_refused_by_key() {
        let refused = |config: TrainConfig| config.check().unwrap_err().to_string();
        assert!(refused(TrainConfig { steps: 0, ..Default::default() }).contains("steps is 0"));
        let nan = TrainConfig { ssim_weight: f64::NAN, ..Default::default() };
        assert!(refused(nan).contains("ssim"));
        let high = TrainConfig { sh_degree: 4, ..Default::default() };
        assert!(refused(high).contains("sh_degree is 4; it must be a whole number, 0 to 3"));
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
