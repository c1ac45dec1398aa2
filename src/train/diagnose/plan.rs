//! What the model of a capture has, and why: what `diagnose` prints, `train` goes by and `plan.toml` holds.

use std::path::Path;

use serde::{Deserialize, Serialize};
use toml::Value;

use super::{Diagnosis, SceneDiagnosis};
use crate::base::input;
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::tone::ToneCurve;
use crate::splats::scene::{Features, Shape, width};
use crate::train::TrainConfig;
use crate::train::layers::{Origin, SettingsLayer};
use crate::{Error, Result};

/// Targets less than this many times brighter than their photographs are the photographs: the rule of `--curve auto`.
const MIN_BRIGHTENING: f64 = 1.5;
/// Targets whose exposures are spread by more stops are worth learning them. A chair of which the views differ by 1.2 stops,
/// all but .02 of which the curve takes away, lost .4 dB by it.
const MIN_SPREAD: f64 = 0.3;
/// From this much noise in the average over the views, of encoded values, a denoiser pays (docs/benchmarks.md).
const MIN_NOISE: f64 = 0.01;
/// Light that varies by more stops between large regions is worth an illumination of its own. A hall with one bright window
/// has 2.6; up to 1 the network bought .2 dB at most for two to four times the time.
const MIN_UNEVENNESS: f64 = 3.0;
/// Each SH coefficient of a channel is to be seen by so many views.
const VIEWS_PER_COEFFICIENT: f64 = 2.0;
/// A degree that the schedule reaches later in the run does not settle.
const LATEST_DEGREE: f64 = 0.8;
/// Pixels of the training views that a Gaussian is to stand for at least. Leaves that move took 9 where growth was free, a
/// chair 80.
const PIXELS_PER_GAUSSIAN: f64 = 8.0;
/// The fraction of the device's memory that Gaussians may take.
const MEMORY_SHARE: f64 = 0.5;
/// Buffers as long as the parameters: themselves, gradients, two moments; with headroom.
const COPIES: f64 = 4.0 * 1.5;

/// A part of the model: whether it is on, and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedPart {
    /// Whether the model has it.
    pub on: bool,
    /// The reason with its figure, a sentence.
    #[serde(default)]
    pub why: String,
}

/// A number of the model, and why it is that.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedNumber {
    /// The number.
    pub value: u64,
    /// The reason with its figure, a sentence.
    #[serde(default)]
    pub why: String,
}

/// Which dataset a plan is for: its training views by name and loaded size.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedViews {
    /// How many.
    pub views: usize,
    /// Width and height of the first.
    pub size: [u32; 2],
    /// Of all names and sizes.
    pub fingerprint: String,
}

impl PlannedViews {
    /// The dataset's own.
    pub fn of(dataset: &Dataset) -> Self {
        let views: Vec<_> = dataset.views.iter().filter(|view| view.is_for_training()).collect();
        let line =
            |view: &&View| format!("{} {}x{}\n", view.name, view.camera.width, view.camera.height);
        let lines: String = views.iter().map(line).collect();
        let hash = fnv1a(lines.bytes().map(u64::from));
        let size = views.first().map_or([0; 2], |view| [view.camera.width, view.camera.height]);
        Self { views: views.len(), size, fingerprint: format!("{hash:016x}") }
    }

    fn described(&self) -> String {
        let [width, height] = self.size;
        format!("{} training views of {width}x{height}", self.views)
    }
}

/// What the model of a capture has, and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Training views that are left out, by name.
    #[serde(default)]
    pub left_out: Vec<String>,
    /// Which dataset it is for.
    pub dataset: PlannedViews,
    /// A tone curve makes the targets; else the photographs are.
    pub curve: PlannedPart,
    /// Each view's exposure is learned.
    pub exposure: PlannedPart,
    /// [`Part::Denoiser`](crate::train::Part::Denoiser).
    pub denoiser: PlannedPart,
    /// [`Part::Tonemapper`](crate::train::Part::Tonemapper).
    pub tonemapper: PlannedPart,
    /// [`Part::Structure`](crate::train::Part::Structure).
    pub structure: PlannedPart,
    /// [`Part::Depth`](crate::train::Part::Depth).
    pub depth: PlannedPart,
    /// Highest degree of the spherical harmonics.
    pub sh_degree: PlannedNumber,
    /// Density control stops growing here.
    pub max_gaussians: PlannedNumber,
}

impl Plan {
    /// The plan for a capture under a configuration, whose steps, schedule and limits it keeps to, on a device with so many
    /// bytes of memory.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn new(diagnosis: &Diagnosis, config: &TrainConfig, memory: u64) -> Self {
        let scene = &diagnosis.scene;
        let sh_degree = sh_degree(scene, config);
        let curve = curve(scene);
        let follows_views = curve.on && !config.tone.scene_statistics;
        let spread = Spread::of(scene, follows_views, diagnosis.views.len());
        Self {
            left_out: diagnosis.black_views(),
            dataset: diagnosis.fingerprint.clone(),
            curve,
            exposure: spread.exposure(),
            denoiser: denoiser(scene),
            tonemapper: tonemapper(scene, spread.is_wide),
            structure: spread.structure(scene),
            depth: depth(diagnosis),
            max_gaussians: max_gaussians(diagnosis, config, sh_degree.value, memory),
            sh_degree,
        }
    }

    /// What the plan decides, as settings.
    ///
    /// # Errors
    /// A number is out of its range, in a plan that was written by hand.
    pub(in crate::train) fn layer(&self) -> Result<SettingsLayer> {
        let mut layer = SettingsLayer::default();
        let mut say = |key: &str, value: Value| layer.push(key, value, Origin::Plan);
        if !self.curve.on {
            say("tone.curve", ToneCurve::None.name().into())?;
        }
        say("exposure.learn", if self.exposure.on { "on" } else { "off" }.into())?;
        say("model.denoiser", self.denoiser.on.into())?;
        say("model.tonemapper", self.tonemapper.on.into())?;
        say("model.structure", self.structure.on.into())?;
        say("model.depth", self.depth.on.into())?;
        for (key, number) in
            [("sh_degree", &self.sh_degree), ("max_gaussians", &self.max_gaussians)]
        {
            say(key, i64::try_from(number.value).unwrap_or(i64::MAX).into())?;
        }
        Ok(layer)
    }

    /// Every decision: its name, what was decided, and why.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn decisions(&self) -> Vec<(&'static str, String, &str)> {
        let switch = |name, switch: &'_ PlannedPart| {
            let on = if switch.on { "on" } else { "off" };
            (name, on.to_owned())
        };
        let number = |name, number: &'_ PlannedNumber| (name, number.value.to_string());
        let named = [
            (switch("curve", &self.curve), &self.curve.why),
            (switch("exposure", &self.exposure), &self.exposure.why),
            (switch("denoiser", &self.denoiser), &self.denoiser.why),
            (switch("tonemapper", &self.tonemapper), &self.tonemapper.why),
            (switch("structure", &self.structure), &self.structure.why),
            (switch("depth", &self.depth), &self.depth.why),
            (number("sh_degree", &self.sh_degree), &self.sh_degree.why),
            (number("max_gaussians", &self.max_gaussians), &self.max_gaussians.why),
        ];
        named.into_iter().map(|((name, value), why)| (name, value, why.as_str())).collect()
    }

    /// The plan as TOML.
    ///
    /// # Errors
    /// None for a plan that was made or read.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn to_toml(&self) -> Result<String> {
        const HEAD: &str = "# What this capture needs, and why. Change what you know better and pass it to \
                            `nightsplat train --plan FILE`.\n\n";
        let text = toml::to_string(self).map_err(|error| Error::Usage(error.to_string()))?;
        Ok(HEAD.to_owned() + &text)
    }

    /// Reads the plan of a dataset.
    ///
    /// # Errors
    /// [`Error::Input`]: the file cannot be read, holds no plan, or that of another dataset.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn load(path: &Path, dataset: &Dataset) -> Result<Self> {
        let plan = Self::read(path)?;
        let own = PlannedViews::of(dataset);
        if plan.dataset != own {
            let (of, is) = (plan.dataset.described(), own.described());
            let problem = format!(
                "is the plan of another dataset ({of}; {} has {is}, by other names or sizes); diagnose this one",
                dataset.root.display()
            );
            return Err(Error::input(path, problem));
        }
        Ok(plan)
    }

    /// Reads a plan, of whichever dataset.
    ///
    /// # Errors
    /// [`Error::Input`]: the file cannot be read or holds no plan.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = input::text(path)?;
        toml::from_str(&text).map_err(|error| {
            let line = error.span().map(|span| text[..span.start].matches('\n').count() + 1);
            let place = line.map(|line| format!(" (line {line})")).unwrap_or_default();
            let message = error.message().lines().next().unwrap_or_default();
            Error::input(
                path,
                format!("is no plan: {message}{place}; make one with `nightsplat diagnose`"),
            )
        })
    }
}

fn curve(scene: &SceneDiagnosis) -> PlannedPart {
    let SceneDiagnosis { brightening, mean_luminance, .. } = scene;
    let on = *brightening >= MIN_BRIGHTENING;
    let verdict = if on { "dark" } else { "well lit" };
    let why = format!(
        "{verdict}: a target is {brightening:.1} times as bright as its photograph (mean luminance {mean_luminance:.3}, a curve from {MIN_BRIGHTENING})"
    );
    PlannedPart { on, why }
}

/// How far the exposures of the targets lie apart.
struct Spread {
    /// Enough to be worth learning them.
    is_wide: bool,
    found: String,
}

impl Spread {
    /// A curve that follows each view takes most of the photographs' spread away.
    fn of(scene: &SceneDiagnosis, follows_views: bool, views: usize) -> Self {
        let SceneDiagnosis { exposure_spread: spread, exposure_share: share, .. } = *scene;
        let left = if follows_views { (1.0 - share) * spread } else { spread };
        let by = if scene.spread_is_measured {
            "at shared points"
        } else {
            "of the gain each view asks for"
        };
        Self {
            is_wide: left >= MIN_SPREAD && views > 2,
            found: format!(
                "exposures are spread by {spread:.2} stops {by}, of which the targets keep {left:.2}"
            ),
        }
    }

    fn exposure(&self) -> PlannedPart {
        PlannedPart { on: self.is_wide, why: format!("{} (learned from {MIN_SPREAD})", self.found) }
    }

    fn structure(&self, scene: &SceneDiagnosis) -> PlannedPart {
        let on = self.is_wide && scene.target_noise < MIN_NOISE;
        PlannedPart { on, why: format!("{}: edges are the same in all of them", self.found) }
    }
}

fn denoiser(scene: &SceneDiagnosis) -> PlannedPart {
    let SceneDiagnosis { target_noise, views_per_point, .. } = scene;
    let on = *target_noise >= MIN_NOISE;
    let why = format!(
        "the average of {views_per_point:.0} views leaves noise of {target_noise:.3} in the target (a network from {MIN_NOISE})"
    );
    PlannedPart { on, why }
}

fn tonemapper(scene: &SceneDiagnosis, learns_exposures: bool) -> PlannedPart {
    let unevenness = scene.unevenness;
    // A learned exposure does not describe the dark photographs, to which the tonemapper holds the model.
    let on =
        unevenness >= MIN_UNEVENNESS && scene.brightening >= MIN_BRIGHTENING && !learns_exposures;
    let why = format!(
        "light varies by {unevenness:.1} stops between large regions (an illumination of its own from {MIN_UNEVENNESS}, in dark sets)"
    );
    PlannedPart { on, why }
}

fn depth(diagnosis: &Diagnosis) -> PlannedPart {
    let (maps, views) = (diagnosis.depth_maps, diagnosis.views.len());
    PlannedPart { on: maps > 0, why: format!("{maps} of {views} training views have a depth map") }
}

/// The highest degree whose coefficients are seen often enough and trained long enough.
fn sh_degree(scene: &SceneDiagnosis, config: &TrainConfig) -> PlannedNumber {
    let seen = (scene.views_per_point / VIEWS_PER_COEFFICIENT).sqrt() - 1.0;
    let seen = seen.max(0.0) as u32;
    let last = (config.steps as f64 * LATEST_DEGREE) as u64;
    let trained = config.schedule.sh_degree(last, u32::MAX);
    let value = config.sh_degree.min(seen).min(trained);
    let why = if config.sh_degree < seen.min(trained) {
        "the preset's or the configuration's limit".to_owned()
    } else if trained < seen.min(config.sh_degree) {
        format!("{} steps are too few to train a higher one", config.steps)
    } else {
        let views = scene.views_per_point;
        format!(
            "a point is seen by {views:.0} views, {VIEWS_PER_COEFFICIENT} are wanted for each of the (degree + 1)^2 coefficients"
        )
    };
    PlannedNumber { value: value.into(), why }
}

fn max_gaussians(
    diagnosis: &Diagnosis,
    config: &TrainConfig,
    sh_degree: u64,
    memory: u64,
) -> PlannedNumber {
    // Features are 8 floats at most, which the headroom covers.
    let shape = Shape { sh_degree: sh_degree as u32, features: Features::NONE };
    let pixels = diagnosis.pixels as f64;
    let wanted = (pixels / PIXELS_PER_GAUSSIAN).max(diagnosis.scene.points as f64);
    let bytes = width(shape) as f64 * size_of::<f32>() as f64 * COPIES;
    let fitting = MEMORY_SHARE * memory as f64 / bytes;
    let limit = config.max_gaussians as f64;
    let why = if limit < wanted.min(fitting) {
        "the preset's or the configuration's limit".to_owned()
    } else if fitting < wanted {
        let gib = memory as f64 / f64::from(1 << 30);
        format!("half of the device's {gib:.1} GiB at {bytes:.0} bytes each")
    } else {
        format!("one for {PIXELS_PER_GAUSSIAN} of the {pixels:.0} pixels to train on")
    };
    PlannedNumber { value: wanted.min(fitting).min(limit).round().max(1.0) as u64, why }
}

/// The hash FNV-1a, which plans hold: equal bytes have equal hashes, on every machine.
fn fnv1a(bytes: impl Iterator<Item = u64>) -> u64 {
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ byte).wrapping_mul(0x0100_0000_01b3))
}
