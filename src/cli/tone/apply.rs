//! `nightsplat tone apply`: measure photographs and apply a tone curve to them.

mod page;
mod photographs;

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use self::page::Page;
use self::photographs::{Listed, listed};
use crate::base::output::printable;
use crate::cli::{ImageFormat, progress_bar, table};
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::{Dataset, Split};
use crate::photographs::image::{Image, Mask};
use crate::photographs::metrics::Scores;
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::{
    CurveChoice, Exposure, GainChoice, MeasuredPhotograph, Profile, SceneTone, Statistics,
    ToneCurve, ToneSettings, all_black,
};
use crate::results::eval;
use crate::results::report::Distribution;
use crate::{Error, Result};

/// Apply a tone curve to a photograph, a folder of them or a dataset, and tell what that does.
#[expect(clippy::doc_markdown, reason = "in help, {setting} stands for its default")]
#[derive(Clone, Debug, clap::Args)]
pub struct ApplyArgs {
    /// A photograph (PNG, JPEG, WebP, TIFF or EXR) or a folder of them, turned upright, or a dataset's, as stored and not undistorted
    pub input: PathBuf,
    /// The curve: a name that `nightsplat tone list` lists, or a .toml, .csv or .cube file
    #[arg(long, value_name = "NAME|FILE", default_value_t = ToneSettings::default().curve.into())]
    pub curve: CurveChoice,
    /// A camera profile that `nightsplat tone fit --profile` made, in place of a curve; scores are labelled: they know its references
    #[arg(long, value_name = "FILE", conflicts_with_all = ["curve", "gain", "brightness", "colour", "theta"])]
    pub profile: Option<PathBuf>,
    /// The folder to write to, names are kept; made if it does not exist. Without it nothing is written
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// c: how much a brighter photograph raises the gain, or auto: the gain that the photographs ask for, as the curve auto has it [default: {tone.gain_c of ase} for ase, {tone.gain_c of ap3} for ap3, else {tone.gain_c of linear}]
    #[arg(long, value_name = "C|auto")]
    pub gain: Option<GainChoice>,
    /// The mean luminance of the results, 0.1 to 0.9, where the gain is automatic [default: found between 0.44 and 0.54]
    #[arg(long, value_name = "T")]
    pub brightness: Option<f64>,
    /// lambda: how much of the curve auto keeps the ratios of the channels, 0 to 1 [default: a third for a dataset, else none]
    #[arg(long, value_name = "L")]
    pub colour: Option<f64>,
    /// The mean that linear scaling aims at [default: {tone.theta}]
    #[arg(long, value_name = "T")]
    pub theta: Option<f64>,
    /// One curve for all: percentiles and means are averaged over the training photographs
    #[arg(long)]
    pub scene_statistics: bool,
    /// Normal-light photographs to score against: a folder with the same names, or a file for one photograph
    #[arg(long, value_name = "DIR|FILE")]
    pub reference: Option<PathBuf>,
    /// Masks (masks/NAME.png or masks/NAME.jpg.png beside the photographs) hide what is white, not what is black
    #[arg(long)]
    pub invert_masks: bool,
    /// Print what was measured as JSON
    #[arg(long)]
    pub json: bool,
    /// Write a page with the measurements and the distributions of luminance
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// Further curves on the page
    #[arg(long, value_name = "NAME|FILE,..", value_delimiter = ',', requires = "report")]
    pub compare: Vec<CurveChoice>,
    /// The files to write: 8- or 16-bit PNG, or float EXR in linear light
    #[arg(long, value_enum, default_value_t)]
    pub format: ImageFormat,
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// What is measured of a photograph or of what a curve made of it, on sRGB-encoded values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Measures {
    /// The 10th percentile of the luminance.
    pub p10: f64,
    /// The 90th percentile of the luminance.
    pub p90: f64,
    /// p10 / p90; 1 where all is black.
    pub r: f64,
    /// The mean of the luminance.
    pub mean_luminance: f64,
    /// The mean over all channels.
    pub mean: f64,
    /// The fraction of the values, over all channels, that are 1 or more.
    pub clipped_fraction: f64,
    /// The skewness of the luminance.
    pub skewness: f64,
}

/// What `tone apply` tells of a photograph, or of a scene as the mean over its views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ToneReport {
    /// Of the photograph.
    #[serde(flatten)]
    pub before: Measures,
    /// The black level that the settings' alpha and beta give this r; the paper's alpha where the curve has none.
    pub delta0: f64,
    /// Pixels with a value that is NaN or infinite, which are black in the result, and hidden ones: they are in no measure.
    pub unusable_pixels: usize,
    /// Of the result.
    pub after: Measures,
    /// k of soft(x; k), whose brightness the result has, where the photographs give it; of a scene that of all together.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// The result against the reference image.
    #[serde(flatten)]
    pub scores: Option<Scores>,
}

/// What `tone apply` tells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ToneOutput {
    /// The curve.
    pub curve: ToneSettings,
    /// What the results know of references, where they know any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub with_reference: Option<String>,
    /// How bright the results are to be and why, where the photographs give it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<Exposure>,
    /// Means: of measures over the training views, of scores over the test views; over all where nothing says which.
    pub scene: ToneReport,
    /// By name.
    pub views: BTreeMap<String, ToneReport>,
}

impl Measures {
    fn of(planes: &[f32], statistics: &Statistics) -> Self {
        let mut distribution = Distribution::new("");
        distribution.add(planes);
        let clipped = planes.iter().filter(|&&value| value >= 1.0).count();
        let [p10, p90] = statistics.percentiles();
        Self {
            p10,
            p90,
            r: statistics.printed_ratio(),
            mean_luminance: statistics.mean_luminance.into(),
            mean: statistics.mean.into(),
            clipped_fraction: clipped as f64 / planes.len().max(1) as f64,
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
            clipped_fraction: mean(|one| one.clipped_fraction),
            skewness: mean(|one| one.skewness),
        }
    }
}

/// Applies the curve and prints what was measured, as a table or as JSON.
///
/// # Errors
/// As [`apply`], or standard output cannot be written to.
pub fn run(args: &ApplyArgs) -> Result<()> {
    let output = apply(args)?;
    let text = if args.json {
        let json = serde_json::to_string_pretty(&output);
        json.map_err(|error| Error::output("standard output", error.to_string()))? + "\n"
    } else {
        text_table(&output)
    };
    write!(std::io::stdout().lock(), "{text}")
        .map_err(|error| Error::output("standard output", error.to_string()))
}

fn text_table(output: &ToneOutput) -> String {
    let heading = "name p10 p90 r delta0 Y skewness -> Y skewness clipped PSNR SSIM";
    let mut rows = vec![heading.split(' ').map(str::to_owned).collect::<Vec<_>>()];
    let views = output.views.iter().map(|(name, report)| (name.as_str(), report));
    for (name, report) in views.chain([("scene", &output.scene)]) {
        let ToneReport { before, delta0, after, scores, .. } = report;
        let score =
            |value: fn(&Scores) -> String| scores.as_ref().map_or_else(|| "-".to_owned(), value);
        rows.push(vec![
            name.to_owned(),
            format!("{:.4}", before.p10),
            format!("{:.4}", before.p90),
            format!("{:.3}", before.r),
            format!("{delta0:.4}"),
            format!("{:.4}", before.mean_luminance),
            format!("{:.2}", before.skewness),
            String::new(),
            format!("{:.4}", after.mean_luminance),
            format!("{:.2}", after.skewness),
            format!("{:.1} %", 100.0 * after.clipped_fraction),
            score(|scores| format!("{:.2}", scores.psnr)),
            score(|scores| format!("{:.3}", scores.ssim)),
        ]);
    }
    let reason = output.exposure.as_ref().map(|exposure| format!("{}\n", exposure.reason()));
    let label = output.with_reference.as_deref().map(eval::with_reference);
    let label = label.map(|line| line + "\n").unwrap_or_default();
    reason.unwrap_or_default() + &table::aligned(&rows) + &label
}

/// Maps every photograph and writes it to `args.out` under its own name.
///
/// A photograph of several that cannot be used is named in a warning and left out.
///
/// # Errors
/// [`Error::Usage`] for settings that make no sense; [`Error::Input`] where there is nothing to map, two photographs
/// would be written to one file, or a reference image is of another size; [`Error::Output`] where a file cannot be
/// written or a photograph would be replaced; those of the device.
pub fn apply(args: &ApplyArgs) -> Result<ToneOutput> {
    let settings = match &args.profile {
        Some(file) => ToneSettings {
            scene_statistics: args.scene_statistics,
            ..ToneSettings::of_profile(Profile::load(file)?)
        },
        None => settings(args, &args.curve)?,
    };
    let photographs = listed(args)?;
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out)
            .map_err(|error| Error::output(out, format!("cannot be made: {error}")))?;
    }
    let gpu = Gpu::new(&args.device.clone().unwrap_or_default())?;
    let mut set =
        CurveOnSet::new(&gpu, settings.clone(), &photographs, (&args.input, args.invert_masks))?;
    let mut page = args.report.as_ref().map(|_| Page::new(&gpu, args, &photographs)).transpose()?;

    let progress = progress_bar(photographs.len());
    let mut views = vec![];
    let mut unusable = None;
    for photograph in &photographs {
        progress.set_message(printable(&photograph.name).into_owned());
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
                progress.suspend(|| tracing::warn!("left out: {error}"));
                unusable = Some(error);
            }
            Err(error) => return Err(error),
        }
        progress.inc(1);
    }
    progress.finish_and_clear();
    let exposure = set.scene.exposure;
    let Some(mut scene) = scene(&views) else {
        let nothing = || Error::input(&args.input, "holds no photograph");
        return Err(unusable.unwrap_or_else(nothing));
    };
    let views = views.into_iter().map(|(listed, report)| (listed.name.clone(), report)).collect();
    scene.gain = exposure.as_ref().map(|exposure| exposure.gain);
    let with_reference = settings.knows_references();
    let output = ToneOutput { curve: settings, with_reference, exposure, scene, views };
    if let (Some(page), Some(path)) = (page, &args.report) {
        page.write(path, &output)?;
    }
    Ok(output)
}

/// The settings of a curve under the options of the command line.
fn settings(args: &ApplyArgs, curve: &CurveChoice) -> Result<ToneSettings> {
    let mut settings = curve.settings()?;
    if *curve == ToneCurve::Auto.into() && !Dataset::is_at(&args.input) {
        // The references of single pictures are paler than those of scenes.
        settings.colour = 0.0;
    }
    settings.theta = args.theta.unwrap_or(settings.theta);
    if let Some(gain) = args.gain {
        settings = settings.with_gain(gain);
    }
    settings.brightness = args.brightness.or(settings.brightness);
    settings.colour = args.colour.unwrap_or(settings.colour);
    settings.scene_statistics |= args.scene_statistics;
    settings.check()?;
    Ok(settings)
}

/// A curve, and what the photographs of a set have in common for it.
struct CurveOnSet {
    pseudo_gt: PseudoGt,
    scene: SceneTone,
    /// Masks hide what is white.
    inverted: bool,
}

impl CurveOnSet {
    /// Measures the training photographs where the curve of one depends on the others.
    fn new(
        gpu: &Gpu,
        settings: ToneSettings,
        photographs: &[Listed],
        (input, inverted): (&Path, bool),
    ) -> Result<Self> {
        let pseudo_gt = PseudoGt::new(gpu, &settings)?;
        let mut measured = vec![];
        if settings.scene_statistics || settings.takes_exposure() {
            for listed in photographs.iter().filter(|listed| listed.split != Some(Split::Test)) {
                // What cannot be used is named where it would be mapped.
                let Ok((photograph, gaps)) = loaded(listed, inverted) else { continue };
                measured.push(MeasuredPhotograph::of(&without(&photograph, &gaps)));
            }
            if measured.is_empty() && settings.scene_statistics {
                let problem = "--scene-statistics needs training photographs; there are none";
                return Err(Error::Usage(problem.to_owned()));
            }
        }
        let scene = match settings.scene(&measured) {
            Some(scene) => scene,
            None if measured.is_empty() => SceneTone::default(),
            None => return Err(all_black(input)),
        };
        Ok(Self { pseudo_gt, scene, inverted })
    }

    /// What was measured of a photograph, what the curve makes of it, and at which gain.
    fn result(
        &mut self,
        photograph: &Image,
        gaps: &[usize],
    ) -> Result<(Statistics, Image, Option<f64>)> {
        let measured = MeasuredPhotograph::of(&without(photograph, gaps));
        let tone_mapping = self.pseudo_gt.settings().tone_mapping(&self.scene, &measured);
        Ok((
            measured.statistics,
            self.pseudo_gt.tone_mapped(photograph, &tone_mapping)?,
            tone_mapping.gain,
        ))
    }
}

/// A photograph with those of its pixels that do not count.
fn loaded(listed: &Listed, inverted: bool) -> Result<(Image, Vec<usize>)> {
    let (photograph, gaps) = listed.load(inverted)?;
    let (photograph, gaps) = listed.turned(photograph, gaps);
    if gaps.len() == photograph.pixel_count() {
        return Err(Error::input(
            &listed.input,
            "has no pixel that is a number and not hidden; export it anew",
        ));
    }
    Ok((photograph, gaps))
}

/// A photograph, what was measured of it, and what the curve made of it.
struct Mapped {
    photograph: Image,
    gaps: Vec<usize>,
    statistics: Statistics,
    image: Image,
    gain: Option<f64>,
    reference: Option<Image>,
}

fn mapped(set: &mut CurveOnSet, listed: &Listed) -> Result<Mapped> {
    let (photograph, gaps) = loaded(listed, set.inverted)?;
    let load = if listed.split.is_none() { Image::load_upright } else { Image::load };
    let reference = listed.reference.as_ref().map(load).transpose()?;
    let (statistics, image, gain) = set.result(&photograph, &gaps)?;
    Ok(Mapped { photograph, gaps, statistics, image, gain, reference })
}

impl Mapped {
    fn report(&self, settings: &ToneSettings, listed: &Listed) -> Result<ToneReport> {
        let Self { photograph, gaps, statistics, image, gain, reference } = self;
        let (usable, result) = (without(photograph, gaps), without(image, gaps));
        let scores = reference.as_ref().map(|reference| {
            let size = |image: &Image| format!("{}x{}", image.width, image.height);
            if size(reference) != size(image) {
                let path = listed.reference.as_deref().unwrap_or(&listed.input);
                let (own, other) = (size(reference), size(image));
                // A wrong folder, not a bad file: it stops the command.
                return Err(Error::Usage(format!(
                    "{}: is {own} but {} is {other}; references must be of the photographs' size",
                    path.display(),
                    listed.input.display()
                )));
            }
            Scores::of_counted(image, reference, Mask::hiding(image, gaps).as_ref())
        });
        let paper = ToneSettings::new(ToneCurve::Ap3);
        let alpha = if settings.alpha > 0.0 { settings.alpha } else { paper.alpha };
        let black_level = ToneSettings { alpha, ..settings.clone() };
        Ok(ToneReport {
            before: Measures::of(&usable, statistics),
            delta0: black_level.offset(statistics.printed_ratio()),
            unusable_pixels: gaps.len(),
            after: Measures::of(&result, &Statistics::of(&result)),
            gain: *gain,
            scores: scores.transpose()?,
        })
    }
}

/// The planes without some pixels, ascending.
fn without<'a>(image: &'a Image, gaps: &[usize]) -> std::borrow::Cow<'a, [f32]> {
    if gaps.is_empty() {
        return (&image.data).into();
    }
    let pixels = image.pixel_count();
    let is_usable = |index: &usize| gaps.binary_search(&(index % pixels)).is_err();
    (0..image.data.len()).filter(is_usable).map(|index| image.data[index]).collect()
}

/// The means over the views; none of nothing.
fn scene(views: &[(&Listed, ToneReport)]) -> Option<ToneReport> {
    let in_split = |split: Split| {
        let chosen: Vec<ToneReport> = views
            .iter()
            .filter(|(listed, _)| listed.split.is_none_or(|own| own == split))
            .map(|(_, report)| *report)
            .collect();
        // A dataset whose photographs of one split are all absent or unusable.
        if chosen.is_empty() { views.iter().map(|(_, report)| *report).collect() } else { chosen }
    };
    let (training, test) = (in_split(Split::Train), in_split(Split::Test));
    let measures = |of: fn(&ToneReport) -> Measures| {
        Measures::mean_of(&training.iter().map(of).collect::<Vec<_>>())
    };
    let scores: Vec<Scores> = test.iter().filter_map(|report| report.scores).collect();
    (!views.is_empty()).then(|| ToneReport {
        before: measures(|report| report.before),
        delta0: training.iter().map(|report| report.delta0).sum::<f64>() / training.len() as f64,
        unusable_pixels: views.iter().map(|(_, report)| report.unusable_pixels).sum(),
        after: measures(|report| report.after),
        gain: None,
        scores: Scores::mean(&scores),
    })
}

/// Whether two paths are one file.
fn is_same_file(a: &Path, b: &Path) -> bool {
    a.canonicalize().ok().zip(b.canonicalize().ok()).is_some_and(|(a, b)| a == b)
}
