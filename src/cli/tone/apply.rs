//! `nightsplat tone apply`: measures photographs and applies a tone curve to them.

mod page;
mod photographs;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nightsplat_core::output::{create_folder, one_line};
use nightsplat_photographs::dataset::{Dataset, Split};
use nightsplat_photographs::findings::findings;
use nightsplat_photographs::image::{
    ColourCounts, Image, ImageFile as _, Mask, Orientation, PictureFile, decoded_at_once,
};
use nightsplat_photographs::metrics::Scores;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{
    CurveChoice, Exposure, MeasuredPhotograph, NEAR_WHITE, Statistics, Tone, ToneSettings,
    all_black,
};
use nightsplat_photographs::tree::check_writable;
use nightsplat_report::Distribution;
use rayon::prelude::*;
use serde::Serialize;

use self::page::TonePage;
use self::photographs::{InputPhotograph, listed};
use crate::cli::settings::{CurveOptions, Selection, SettingOptions};
use crate::cli::tell::wrapped;
use crate::cli::{OutputFormat, finish, print, progress_bar, quoted, word, words};
use crate::driver;
use crate::gpu::{DeviceChoice, Gpu};
use crate::results::eval;
use crate::targets::Targets;
use crate::train::{RequestedSettings, TrainConfig};
use crate::{Error, Result};
use nightsplat_diagnose::remarks_at_points;

/// Apply a tone curve to photographs, and measure the effect.
#[derive(Clone, Debug, clap::Args)]
pub struct ApplyArgs {
    /// Photograph (PNG, JPEG, WebP, TIFF, EXR), folder of photographs, or dataset
    ///
    /// Photograph (PNG, JPEG, WebP, TIFF, EXR), folder of photographs, or dataset. Photographs are turned upright by
    /// Exif; those of a dataset are taken as stored, and not undistorted.
    pub input: PathBuf,
    #[command(flatten)]
    tone: CurveOptions,
    #[command(flatten)]
    settings: SettingOptions<OfTargets>,
    /// Folder for the results, under the same names [default: write nothing]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// References in normal light to score against: a folder with the same names, or a file
    #[arg(long, value_name = "DIR|FILE")]
    pub reference: Option<PathBuf>,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// Write a page with all photographs, dark and lit, measurements and histograms
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// More curves for the page
    #[arg(long, value_name = "NAME|FILE,..", value_delimiter = ',', requires = "report")]
    #[arg(value_parser = words::curves::<CurveChoice>())]
    pub compare: Vec<CurveChoice>,
    /// Image format
    #[arg(long, value_enum, default_value_t)]
    pub format: OutputFormat,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// Settings of targets, without those of [`CurveOptions`].
#[derive(Clone, Copy, Debug)]
struct OfTargets;

impl Selection for OfTargets {
    fn has(key: &str) -> bool {
        let of_tone = ["brightness", "colour", "theta", "scene_statistics"];
        key.strip_prefix("tone.").is_some_and(|name| of_tone.contains(&name))
            || ["light", "white_balance", "invert_masks"].contains(&key)
    }
}

impl ApplyArgs {
    /// The settings of the command line; `curve`: with another curve.
    fn config(&self, curve: Option<&CurveChoice>) -> Result<TrainConfig> {
        let mut tone = self.tone.clone();
        if let Some(curve) = curve {
            (tone.curve, tone.profile) = (Some(curve.clone()), None);
        }
        let is_auto = tone.profile.is_none()
            && tone.curve.as_ref().is_none_or(|curve| *curve == Tone::Auto.into());
        let mut requested = RequestedSettings::default();
        tone.push(&mut requested.options)?;
        self.settings.push(&mut requested.options)?;
        let mut config = requested.settings(None)?.config()?;
        if is_auto && self.settings.get("tone.colour").is_none() && !Dataset::is_at(&self.input) {
            // References of single photographs are less saturated than those of scenes.
            config.tone.colour = 0.0;
        }
        config.tone.check()?;
        Ok(config)
    }
}

/// Statistics of the sRGB-encoded values of a photograph or of a result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Measures {
    /// 10th percentile of the luminance.
    pub p10: f64,
    /// 90th percentile of the luminance.
    pub p90: f64,
    /// p10 / p90; 1 for a black image.
    pub r: f64,
    /// Mean luminance.
    pub mean_luminance: f64,
    /// Mean over all channels.
    pub mean: f64,
    /// Fraction of values of all channels that are 0.94 or more.
    pub near_white_fraction: f64,
    /// Skewness of the luminance.
    pub skewness: f64,
}

/// Measurements of a photograph, or their means over a scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ToneReport {
    /// The photograph.
    #[serde(flatten)]
    pub before: Measures,
    /// Black level by the alpha and beta of the curve, if it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub delta0: Option<f64>,
    /// Pixels that are masked, or not finite and thus black in the result; no statistic includes them.
    pub unusable_pixels: usize,
    /// The result.
    pub after: Measures,
    /// The k of soft(x; k) with the brightness of the result, if measured from the photographs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// Scores of the result against the reference.
    #[serde(flatten)]
    pub scores: Option<Scores>,
}

/// The output of `tone apply`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ToneOutput {
    /// Settings of the curve.
    pub curve: ToneSettings,
    /// The references that the curve was fitted to, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub with_reference: Option<String>,
    /// The measured exposure, if the gain is automatic.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<Exposure>,
    /// Means of statistics over training views and of scores over test views; without a split, over all.
    pub scene: ToneReport,
    /// What is odd about the photographs, a sentence each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub remarks: Vec<String>,
    /// Measurements by view.
    pub views: BTreeMap<String, ToneReport>,
}

impl Measures {
    fn new(planes: &[f32], statistics: &Statistics) -> Self {
        let mut distribution = Distribution::new("");
        distribution.add(planes);
        let near_white = planes.iter().filter(|&&value| f64::from(value) >= NEAR_WHITE).count();
        let [p10, p90] = statistics.percentiles();
        Self {
            p10,
            p90,
            r: statistics.printed_ratio(),
            mean_luminance: statistics.mean_luminance.into(),
            mean: statistics.mean.into(),
            near_white_fraction: near_white as f64 / planes.len().max(1) as f64,
            skewness: distribution.skewness(),
        }
    }

    fn mean_of(all: &[Self]) -> Self {
        let mean = |of: fn(&Self) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
        Self {
            p10: mean(|one| one.p10),
            p90: mean(|one| one.p90),
            r: mean(|one| one.r),
            mean_luminance: mean(|one| one.mean_luminance),
            mean: mean(|one| one.mean),
            near_white_fraction: mean(|one| one.near_white_fraction),
            skewness: mean(|one| one.skewness),
        }
    }
}

/// Applies the curve and prints the measurements.
pub fn run(args: &ApplyArgs) -> anyhow::Result<()> {
    let output = apply(args)?;
    if args.json {
        return Ok(print(serde_json::to_string_pretty(&output)?)?);
    }
    print(text(&output))?;
    let images =
        args.out.as_ref().map(|out| format!("{} images to {}", output.views.len(), out.display()));
    let wrote: Vec<String> = images
        .into_iter()
        .chain(args.report.iter().map(|page| page.display().to_string()))
        .collect();
    let next = match Dataset::is_at(&args.input) {
        true => {
            let curve = quoted(&args.tone.name());
            format!("nightsplat train {} --out run --curve {curve}", word(&args.input))
        }
        false => format!("nightsplat pose {} --out scene", word(&args.input)),
    };
    finish(&wrote.join(", "), &next);
    Ok(())
}

fn text(output: &ToneOutput) -> String {
    let remarks: String = output
        .remarks
        .iter()
        .map(|remark| wrapped(&format!("note: {}", one_line(remark)), 6))
        .collect();
    let reason = output.exposure.as_ref().map(|exposure| wrapped(&exposure.reason(), 0));
    let label = output.with_reference.as_deref().map(eval::with_reference);
    let label = label.map(|line| line + "\n").unwrap_or_default();
    reason.unwrap_or_default() + &page::table(output).text() + &remarks + &label
}

/// Maps every photograph and writes it to `args.out` under its own name. Of several photographs, unusable ones are
/// skipped with a warning.
pub fn apply(args: &ApplyArgs) -> Result<ToneOutput> {
    let config = args.config(None)?;
    let settings = config.tone.clone();
    args.out.iter().chain(&args.report).try_for_each(|path| check_writable(path))?;
    let photographs = listed(args, &config)?;
    args.out.iter().try_for_each(|out| create_folder(out))?;
    let gpu = driver::open(&args.device.clone().unwrap_or_default())?;
    let mut set =
        CurveOnSet::new(&gpu, settings.clone(), &photographs, (&args.input, config.invert_masks))?;
    let mut page =
        args.report.as_ref().map(|_| TonePage::new(&gpu, args, &photographs)).transpose()?;

    let progress = progress_bar(photographs.len());
    let mut views = vec![];
    let mut unusable = None;
    for photograph in &photographs {
        progress.set_message(one_line(&photograph.name).into_owned());
        match mapped(&mut set, photograph) {
            Ok(mapped) => {
                if let Some(target) = &photograph.target {
                    args.format.save(&mapped.image, target)?;
                }
                let report = mapped.report(&settings, photograph)?;
                if let Some(page) = &mut page {
                    page.add(photograph, &mapped, report.scores)?;
                }
                views.push((photograph, report));
            }
            Err(error @ Error::Input { .. }) if photographs.len() > 1 => {
                progress.suspend(|| tracing::warn!("skipped: {error}"));
                unusable = Some(error);
            }
            Err(error) => return Err(error),
        }
        progress.inc(1);
    }
    progress.finish_and_clear();
    set.colours.iter().for_each(ColourCounts::log);
    let exposure = set.targets.scene.exposure;
    let Some(mut scene) = scene(&views) else {
        let nothing = || Error::input(&args.input, "contains no photograph");
        return Err(unusable.unwrap_or_else(nothing));
    };
    let views = views.into_iter().map(|(listed, report)| (listed.name.clone(), report)).collect();
    scene.gain = exposure.as_ref().map(|exposure| exposure.gain);
    let with_reference = settings.knows_references();
    let near_white = scene.after.near_white_fraction - scene.before.near_white_fraction;
    let measured: Vec<MeasuredPhotograph> = set.measured.into_values().collect();
    let mut remarks = findings(&measured, exposure.as_ref(), near_white);
    if Dataset::is_at(&args.input) {
        remarks.extend(remarks_at_points(&args.input, config.load_options()));
    }
    let output = ToneOutput { curve: settings, with_reference, exposure, scene, remarks, views };
    if let (Some(page), Some(path)) = (page, &args.report) {
        page.write(path, &output)?;
    }
    Ok(output)
}

/// The most bytes of decoded photographs that are kept from measuring to mapping.
const MOST_KEPT: usize = 1 << 30;

/// A photograph, and the indices of its unusable pixels.
type Decoded = (Image, Vec<usize>);

/// A curve with its statistics of the whole dataset, if it has any.
struct CurveOnSet {
    targets: Targets,
    /// Masks hide white.
    inverted: bool,
    /// Counts of converted and unsupported colours, of photographs and of references.
    colours: [ColourCounts; 2],
    /// Those that are not for tests, by file: all where the curve depends on the whole set, else as they are mapped.
    measured: BTreeMap<PathBuf, MeasuredPhotograph>,
    /// Of the measured ones, those that are kept until they are mapped.
    decoded: BTreeMap<PathBuf, Decoded>,
}

impl CurveOnSet {
    /// Measures the training photographs if the curve depends on the whole set.
    fn new(
        gpu: &Gpu,
        settings: ToneSettings,
        photographs: &[InputPhotograph],
        (input, inverted): (&Path, bool),
    ) -> Result<Self> {
        let levels = photographs.first().map(|listed| listed.levels).unwrap_or_default();
        let colours = [ColourCounts::of_levels(levels), ColourCounts::new("reference image")];
        let (mut measured, mut decoded, mut kept) = (BTreeMap::new(), BTreeMap::new(), 0);
        if settings.scene_statistics || settings.takes_exposure() {
            let training = photographs.iter().filter(|one| one.split != Some(Split::Test));
            let training: Vec<&InputPhotograph> = training.collect();
            for listed in training.chunks(at_once(&training)) {
                let measure = |listed: &&InputPhotograph| {
                    // Unusable photographs are reported when they are mapped.
                    let (photograph, gaps) = loaded(listed, inverted, &colours[0]).ok()?;
                    let one = MeasuredPhotograph::measure(&without(&photograph, &gaps));
                    Some((listed.input.clone(), one, (photograph, gaps)))
                };
                let all: Vec<_> = listed.par_iter().filter_map(measure).collect();
                for (path, one, photograph) in all {
                    measured.insert(path.clone(), one);
                    kept += size_of_val(photograph.0.data.as_slice());
                    if kept <= MOST_KEPT {
                        decoded.insert(path, photograph);
                    }
                }
            }
            if measured.is_empty() && settings.scene_statistics {
                let problem =
                    "--scene-statistics requires training photographs, and there are none";
                return Err(Error::Usage(problem.to_owned()));
            }
        }
        let photographs: Vec<MeasuredPhotograph> = measured.values().cloned().collect();
        let scene = match SceneTone::from_photographs(&settings, &photographs) {
            Some(scene) => scene,
            None if photographs.is_empty() => SceneTone::new(&settings),
            None => return Err(all_black(input)),
        };
        Ok(Self { targets: Targets::in_scene(gpu, scene)?, inverted, colours, measured, decoded })
    }

    /// The photograph, read unless it was kept.
    fn photograph(&mut self, listed: &InputPhotograph) -> Result<Decoded> {
        if let Some(kept) = self.decoded.remove(&listed.input) {
            return Ok(kept);
        }
        // Colours are counted once.
        let is_counted = self.measured.contains_key(&listed.input);
        let unsaid = is_counted.then(|| ColourCounts::of_levels(listed.levels));
        loaded(listed, self.inverted, unsaid.as_ref().unwrap_or(&self.colours[0]))
    }

    /// Statistics of a photograph, its mapped image and the gain.
    fn result(
        &mut self,
        photograph: &Image,
        gaps: &[usize],
        listed: &InputPhotograph,
    ) -> Result<(Statistics, Image, Option<f64>)> {
        let known = self.measured.get(&listed.input).cloned();
        let measured =
            known.unwrap_or_else(|| MeasuredPhotograph::measure(&without(photograph, gaps)));
        let image = self.targets.tone_mapped(photograph, &measured)?;
        let gain = self.targets.scene.gain_of(&measured);
        let statistics = measured.statistics;
        if listed.split != Some(Split::Test) {
            self.measured.insert(listed.input.clone(), measured);
        }
        Ok((statistics, image, gain))
    }
}

/// How many photographs are decoded at once.
fn at_once(photographs: &[&InputPhotograph]) -> usize {
    let pixels = |listed: &&InputPhotograph| {
        let (width, height) = listed.decoded_size(Image::size_of(&listed.input).ok()?);
        Some(u64::from(width) * u64::from(height))
    };
    decoded_at_once(photographs.iter().filter_map(pixels).max().unwrap_or_default())
}

fn loaded(listed: &InputPhotograph, inverted: bool, colours: &ColourCounts) -> Result<Decoded> {
    let (photograph, gaps) = listed.load(inverted, colours)?;
    let (photograph, gaps) = listed.turned(photograph, gaps);
    if gaps.len() == photograph.pixel_count() {
        return Err(Error::input(&listed.input, "has no finite, unmasked pixel; export it again"));
    }
    Ok((photograph, gaps))
}

/// A photograph with its statistics and its mapped image.
struct Mapped {
    photograph: Image,
    gaps: Vec<usize>,
    statistics: Statistics,
    image: Image,
    gain: Option<f64>,
    reference: Option<Image>,
}

fn mapped(set: &mut CurveOnSet, listed: &InputPhotograph) -> Result<Mapped> {
    let (photograph, gaps) = set.photograph(listed)?;
    let load = |path: &PathBuf| {
        let file = PictureFile::open(path)?.reduced(|size| listed.decoded_size(size));
        let (image, _) = file.decode_counted(&set.colours[1])?;
        let is_plain = listed.split.is_none();
        Ok(if is_plain { Orientation::from_file(path).upright(image) } else { image })
    };
    let reference = listed.reference.as_ref().map(load).transpose()?;
    let (statistics, image, gain) = set.result(&photograph, &gaps, listed)?;
    Ok(Mapped { photograph, gaps, statistics, image, gain, reference })
}

impl Mapped {
    fn report(&self, settings: &ToneSettings, listed: &InputPhotograph) -> Result<ToneReport> {
        let Self { photograph, gaps, statistics, image, gain, reference } = self;
        let (usable, result) = (without(photograph, gaps), without(image, gaps));
        let scores = reference.as_ref().map(|reference| {
            let size = |image: &Image| format!("{}x{}", image.width, image.height);
            if size(reference) != size(image) {
                let path = listed.reference.as_deref().unwrap_or(&listed.input);
                let (reference_size, other) = (size(reference), size(image));
                // A wrong folder rather than a bad file: stop.
                return Err(Error::Usage(format!(
                    "{}: is {reference_size} but {} is {other}; references must have the size of the photographs",
                    path.display(),
                    listed.input.display()
                )));
            }
            Scores::of_counted(image, reference, Mask::hiding(image, gaps).as_ref())
        });
        Ok(ToneReport {
            before: Measures::new(&usable, statistics),
            delta0: settings.has_black_level().then(|| settings.offset(statistics.printed_ratio())),
            unusable_pixels: gaps.len(),
            after: Measures::new(&result, &Statistics::new(&result)),
            gain: *gain,
            scores: scores.transpose()?,
        })
    }
}

/// The planes without the pixels `gaps`, which are ascending.
fn without<'a>(image: &'a Image, gaps: &[usize]) -> std::borrow::Cow<'a, [f32]> {
    if gaps.is_empty() {
        return (&image.data).into();
    }
    let pixels = image.pixel_count();
    let is_usable = |index: &usize| gaps.binary_search(&(index % pixels)).is_err();
    (0..image.data.len()).filter(is_usable).map(|index| image.data[index]).collect()
}

/// Means over the views; `None` if empty.
fn scene(views: &[(&InputPhotograph, ToneReport)]) -> Option<ToneReport> {
    let in_split = |split: Split| {
        let chosen: Vec<ToneReport> = views
            .iter()
            .filter(|(listed, _)| listed.split.is_none_or(|wanted| wanted == split))
            .map(|(_, report)| *report)
            .collect();
        // If a split has no usable photograph, take all.
        if chosen.is_empty() { views.iter().map(|(_, report)| *report).collect() } else { chosen }
    };
    let (training, test) = (in_split(Split::Train), in_split(Split::Test));
    let measures = |of: fn(&ToneReport) -> Measures| {
        Measures::mean_of(&training.iter().map(of).collect::<Vec<_>>())
    };
    let scores: Vec<Scores> = test.iter().filter_map(|report| report.scores).collect();
    (!views.is_empty()).then(|| ToneReport {
        before: measures(|report| report.before),
        delta0: training
            .iter()
            .map(|report| report.delta0)
            .sum::<Option<f64>>()
            .map(|sum| sum / training.len() as f64),
        unusable_pixels: views.iter().map(|(_, report)| report.unusable_pixels).sum(),
        after: measures(|report| report.after),
        gain: None,
        scores: Scores::mean(&scores),
    })
}
