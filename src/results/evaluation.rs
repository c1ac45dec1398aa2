//! A run scored on its test views, and its page: scores, error maps with the worst view first, history of training.

use std::path::{Path, PathBuf};

use nightsplat_core::csv;
use nightsplat_photographs::dataset::{View, ViewPictures};
use nightsplat_photographs::image::Image;
use nightsplat_photographs::metrics::Scores;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_report::{Chart, Comparison, Picture, Report, Series};
use serde_json::Value;

use super::eval::{
    self, After, Evaluation, Extras, Metric, ScoreReference, ScoredImages, with_reference,
};
use super::finished_run::{FinishedRun, Opener, is_model};
use super::{run, verdict};
use crate::Result;
use crate::networks::lpips::{Lpips, Range};
use crate::train::{Rendered, TrainConfig, known_stops};

/// Maximum width of an image, pixels.
const PICTURE_WIDTH: u32 = 480;
/// Maximum number of views with images.
const SHOWN: usize = 16;
/// Factor from error to brightness in an error map.
const ERROR_SCALE: f32 = 5.0;
/// Maximum number of points of the loss curve.
const LOSS_POINTS: usize = 200;

/// What is scored of a run.
#[derive(Debug)]
pub(crate) struct EvalOptions<'a> {
    /// `None`: the run's dataset, reference images and downscale factor.
    pub(crate) dataset: Option<&'a Path>,
    pub(crate) reference: Option<&'a Path>,
    pub(crate) downscale: Option<f64>,
    /// Renders of another program that are scored in place of those of the model.
    pub(crate) renders: Option<&'a Path>,
    pub(crate) opener: Opener,
    /// The weights and the input range of LPIPS.
    pub(crate) lpips: Option<(&'a Path, Range)>,
    /// Whether SSIM with a uniform window is added.
    pub(crate) uniform_ssim: bool,
    /// Whether scores after gain and bias are added.
    pub(crate) align: bool,
    /// Whether scores of the renders as photographs are added.
    pub(crate) photographs: bool,
    /// The folder for renders and the images that they are compared with.
    pub(crate) images: Option<&'a Path>,
    /// Whether images for the page are kept.
    pub(crate) with_page: bool,
}

/// The scores of a run or a model.
#[derive(Debug)]
pub(crate) struct RunEvaluation {
    run: PathBuf,
    /// The renders of another program, if these are scored.
    renders: Option<PathBuf>,
    config: TrainConfig,
    gaussians: Option<usize>,
    pub(crate) evaluation: Evaluation,
    /// Images of the views with the lowest PSNR, the lowest first.
    worst: Vec<(f64, Comparison)>,
}

impl RunEvaluation {
    /// Scores the run; `begin` is called before each view with its index, the number of views and its name.
    pub(crate) fn new(
        run: &Path,
        options: &EvalOptions<'_>,
        mut begin: impl FnMut(usize, usize, &str),
    ) -> Result<Self> {
        let change = |config: &mut TrainConfig| {
            config.reference = options.reference.map(Path::to_owned).or(config.reference.take());
            config.downscale = options.downscale.unwrap_or(config.downscale);
        };
        let opened = FinishedRun::open_with(run, options.dataset, &options.opener, change)?;
        let states_targets = opened.states_targets;
        let FinishedRun { gpu, config, dataset, gaussian_count, mut model_renderer, .. } = opened;
        let is_lit = model_renderer.light_as(run, 1.0)?;
        let lpips = options.lpips.map(|(weights, range)| Lpips::load(&gpu, weights, range));
        let lpips = lpips.transpose()?;
        let scene = options.photographs.then(|| SceneTone::measure(&config.tone, &dataset));
        let extras = Extras {
            lpips: lpips.as_ref().map(|lpips| (lpips, &gpu)),
            uniform_ssim: options.uniform_ssim,
            with_gain_and_bias: options.align || config.exposure.learn,
            scene: scene.transpose()?,
            stops: known_stops(&dataset, &config)?,
        };
        let mut reference = ScoreReference::new(&gpu, &config.tone, &dataset)?;
        if !states_targets && !options.photographs {
            reference.check_brightness(run, &dataset, |view| model_renderer.render(view))?;
        }
        let (count, mut index) = (reference.view_count(&dataset), 0);
        let is_even = reference.is_evenly_lit(&dataset);
        let pictures = options.renders.map(|folder| ViewPictures::of_tests(folder, &dataset));
        let pictures = pictures.transpose()?;
        let render = |view: &View| {
            begin(index, count, &view.name);
            index += 1;
            match &pictures {
                Some(pictures) => pictures.load(view).map(Rendered::from),
                None => model_renderer.render_as(view, is_even),
            }
        };
        let mut worst = vec![];
        let keep = |images: &ScoredImages<'_>| {
            if let Some(folder) = options.images {
                images.save(folder)?;
            }
            if options.with_page {
                keep_worst(&mut worst, images);
            }
            Ok(())
        };
        let mut evaluation = Evaluation::new(&mut reference, &dataset, &extras, render, keep)?;
        if is_lit && pictures.is_none() {
            evaluation.add_lit(&dataset, |view| model_renderer.render(view))?;
        }
        if pictures.is_none() {
            evaluation.shows_sky = eval::photographs_show_sky(&config, &dataset);
            let render = |view: &View| model_renderer.render(view);
            eval::warn_of_holes(&evaluation, &dataset, config.background, render)?;
        }
        if evaluation.scores.is_empty() {
            let root = dataset.root.display();
            tracing::warn!(
                "{root}: no test view has a reference image or a photograph: nothing to score"
            );
        }
        let renders = options.renders.map(Path::to_owned);
        let gaussians = Some(gaussian_count).filter(|_| renders.is_none());
        Ok(Self { run: run.to_owned(), renders, config, gaussians, evaluation, worst })
    }

    /// The scores with what `metrics.json` of the run records besides.
    pub(crate) fn json(&self) -> Value {
        if let Some(renders) = &self.renders {
            let mut metrics = self.evaluation.json(None, None, None);
            metrics["renders"] = serde_json::json!(renders);
            eval::add_reference(&mut metrics, &self.config.tone);
            self.evaluation.add_other_steps(&mut metrics, false);
            return metrics;
        }
        let recorded = run::load_metrics(&self.run);
        let steps = recorded["steps"].as_u64().or_else(|| run::stopped_at(&self.run));
        let steps = steps.or(Some(self.config.steps)).filter(|_| !is_model(&self.run));
        let mut metrics = self.evaluation.json(recorded["seconds"].as_f64(), self.gaussians, steps);
        eval::add_reference(&mut metrics, &self.config.tone);
        for key in
            [run::SPENT, run::TARGET_EXPOSURE, run::ENDED, run::TRAINED_WITH, run::HELD_OUT_CURVE]
        {
            if let Some(value) = recorded.get(key) {
                metrics[key] = value.clone();
            }
        }
        let learns_exposures = self.config.exposure.learn;
        self.evaluation.add_other_steps(&mut metrics, learns_exposures);
        metrics
    }

    /// Notes below the table of scores.
    pub(crate) fn notes(&self) -> Vec<String> {
        let mean = |metric, after| self.evaluation.mean(metric, after);
        let lit = mean(Metric::Psnr, After::LampLight).zip(mean(Metric::Ssim, After::LampLight));
        let lit = lit.map(|(psnr, ssim)| {
            format!(
                "in the lamp's light, against lit/, after gain and bias of each channel: PSNR {psnr:.2} dB, \
                 SSIM {ssim:.3}"
            )
        });
        let slope = mean(Metric::Slope, After::InverseCurve).map(|slope| {
            let decibels = 20.0 * slope.log10();
            format!(
                "the tone law multiplies differences of the photographs by {slope:.2}: {decibels:.2} dB of PSNR, dark"
            )
        });
        let reference = self.config.tone.knows_references().map(|known| with_reference(&known));
        let verdict = verdict::of_model(&self.evaluation);
        let label = self.evaluation.label().map(str::to_owned);
        [reference, lit, slope, verdict, label].into_iter().flatten().collect()
    }

    /// The page of the run.
    pub(crate) fn html(&self) -> String {
        let evaluation = &self.evaluation;
        let mut comparisons: Vec<Comparison> =
            self.worst.iter().map(|(_, view)| view.clone()).collect();
        if let [worst, _, ..] = &mut comparisons[..] {
            worst.title = format!("The worst view, {}", worst.title);
        }
        let verdict = verdict::of_model(evaluation).map(|sentence| sentence + ".");
        let lpips = evaluation.lpips.zip(evaluation.mean(Metric::Lpips, After::Model));
        let lpips = lpips.map(|(measure, mean)| format!("{}: {mean:.4}.", measure.title()));
        let shown = format!("Images of {} views, the worst first.", comparisons.len());
        let against = evaluation.label().map(|label| format!("Scores are {label}."));
        let (subject, charts) = match &self.renders {
            Some(renders) => (renders, vec![]),
            None => (&self.run, history(&self.run)),
        };
        Report {
            title: format!("Evaluation of {}", subject.display()),
            intro: verdict.into_iter().chain(lpips).chain(against).chain([shown]).collect(),
            tables: vec![evaluation.table()],
            charts,
            comparisons,
            ..Report::default()
        }
        .html()
    }
}

/// Adds the images of a view, and drops those of the best view beyond [`SHOWN`].
fn keep_worst(worst: &mut Vec<(f64, Comparison)>, images: &ScoredImages<'_>) {
    let ScoredImages { view, render, target, against, scores } = images;
    let picture = |caption: &str, image: &Image| {
        Picture::shrunk(caption, String::new(), &view.upright(image.clone()), PICTURE_WIDTH)
    };
    let error = |(a, b): (&f32, &f32)| (ERROR_SCALE * (a - b).abs()).min(1.0);
    let data = render.data.iter().zip(&target.data).map(error).collect();
    let error = Image { data, ..*render };
    let Scores { psnr, ssim, .. } = *scores;
    let pictures = vec![
        picture("render", render),
        picture(against.name().trim_end_matches('s'), target),
        picture(&format!("error, times {ERROR_SCALE}"), &error),
    ];
    let title = format!("{}: {psnr:.2} dB, SSIM {ssim:.3}", view.name);
    worst.push((psnr, Comparison { title, pictures }));
    worst.sort_by(|a, b| a.0.total_cmp(&b.0));
    worst.truncate(SHOWN);
}

/// Loss and intermediate scores against the step, from the logs of the run.
fn history(run: &Path) -> Vec<Chart> {
    let log = std::fs::read_to_string(run.join("train.csv")).unwrap_or_default();
    let point = |line: &str| {
        let cells = csv::cells(line);
        Some((cells[0].parse().ok()?, cells.get(2)?.parse().ok()?))
    };
    let losses: Vec<(f64, f64)> = log.lines().filter_map(point).collect();
    let mean = |points: &[(f64, f64)]| {
        let sum = points.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        (sum.0 / points.len() as f64, sum.1 / points.len() as f64)
    };
    let bins = losses.chunks(losses.len().div_ceil(LOSS_POINTS).max(1)).map(mean).collect();
    let scores = run::load_progress(run).iter().map(|one| (one.step as f64, one.psnr)).collect();
    let series = [("loss", "loss", bins), ("PSNR, dB", "test views", scores)];
    let drawn = series.into_iter().filter(|(.., points): &(_, _, Vec<_>)| points.len() > 1);
    let charts = drawn.map(|(axis, name, points)| {
        let series = Series { name: name.to_owned(), points, ..Series::default() };
        Chart::new("step", axis, vec![series])
    });
    charts.collect()
}
