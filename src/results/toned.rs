//! Photographs through a tone curve: mapped, measured and scored, with a page of them.
//!
//! In: a photograph, a folder of them or a dataset, and a curve. Out: [`ToneOutput`], the mapped images, and the page.

mod page;
mod photographs;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nightsplat_core::output::create_folder;
use nightsplat_diagnose::remarks_at_points;
use nightsplat_photographs::dataset::{Dataset, Split};
use nightsplat_photographs::findings::findings;
use nightsplat_photographs::image::{
    ColourCounts, Image, ImageFile as _, Mask, Orientation, PictureFile, decoded_at_once,
};
use nightsplat_photographs::metrics::Scores;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{
    Exposure, MeasuredPhotograph, NEAR_WHITE, Statistics, ToneSettings, all_black,
};
use nightsplat_photographs::tree::check_writable;
use nightsplat_report::Distribution;
use rayon::prelude::*;
use serde::Serialize;

use self::page::TonePage;
pub(crate) use self::page::table;
use self::photographs::{InputPhotograph, listed};
use crate::gpu::Gpu;
use crate::targets::Targets;
use crate::train::TrainConfig;
use crate::{Error, Result};

/// Photographs, and the curves that they are mapped by.
pub(crate) struct ToneRequest<'a> {
    /// A photograph, a folder of them, or a dataset.
    pub(crate) input: &'a Path,
    /// References in normal light: a folder with the same names, or a file.
    pub(crate) reference: Option<&'a Path>,
    /// The folder for mapped images, and the extension of their files. Without it, large photographs are reduced.
    pub(crate) out: Option<(&'a Path, &'static str)>,
    /// The page to write.
    pub(crate) report: Option<&'a Path>,
    /// The name of the curve, and its settings.
    pub(crate) curve: (String, TrainConfig),
    /// More curves for the page.
    pub(crate) compared: Vec<(String, TrainConfig)>,
}

/// How far [`apply`] is.
pub(crate) enum ToneProgress<'a> {
    /// A photograph is the next.
    Next {
        name: &'a str,
        /// Photographs before it.
        done: usize,
        all: usize,
    },
    /// An image is mapped, and to be written to this file.
    Mapped(&'a Image, &'a Path),
    /// A photograph cannot be used.
    Skipped(&'a Error),
    /// There is no further photograph.
    Finished,
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

/// Maps every photograph on the device that `open` opens, and writes the page; `follow` writes what is mapped. Of
/// several photographs, unusable ones are skipped.
///
/// # Errors
/// No photograph can be used, a reference has another size, or a file cannot be written.
pub(crate) fn apply(
    request: &ToneRequest<'_>,
    open: &dyn Fn() -> Result<Gpu>,
    follow: &dyn Fn(ToneProgress<'_>) -> Result<()>,
) -> Result<ToneOutput> {
    let ToneRequest { input, report, curve: (_, config), .. } = request;
    let settings = config.tone.clone();
    let out = request.out.map(|(folder, _)| folder);
    out.iter().chain(report).try_for_each(|path| check_writable(path))?;
    let photographs = listed(request)?;
    out.iter().try_for_each(|out| create_folder(out))?;
    let gpu = open()?;
    let mut set =
        CurveOnSet::new(&gpu, settings.clone(), &photographs, (input, config.invert_masks))?;
    let mut page = report.map(|_| TonePage::new(&gpu, request, &photographs)).transpose()?;

    let mut views = vec![];
    let mut unusable = None;
    for (done, photograph) in photographs.iter().enumerate() {
        follow(ToneProgress::Next { name: &photograph.name, done, all: photographs.len() })?;
        match mapped(&mut set, photograph) {
            Ok(mapped) => {
                if let Some(target) = &photograph.target {
                    follow(ToneProgress::Mapped(&mapped.image, target))?;
                }
                let measured = mapped.report(&settings, photograph)?;
                if let Some(page) = &mut page {
                    page.add(photograph, &mapped, measured.scores)?;
                }
                views.push((photograph, measured));
            }
            Err(error @ Error::Input { .. }) if photographs.len() > 1 => {
                follow(ToneProgress::Skipped(&error))?;
                unusable = Some(error);
            }
            Err(error) => return Err(error),
        }
    }
    follow(ToneProgress::Finished)?;
    set.colours.iter().for_each(ColourCounts::log);
    let exposure = set.targets.scene.exposure;
    let Some(mut scene) = scene(&views) else {
        let nothing = || Error::input(input, "contains no photograph");
        return Err(unusable.unwrap_or_else(nothing));
    };
    let views = views.into_iter().map(|(listed, report)| (listed.name.clone(), report)).collect();
    scene.gain = exposure.as_ref().map(|exposure| exposure.gain);
    let with_reference = settings.knows_references();
    let near_white = scene.after.near_white_fraction - scene.before.near_white_fraction;
    let measured: Vec<MeasuredPhotograph> = set.measured.into_values().collect();
    let mut remarks = findings(&measured, exposure.as_ref(), near_white);
    if Dataset::is_at(input) {
        remarks.extend(remarks_at_points(input, config.load_options()));
    }
    let output = ToneOutput { curve: settings, with_reference, exposure, scene, remarks, views };
    if let (Some(page), Some(path)) = (page, report) {
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
