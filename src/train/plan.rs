//! The plan of a model with its reasons: `diagnose` prints it, `train` follows it and `plan.toml` stores it.

use std::path::Path;

use nightsplat_core::input;
use nightsplat_diagnose::{DiagnosedViews, Diagnosis, SceneDiagnosis};
use nightsplat_models::gaussians::{Features, Shape, width};
use nightsplat_photographs::dataset::{Dataset, RowBands};
use nightsplat_photographs::findings::too_near_white;
use nightsplat_photographs::tone::{BLACK_SKY, Tone, ToneCurve};
use serde::{Deserialize, Serialize};
use toml::Value;

use crate::train::config::{LampConfig, TrainConfig};
use crate::train::layers::{Origin, SettingsLayer};
use crate::{Error, Result};

/// Below this brightening, targets are the photographs themselves, as in `--curve auto`.
const MIN_BRIGHTENING: f64 = 1.5;
/// Exposures are learned from this spread of the targets, in stops. On a set with 1.2 stops between its photographs and
/// 0.02 between its targets, learning lost 0.4 dB.
const MIN_SPREAD: f64 = 0.3;
/// A denoiser is worth its time from this noise in the average over the views, in encoded values
/// (docs/measurements.md).
const MIN_NOISE: f64 = 0.01;
/// An illumination is learned from this variation of light between large regions, in stops. A hall with one bright
/// window has 2.6; up to 1, the network gained at most 0.2 dB for two to four times the time.
const MIN_UNEVENNESS: f64 = 3.0;
/// Views required for each SH coefficient of a channel.
const VIEWS_PER_COEFFICIENT: f64 = 2.0;
/// A degree that is reached after this fraction of the steps is not worth its memory.
const LATEST_DEGREE: f64 = 0.8;
/// The fewest pixels of the training views for each Gaussian. With unlimited growth, a scene of moving leaves had 9 and
/// a chair 80.
const PIXELS_PER_GAUSSIAN: f64 = 8.0;
/// The fraction of the device's memory that Gaussians may take.
const MEMORY_SHARE: f64 = 0.5;
/// Buffers of the parameters' size: parameters, gradients, two moments; with headroom.
const COPIES: f64 = 4.0 * 1.5;

/// The decision on a part of the model, with its reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedPart {
    /// Whether the model has it.
    pub on: bool,
    /// The reason with its figure, as a sentence.
    #[serde(default)]
    pub why: String,
}

/// The decision on a number of the model, with its reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedNumber {
    /// The number.
    pub value: u64,
    /// The reason with its figure, as a sentence.
    #[serde(default)]
    pub why: String,
}

/// The decision on a lamp at the camera, with the numbers from which its learning begins and its reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedLamp {
    /// Whether the model has it.
    pub on: bool,
    /// The power of the distance by which its light falls.
    #[serde(default)]
    pub exponent: f64,
    /// Its fall with u = 1 - cos of the angle off its axis, and with the square of u.
    #[serde(default)]
    pub falloff: [f64; 2],
    /// The share of light that does not move with the camera.
    #[serde(default)]
    pub ambient: f64,
    /// The reason with its figure, as a sentence.
    #[serde(default)]
    pub why: String,
}

/// The fall-off of the lens that the photographs are corrected by, with its reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedFalloff {
    /// Whether they are.
    pub on: bool,
    /// Of u = 1 - cos of the angle off the axis, and of the square of u.
    #[serde(default)]
    pub falloff: [f64; 2],
    /// The reason with its figure, as a sentence.
    #[serde(default)]
    pub why: String,
}

/// The bands of rows that the photographs are corrected by, with their reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedBands {
    /// Whether they are.
    pub on: bool,
    /// Their number and the wave of each photograph.
    #[serde(default)]
    pub rows: RowBands,
    /// The reason with its figure, as a sentence.
    #[serde(default)]
    pub why: String,
}

/// The plan of a capture's model, with its reasons.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// The names of training views that are left out.
    #[serde(default)]
    pub left_out: Vec<String>,
    /// The dataset that it is for.
    pub dataset: DiagnosedViews,
    /// The fall-off of the lens.
    #[serde(default)]
    pub falloff: PlannedFalloff,
    /// Bands of rows.
    #[serde(default)]
    pub bands: PlannedBands,
    /// Whether a tone curve makes the targets; otherwise they are the photographs.
    pub curve: PlannedPart,
    /// Whether the model leaves a black sky open, over a black background.
    #[serde(default)]
    pub sky: PlannedPart,
    /// Whether each view's exposure is learned.
    pub exposure: PlannedPart,
    /// [`Part::Lamp`](crate::train::Part::Lamp).
    #[serde(default)]
    pub lamp: PlannedLamp,
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
    /// The largest number of Gaussians.
    pub max_gaussians: PlannedNumber,
}

impl Plan {
    /// Plans the model of a capture, within the steps, schedule and limits of a configuration, for a device with
    /// `memory` bytes.
    pub fn new(diagnosis: &Diagnosis, config: &TrainConfig, memory: u64) -> Self {
        let scene = &diagnosis.scene;
        let sh_degree = sh_degree(scene, config);
        let curve = curve(scene, config);
        let follows_views = curve.on && !config.tone.scene_statistics;
        let spread = Spread::new(scene, follows_views, diagnosis.views.len());
        Self {
            left_out: diagnosis.black_views(),
            dataset: diagnosis.fingerprint.clone(),
            falloff: falloff(scene),
            bands: bands(scene),
            sky: sky(scene, curve.on),
            curve,
            exposure: spread.exposure(),
            lamp: lamp(scene, config),
            denoiser: denoiser(scene),
            tonemapper: tonemapper(scene, spread.is_wide),
            structure: spread.structure(scene),
            depth: depth(diagnosis),
            max_gaussians: max_gaussians(diagnosis, config, sh_degree.value, memory),
            sh_degree,
        }
    }

    /// The plan's decisions as settings.
    pub(super) fn layer(&self) -> Result<SettingsLayer> {
        let mut layer = SettingsLayer::default();
        let mut set = |key: &str, value: Value| layer.push(key, value, Origin::Plan);
        if self.falloff.on {
            let [first, second] = self.falloff.falloff;
            set("falloff", first.into())?;
            set("falloff_squared", second.into())?;
        }
        if self.bands.on {
            let rows = Value::try_from(&self.bands.rows);
            set("bands", rows.map_err(|error| Error::Usage(error.to_string()))?)?;
        }
        if !self.curve.on {
            set("tone.curve", ToneCurve::None.name().into())?;
        }
        if self.sky.on {
            set("background", "black".into())?;
        }
        set("exposure.learn", self.exposure.on.into())?;
        set("model.lamp", self.lamp.on.into())?;
        if self.lamp.on {
            set("lamp.exponent", self.lamp.exponent.into())?;
            set("lamp.falloff", self.lamp.falloff[0].into())?;
            set("lamp.falloff_squared", self.lamp.falloff[1].into())?;
            set("lamp.ambient", self.lamp.ambient.into())?;
        }
        set("model.denoiser", self.denoiser.on.into())?;
        set("model.tonemapper", self.tonemapper.on.into())?;
        set("model.structure", self.structure.on.into())?;
        set("model.depth", self.depth.on.into())?;
        for (key, number) in
            [("sh_degree", &self.sh_degree), ("max_gaussians", &self.max_gaussians)]
        {
            set(key, i64::try_from(number.value).unwrap_or(i64::MAX).into())?;
        }
        Ok(layer)
    }

    /// Name, decision and reason of every item.
    pub fn decisions<'a>(&'a self) -> Vec<(&'static str, String, &'a str)> {
        let switch = |on: bool| if on { "on" } else { "off" }.to_owned();
        let part = |name, part: &'a PlannedPart| (name, switch(part.on), part.why.as_str());
        let number = |name, it: &'a PlannedNumber| (name, it.value.to_string(), it.why.as_str());
        vec![
            ("falloff", switch(self.falloff.on), &self.falloff.why),
            ("bands", switch(self.bands.on), &self.bands.why),
            part("curve", &self.curve),
            part("sky", &self.sky),
            part("exposure", &self.exposure),
            ("lamp", switch(self.lamp.on), &self.lamp.why),
            part("denoiser", &self.denoiser),
            part("tonemapper", &self.tonemapper),
            part("structure", &self.structure),
            part("depth", &self.depth),
            number("sh_degree", &self.sh_degree),
            number("max_gaussians", &self.max_gaussians),
        ]
    }

    /// The plan as TOML.
    pub fn to_toml(&self) -> Result<String> {
        const HEAD: &str = "# What this capture needs, and why. Change what you know better and pass it to \
                            `nightsplat train --plan FILE`.\n\n";
        let text = toml::to_string(self).map_err(|error| Error::Usage(error.to_string()))?;
        Ok(HEAD.to_owned() + &text)
    }

    /// Reads the plan of a dataset.
    pub fn load(path: &Path, dataset: &Dataset) -> Result<Self> {
        let plan = Self::read(path)?;
        let loaded = DiagnosedViews::new(dataset);
        if plan.dataset != loaded {
            let (of, is) = (plan.dataset.described(), loaded.described());
            let problem = format!(
                "is the plan of another dataset ({of}; {} has {is}, with other names or sizes); diagnose this one",
                dataset.root.display()
            );
            return Err(Error::input(path, problem));
        }
        Ok(plan)
    }

    /// Reads a plan of any dataset.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = input::text(path)?;
        toml::from_str(&text).map_err(|error| {
            let line = error.span().map(|span| text[..span.start].matches('\n').count() + 1);
            let line = line.map(|line| format!(" (line {line})")).unwrap_or_default();
            let message = error.message().lines().next().unwrap_or_default();
            let problem =
                format!("is not a plan: {message}{line}; make one with `nightsplat diagnose`");
            Error::input(path, problem)
        })
    }
}

fn falloff(scene: &SceneDiagnosis) -> PlannedFalloff {
    let Some(found) = scene.falloff else {
        let why = scene.lamp_unknown.as_deref().unwrap_or("the light of a lamp falls off as well");
        let why = format!("the fall-off of the lens is not measurable: {why}");
        return PlannedFalloff { on: false, falloff: [0.0; 2], why };
    };
    let remedy = match (found.is_corrected, found.is_found()) {
        (true, _) => "; corrected (falloff = 0 leaves it)",
        (false, true) => "; not corrected",
        (false, false) => "",
    };
    PlannedFalloff { on: found.is_corrected, falloff: found.falloff, why: found.why() + remedy }
}

fn bands(scene: &SceneDiagnosis) -> PlannedBands {
    let Some(found) = &scene.bands else {
        let why = scene.lamp_unknown.as_deref().unwrap_or("no points");
        let why = format!("bands of rows are not measurable: {why}");
        return PlannedBands { why, ..PlannedBands::default() };
    };
    let (rows, remedy) = match (found.is_corrected, found.is_found()) {
        (true, _) => (found.rows.clone(), "; corrected (bands = {} leaves them)"),
        (false, true) => (RowBands::default(), "; not corrected"),
        (false, false) => (RowBands::default(), ""),
    };
    PlannedBands { on: found.is_corrected, rows, why: found.why() + remedy }
}

fn curve(scene: &SceneDiagnosis, config: &TrainConfig) -> PlannedPart {
    let SceneDiagnosis { brightening, mean_luminance, .. } = scene;
    let on = *brightening >= MIN_BRIGHTENING;
    let verdict = if on { "dark" } else { "well lit" };
    let why = format!(
        "{verdict}: targets are {brightening:.1} times as bright as the photographs (mean luminance \
         {mean_luminance:.3}; threshold {MIN_BRIGHTENING})"
    );
    // A user who asks for a curve or a brightness has seen the targets.
    let is_asked = config.tone.curve != Tone::Auto || config.tone.brightness.is_some();
    let near_white = too_near_white(scene.brought_near_white).filter(|_| on && !is_asked);
    PlannedPart {
        on,
        why: [Some(why), near_white].into_iter().flatten().collect::<Vec<_>>().join("; "),
    }
}

/// Without Gaussians, a sky is as black as its background. A random one would have to be covered, by Gaussians that no
/// point starts.
fn sky(scene: &SceneDiagnosis, has_curve: bool) -> PlannedPart {
    let SceneDiagnosis { black_sky, .. } = *scene;
    let on = has_curve && black_sky >= BLACK_SKY;
    let why = format!(
        "{:.0} % of a photograph is black{} (threshold {:.0} %, dark sets only)",
        100.0 * black_sky,
        if on { ": sky that stays open, over a black background" } else { "" },
        100.0 * BLACK_SKY
    );
    PlannedPart { on, why }
}

/// The spread of the targets' exposures.
struct Spread {
    /// Whether the spread is wide enough to learn exposures.
    is_wide: bool,
    found: String,
}

impl Spread {
    /// A curve that follows each view compensates most of the photographs' spread.
    fn new(scene: &SceneDiagnosis, follows_views: bool, views: usize) -> Self {
        let SceneDiagnosis { exposure_share: share, spread_is_measured, .. } = *scene;
        // With a lamp, all views have one curve, and what it explains is not the exposures'.
        let beside_lamp = scene.lamp.as_ref().filter(|lamp| lamp.is_found());
        let spread = beside_lamp.map_or(scene.exposure_spread, |lamp| lamp.exposure_spread);
        let follows_views = follows_views && beside_lamp.is_none();
        let left = if follows_views { (1.0 - share) * spread } else { spread };
        let by = match (beside_lamp, spread_is_measured) {
            (Some(_), _) => "beside the lamp",
            (None, true) => "at shared points",
            (None, false) => "by the views' gains",
        };
        Self {
            is_wide: left >= MIN_SPREAD && views > 2,
            found: format!("exposures spread by {spread:.2} stops {by}, {left:.2} in the targets"),
        }
    }

    fn exposure(&self) -> PlannedPart {
        PlannedPart { on: self.is_wide, why: format!("{} (threshold {MIN_SPREAD})", self.found) }
    }

    fn structure(&self, scene: &SceneDiagnosis) -> PlannedPart {
        let on = self.is_wide && scene.target_noise < MIN_NOISE;
        let why =
            format!("{} (threshold {MIN_SPREAD}); edges do not depend on exposure", self.found);
        PlannedPart { on, why }
    }
}

/// Without a lamp, a plan that is edited to have one begins at the configuration's.
fn lamp(scene: &SceneDiagnosis, config: &TrainConfig) -> PlannedLamp {
    let LampConfig { exponent, ambient, falloff, falloff_squared, .. } = config.lamp;
    let falloff = [falloff, falloff_squared];
    let usual = |why: String| PlannedLamp { on: false, exponent, ambient, falloff, why };
    match &scene.lamp {
        None => {
            let why = scene.lamp_unknown.as_deref().unwrap_or("not measured");
            usual(format!("a lamp that moves with the camera is not measurable: {why}"))
        }
        Some(lamp) if !lamp.is_found() => usual(lamp.why()),
        Some(lamp) if config.learns_no_colour() => {
            usual(format!("{}; the colours are frozen", lamp.why()))
        }
        Some(lamp) => PlannedLamp {
            on: true,
            exponent: lamp.exponent,
            falloff: lamp.falloff,
            ambient: lamp.ambient,
            why: lamp.why(),
        },
    }
}

fn denoiser(scene: &SceneDiagnosis) -> PlannedPart {
    let SceneDiagnosis { target_noise, views_per_point, .. } = scene;
    let on = *target_noise >= MIN_NOISE;
    let why = format!(
        "averaging {views_per_point:.0} views leaves noise of {target_noise:.3} in the targets (threshold {MIN_NOISE})"
    );
    PlannedPart { on, why }
}

fn tonemapper(scene: &SceneDiagnosis, learns_exposures: bool) -> PlannedPart {
    let unevenness = scene.unevenness;
    // The tonemapper models the dark photographs, to which a learned exposure of targets does not apply.
    let on =
        unevenness >= MIN_UNEVENNESS && scene.brightening >= MIN_BRIGHTENING && !learns_exposures;
    let why = format!(
        "light varies by {unevenness:.1} stops between large regions (threshold {MIN_UNEVENNESS}, dark sets only)"
    );
    PlannedPart { on, why }
}

fn depth(diagnosis: &Diagnosis) -> PlannedPart {
    let (maps, views) = (diagnosis.depth_maps, diagnosis.views.len());
    PlannedPart { on: maps > 0, why: format!("{maps} of {views} training views have a depth map") }
}

/// The highest degree whose coefficients have enough views and steps, or that of the given model.
fn sh_degree(scene: &SceneDiagnosis, config: &TrainConfig) -> PlannedNumber {
    let seen = (scene.views_per_point / VIEWS_PER_COEFFICIENT).sqrt() - 1.0;
    let seen = seen.max(0.0) as u32;
    let last = (config.steps as f64 * LATEST_DEGREE) as u64;
    let trained = config.schedule.sh_degree(last, u32::MAX);
    let value = config.sh_degree.min(seen).min(trained);
    if let Some(given) = config.initial_degree().filter(|given| *given > value) {
        return PlannedNumber { value: given.into(), why: "that of the given model".to_owned() };
    }
    let why = if config.sh_degree < seen.min(trained) {
        "the preset's or the configuration's limit".to_owned()
    } else if trained < seen.min(config.sh_degree) {
        format!("{} steps are too few for a higher one", config.steps)
    } else {
        let views = scene.views_per_point;
        format!(
            "a point is seen by {views:.0} views; each of the (degree + 1)^2 coefficients needs {VIEWS_PER_COEFFICIENT}"
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
    // Features are at most 8 floats, within the headroom.
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
        format!("half of the device's {gib:.1} GiB, at {bytes:.0} bytes each")
    } else {
        format!("one for every {PIXELS_PER_GAUSSIAN} of the {pixels:.0} training pixels")
    };
    PlannedNumber { value: wanted.min(fitting).min(limit).round().max(1.0) as u64, why }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::gpu;
    use crate::train::{CacheSize, Trainer};
    use nightsplat_photographs::image::openings;
    use nightsplat_photographs::tone::ToneSettings;
    use nightsplat_synth::SyntheticOptions;

    #[test]
    fn a_photograph_is_opened_once_before_the_first_step() {
        let set = SyntheticOptions { views: 9, width: 64, height: 48, ..Default::default() };
        for (downscale, curve) in [
            (1.0, Tone::Auto),
            (2.0, Tone::Auto),
            (1.0, ToneCurve::Ase.into()),
            (2.0, ToneCurve::Ase.into()),
        ] {
            let folder = tempfile::tempdir().unwrap();
            nightsplat_synth::write(folder.path(), &set).unwrap();
            let config = TrainConfig {
                dataset: folder.path().to_owned(),
                tone: ToneSettings::new(curve.clone()),
                cache: Some(CacheSize(1 << 28)),
                downscale,
                ..TrainConfig::default()
            };
            let (dataset, _) = Diagnosis::load(&config.dataset, &config.load_options()).unwrap();
            Trainer::new(&gpu(), config, &dataset).unwrap();
            let opened = openings::below(folder.path());
            assert!(opened.len() >= 9, "{opened:?}");
            for (path, count) in opened {
                assert_eq!(count, 1, "{}: {downscale}, {curve:?}", path.display());
            }
        }
    }
}
