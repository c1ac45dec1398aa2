//! Runs on one dataset, and renders of other programs, compared view by view.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use nightsplat_core::natural;
use nightsplat_photographs::dataset::{Dataset, View, ViewPictures};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::metrics::Scores;
use nightsplat_report::{Best, Column, Comparison, NumberTable, Picture, Report, TextTable};
use serde_json::{Value, json};

use super::eval::{After, Evaluation, Extras, Metric, ScoreReference, ScoredImages};
use super::finished_run::{FinishedRun, Opener, is_model};
use super::run;
use crate::gpu::Gpu;
use crate::networks::lpips::{Lpips, LpipsVersion, Range};
use crate::train::{Rendered, TrainConfig, values};
use crate::{Error, Result};

/// Maximum width of an image, pixels.
const PICTURE_WIDTH: u32 = 400;
/// Maximum number of views with images, evenly spread.
const SHOWN: usize = 12;
/// Cameras whose poses differ by more, relative to their distance from the origin, are of different datasets.
const POSE_ERROR: f64 = 1e-6;

/// A run that is compared, or the renders of another program.
#[derive(Debug)]
struct Compared {
    name: String,
    evaluation: Evaluation,
    gaussians: Option<usize>,
    /// `metrics.json`; null of a model and of renders.
    metrics: Value,
    config: Option<TrainConfig>,
}

/// Runs with their scores, and images of some views.
#[derive(Debug)]
pub(crate) struct RunComparison {
    runs: Vec<Compared>,
    measure: Option<LpipsVersion>,
    pictures: Vec<Comparison>,
}

/// The renders of another program: pictures of the test views by their names.
#[derive(Clone, Debug)]
pub struct NamedRenders {
    pub(crate) name: String,
    pub(crate) folder: PathBuf,
}

impl NamedRenders {
    /// Those of one of several scenes, which have a folder each.
    pub(crate) fn of_scene(&self, scene: &str) -> Self {
        Self { name: self.name.clone(), folder: self.folder.join(scene) }
    }
}

impl FromStr for NamedRenders {
    type Err = Error;

    /// Reads `NAME=DIR`.
    fn from_str(text: &str) -> Result<Self> {
        let parts = text.split_once('=').filter(|(name, dir)| !name.is_empty() && !dir.is_empty());
        let (name, folder) = parts
            .ok_or_else(|| Error::Usage(format!("`{text}` names no renders; write NAME=DIR")))?;
        Ok(Self { name: name.to_owned(), folder: folder.into() })
    }
}

/// The options of a comparison.
#[derive(Debug)]
pub(crate) struct CompareOptions<'a> {
    /// Renders of other programs, in addition to the runs.
    pub(crate) renders: &'a [NamedRenders],
    pub(crate) dataset: Option<&'a Path>,
    pub(crate) opener: Opener,
    pub(crate) lpips: Option<(&'a Path, Range)>,
    /// Whether images are kept.
    pub(crate) with_pictures: bool,
    /// Whether a bright model may be scored against dark photographs.
    pub(crate) photographs: bool,
}

impl RunComparison {
    /// Scores the test views of every run against the same images: the references or, without any, the targets of the
    /// first run.
    pub(crate) fn new(paths: &[PathBuf], options: &CompareOptions<'_>) -> Result<Self> {
        let names = names(paths);
        // A model file is seen by the views of the run beside it.
        let run =
            paths.iter().find(|path| !is_model(path)).and_then(|run| run::load_config(run).ok());
        let of_run = run.map(|config| config.dataset);
        let mut first: Option<(Gpu, Dataset, ScoreReference)> = None;
        let mut comparison = Self { runs: vec![], measure: None, pictures: vec![] };
        let mut targets = None;
        for (path, name) in paths.iter().zip(names) {
            // Of a model file, the views are those of the first.
            let stated: Option<String> = targets.clone().filter(|_| is_model(path));
            let change = |config: &mut TrainConfig| {
                let changed = stated.and_then(|stated| config.with_targets(&stated).ok());
                *config = changed.unwrap_or_else(|| config.clone());
            };
            let dataset = options.dataset.or(of_run.as_deref().filter(|_| is_model(path)));
            let opened = FinishedRun::open_lit(path, dataset, &options.opener, change)?;
            let states_targets = opened.states_targets;
            let FinishedRun { gpu, config, dataset, gaussian_count, mut model_renderer, .. } =
                opened;
            if first.is_none() {
                let reference = ScoreReference::new(&gpu, &config.tone, &dataset)?;
                if !states_targets && !options.photographs {
                    reference
                        .check_brightness(path, &dataset, |view| model_renderer.render(view))?;
                }
                targets = config.stated_targets();
                first = Some((gpu.clone(), dataset.clone(), reference));
            }
            let Some((_, first_dataset, reference)) = &mut first else { continue };
            if let Some(difference) = difference(first_dataset, &dataset) {
                let problem = format!(
                    "{} and {name} are runs of different datasets: {difference}; compare runs of one",
                    paths[0].display()
                );
                return Err(Error::Usage(problem));
            }
            let is_even = reference.is_evenly_lit(&dataset);
            let render = |view: &View| model_renderer.render_as(view, is_even);
            let scored = (&gpu, &dataset, reference);
            let evaluation = comparison.evaluate(&name, scored, options, render)?;
            let is_run = !is_model(path);
            comparison.runs.push(Compared {
                name,
                evaluation,
                gaussians: Some(gaussian_count),
                metrics: if is_run { run::load_metrics(path) } else { Value::Null },
                config: is_run.then_some(config),
            });
        }
        for NamedRenders { name, folder } in options.renders {
            let Some((gpu, dataset, reference)) = &mut first else { break };
            let pictures = ViewPictures::of_tests(folder, dataset)?;
            let render = |view: &View| pictures.load(view).map(Rendered::from);
            let evaluation =
                comparison.evaluate(name, (&*gpu, &*dataset, reference), options, render)?;
            let (name, metrics) = (name.clone(), Value::Null);
            let compared = Compared { name, evaluation, gaussians: None, metrics, config: None };
            comparison.runs.push(compared);
        }
        Ok(comparison)
    }

    /// Scores the test views of a run or of renders, and keeps images of some.
    fn evaluate(
        &mut self,
        name: &str,
        (gpu, dataset, reference): (&Gpu, &Dataset, &mut ScoreReference),
        options: &CompareOptions<'_>,
        render: impl FnMut(&View) -> Result<Rendered>,
    ) -> Result<Evaluation> {
        let lpips = options.lpips.map(|(weights, range)| Lpips::load(gpu, weights, range));
        let lpips = lpips.transpose()?;
        self.measure = lpips.as_ref().map(Lpips::measure);
        let step = reference.view_count(dataset).div_ceil(SHOWN).max(1);
        let mut number = 0;
        let pictures = &mut self.pictures;
        let keep = |images: &ScoredImages<'_>| {
            if options.with_pictures && number % step == 0 {
                add(pictures, number / step, name, images);
            }
            number += 1;
            Ok(())
        };
        let lpips = lpips.as_ref().map(|lpips| (lpips, gpu));
        let extras = Extras { lpips, ..Extras::default() };
        Evaluation::new(reference, dataset, &extras, render, keep)
    }

    /// The runs with their mean scores.
    pub(crate) fn means(&self) -> NumberTable {
        let column = |name: &str, digits, best| Column { name: name.to_owned(), digits, best };
        let mut columns = vec![
            column("PSNR, dB", 2, Best::Greatest),
            column("channel mean", 2, Best::Greatest),
            column("SSIM", 4, Best::Greatest),
        ];
        columns.extend(self.measure.map(|measure| column(&measure.title(), 4, Best::Least)));
        columns.extend([
            column("Gaussians", 0, Best::Unmarked),
            column("steps", 0, Best::Unmarked),
            column("seconds", 0, Best::Unmarked),
        ]);
        let row = |run: &Compared| {
            let mean = |metric| run.evaluation.mean(metric, After::Model);
            let mut values =
                vec![mean(Metric::Psnr), mean(Metric::PsnrChannelMean), mean(Metric::Ssim)];
            values.extend(self.measure.map(|_| mean(Metric::Lpips)));
            values.extend([
                run.gaussians.map(|count| count as f64),
                run.metrics["steps"].as_f64(),
                run.metrics["seconds"].as_f64(),
            ]);
            (run.name.clone(), values)
        };
        NumberTable {
            title: "Means over the test views".to_owned(),
            label: "run".to_owned(),
            columns,
            rows: self.runs.iter().map(row).collect(),
            ..NumberTable::default()
        }
    }

    /// The PSNR of each test view in the first run, and how much higher it is in the others.
    pub(crate) fn views(&self) -> NumberTable {
        let Some((first, others)) = self.runs.split_first() else { return NumberTable::default() };
        let column = |name: String, best| Column { name, digits: 2, best };
        let mut columns = vec![column(format!("PSNR of {}, dB", first.name), Best::Unmarked)];
        let gains = others.iter().map(|run| column(format!("{} gains", run.name), Best::Unmarked));
        columns.extend(gains);
        let psnr = |run: &Compared, view: &str| {
            run.evaluation.value(Some(view), Metric::Psnr, After::Model)
        };
        let mut views = first.evaluation.views();
        views.sort_by(|a, b| natural::compare(a, b));
        let row = |view: &str| {
            let of_first = psnr(first, view);
            let gain = |run: &Compared| Some(psnr(run, view)? - of_first?);
            let values = std::iter::once(of_first).chain(others.iter().map(gain));
            (view.to_owned(), values.collect())
        };
        NumberTable {
            title: "Test views".to_owned(),
            label: "view".to_owned(),
            columns,
            rows: views.into_iter().map(row).collect(),
            ..NumberTable::default()
        }
    }

    /// The settings in which the runs differ, with the value of each.
    pub(crate) fn settings(&self) -> Vec<[String; 2]> {
        let all: Vec<_> =
            self.runs.iter().filter_map(|run| values(run.config.as_ref()?).ok()).collect();
        // Renders have no settings, and models few.
        let with_settings = self.runs.iter().filter(|run| run.gaussians.is_some()).count();
        let Some(first) = all.first().filter(|_| all.len() == with_settings) else {
            return vec![];
        };
        let mut keys: Vec<&String> = all.iter().flat_map(|settings| settings.keys()).collect();
        keys.sort();
        keys.dedup();
        let differs = |key: &&String| {
            all.iter().any(|settings| match (settings.get(*key), first.get(*key)) {
                (Some(one), Some(other)) => !are_alike(one, other),
                (one, other) => one.is_some() != other.is_some(),
            })
        };
        let text = |key: &String| {
            let value = |settings: &std::collections::BTreeMap<String, toml::Value>| {
                settings.get(key).map_or_else(|| "none".to_owned(), ToString::to_string)
            };
            all.iter().map(value).collect::<Vec<_>>().join(" | ")
        };
        keys.into_iter().filter(differs).map(|key| [key.clone(), text(key)]).collect()
    }

    /// A note for readers of the scores, unless they are against reference images.
    pub(crate) fn label(&self) -> Option<String> {
        let label = self.runs.first().and_then(|run| run.evaluation.label())?;
        Some(format!("scores are {label}; all against the targets of {}", self.runs[0].name))
    }

    pub(crate) fn json(&self) -> Value {
        let entry = |run: &Compared| {
            let of_model = run.gaussians.map(|_| run.metrics["steps"].as_u64().unwrap_or_default());
            let seconds = run.metrics["seconds"].as_f64();
            let mut metrics = run.evaluation.json(seconds, run.gaussians, of_model);
            metrics["run"] = json!(run.name);
            metrics
        };
        let runs: Vec<Value> = self.runs.iter().map(entry).collect();
        json!({ "runs": runs, "settings": self.settings() })
    }

    pub(crate) fn html(&self) -> String {
        let names: Vec<&str> = self.runs.iter().map(|run| run.name.as_str()).collect();
        let of_runs = self.runs.iter().filter(|run| run.gaussians.is_some());
        let of_runs: Vec<&str> = of_runs.map(|run| run.name.as_str()).collect();
        let settings = self.settings();
        let facts = (!settings.is_empty()).then(|| TextTable {
            title: format!("Settings that differ: {}", of_runs.join(" | ")),
            rows: settings,
        });
        // The views on which the runs differ the most come first.
        let mut pictures = self.pictures.clone();
        pictures.sort_by(|a, b| spread(b).total_cmp(&spread(a)));
        Report {
            title: format!("Comparison of {}", names.join(", ")),
            intro: self.label().into_iter().collect(),
            facts: facts.into_iter().collect(),
            tables: vec![self.means(), self.views()],
            comparisons: pictures,
            ..Report::default()
        }
        .html()
    }
}

/// The difference of the best and the worst PSNR in the captions.
fn spread(comparison: &Comparison) -> f64 {
    let psnr = |picture: &Picture| picture.scores.split(' ').next()?.parse::<f64>().ok();
    let all: Vec<f64> = comparison.pictures.iter().filter_map(psnr).collect();
    let most = all.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let least = all.iter().copied().fold(f64::INFINITY, f64::min);
    if all.is_empty() { 0.0 } else { most - least }
}

/// Adds the render of a run to the images of a view, which the first run begins with the image of comparison.
fn add(
    pictures: &mut Vec<Comparison>,
    index: usize,
    run: &str,
    ScoredImages { view, render, target, against, scores }: &ScoredImages<'_>,
) {
    let picture = |caption: &str, scores: String, image: &Image| {
        Picture::shrunk(caption, scores, &view.upright(image.clone()), PICTURE_WIDTH)
    };
    if pictures.len() == index {
        let name = against.name().trim_end_matches('s');
        let shown = vec![picture(name, String::new(), target)];
        pictures.push(Comparison { title: view.name.clone(), pictures: shown });
    }
    let Scores { psnr, ssim, .. } = scores;
    let scores = format!("{psnr:.2} dB, SSIM {ssim:.3}");
    if let Some(comparison) = pictures.get_mut(index) {
        comparison.pictures.push(picture(run, scores, render));
    }
}

/// The last part of each path, or the whole path where two are alike.
fn names(paths: &[PathBuf]) -> Vec<String> {
    let last = |path: &PathBuf| path.file_name().unwrap_or(path.as_os_str()).to_owned();
    let all: Vec<_> = paths.iter().map(last).collect();
    let is_unique =
        |name: &std::ffi::OsString| all.iter().filter(|other| *other == name).count() == 1;
    let name = |(path, name): (&PathBuf, &std::ffi::OsString)| match is_unique(name) {
        true => name.to_string_lossy().into_owned(),
        false => path.display().to_string(),
    };
    paths.iter().zip(&all).map(name).collect()
}

/// Whether two settings are the same to rounding: a direction is normalised anew for each run.
fn are_alike(one: &toml::Value, other: &toml::Value) -> bool {
    match (one, other) {
        (toml::Value::Float(one), toml::Value::Float(other)) => {
            let largest = one.abs().max(other.abs());
            one == other || largest < 1e-15 || (one - other).abs() < 1e-12 * largest
        }
        (toml::Value::Array(one), toml::Value::Array(other)) => {
            one.len() == other.len()
                && one.iter().zip(other).all(|(one, other)| are_alike(one, other))
        }
        _ => one == other,
    }
}

/// In what the test views of two datasets differ, in words.
fn difference(one: &Dataset, other: &Dataset) -> Option<String> {
    let views = |dataset: &Dataset| {
        dataset.test_views().map(|view| (view.name.clone(), view.camera)).collect::<Vec<_>>()
    };
    let (views_of_one, others) = (views(one), views(other));
    if views_of_one.len() != others.len() {
        return Some(format!("{} test views and {}", views_of_one.len(), others.len()));
    }
    for ((name, camera), (other_name, other)) in views_of_one.iter().zip(&others) {
        if name != other_name {
            return Some(format!("test view {name} is {other_name} in the other"));
        }
        let [size, other_size] = [camera, other].map(|camera| [camera.width, camera.height]);
        if size != other_size {
            let [[a, b], [c, d]] = [size, other_size];
            return Some(format!("test view {name} is {a}x{b} and {c}x{d} pixels"));
        }
        let distance = camera.center().distance(other.center());
        if distance > POSE_ERROR * camera.center().length().max(1e-3) {
            return Some(format!("test view {name} has another pose"));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_differ_by_rounding_are_alike() {
        let up = |x: f64| toml::Value::from(vec![x, -1.0, 0.0]);
        assert!(are_alike(&up(0.0), &up(1e-17)) && !are_alike(&up(0.0), &up(1e-9)));
        let rate = |x: f64| toml::Value::from(x);
        assert!(are_alike(&rate(1e-13), &rate(1e-13)) && !are_alike(&rate(1e-13), &rate(2e-13)));
        assert!(!are_alike(&rate(f64::NAN), &rate(1.0)) && !are_alike(&rate(1.0), &"1".into()));
    }
}
