//! Scores as a table, and the page of one run: scores, error maps with the worst view first, history of training.

use std::path::Path;

use super::eval::{ResidualTransmittance, ScoredImages, ViewScore, label, mean_photograph, means};
use super::report::{Best, Column, Comparison, Picture, Report, Series, Table, plot};
use super::run::load_progress;
use crate::networks::lpips::Measure;
use crate::photographs::image::Image;
use crate::photographs::metrics::Scores;

/// Maximum width of an image, pixels.
const PICTURE_WIDTH: u32 = 480;
/// Maximum number of views with images.
const SHOWN: usize = 16;
/// Factor from error to brightness in an error map.
const ERROR_SCALE: f32 = 5.0;
/// Maximum number of points of the loss curve.
const LOSS_POINTS: usize = 200;

/// The scores of each view, and their means.
pub(crate) fn score_table(scored: &[ViewScore], measure: Option<Measure>) -> Table {
    let (mean, mean_r0) = means(scored);
    let mean_transmittance =
        ResidualTransmittance::mean(scored.iter().filter_map(|view| view.residual_transmittance));
    let column = |name: &str, digits, best| Column { name: name.to_owned(), digits, best };
    let mut columns = vec![
        column("PSNR", 2, Best::Unmarked),
        column("channel mean", 2, Best::Unmarked),
        column("SSIM", 4, Best::Unmarked),
    ];
    columns.extend(measure.map(|measure| column(&measure.title(), 4, Best::Unmarked)));
    // R_0 is the render before the denoiser.
    if mean_r0.is_some() {
        columns.push(column("PSNR of R_0", 2, Best::Unmarked));
        columns.push(column("SSIM of R_0", 4, Best::Unmarked));
    }
    if mean_transmittance.is_some() {
        columns
            .extend(["residual transmittance", "99 %"].map(|name| column(name, 4, Best::Unmarked)));
    }
    let aligned: Vec<Scores> = scored.iter().filter_map(|view| view.aligned).collect();
    let mean_aligned = Scores::mean(&aligned);
    if mean_aligned.is_some() {
        columns.extend(
            [("PSNR, aligned", 2), ("SSIM, aligned", 4)]
                .map(|(name, digits)| column(name, digits, Best::Unmarked)),
        );
    }
    let mean_photograph = mean_photograph(scored);
    if mean_photograph.is_some() {
        columns.extend(
            [("PSNR, dark", 2), ("stops", 3)]
                .map(|(name, digits)| column(name, digits, Best::Unmarked)),
        );
    }
    let exposed: Vec<Scores> = scored.iter().filter_map(|view| view.exposed).collect();
    let mean_exposed = Scores::mean(&exposed);
    if mean_exposed.is_some() {
        columns.push(column("PSNR, own exposure", 2, Best::Unmarked));
    }
    let row = |name: &str,
               scores: &Scores,
               [r0, aligned, exposed]: [Option<&Scores>; 3],
               photograph: Option<[f64; 3]>,
               residual_transmittance: Option<ResidualTransmittance>| {
        let Scores { psnr, psnr_channel_mean, ssim, lpips } = *scores;
        let mut values = vec![Some(psnr), Some(psnr_channel_mean), Some(ssim)];
        values.extend(measure.map(|_| lpips));
        if mean_r0.is_some() {
            values.extend([r0.map(|r0| r0.psnr), r0.map(|r0| r0.ssim)]);
        }
        if mean_transmittance.is_some() {
            values.extend([
                residual_transmittance.map(|own| own.mean),
                residual_transmittance.map(|own| own.q99),
            ]);
        }
        if mean_aligned.is_some() {
            values.extend([aligned.map(|own| own.psnr), aligned.map(|own| own.ssim)]);
        }
        if mean_photograph.is_some() {
            values.extend([photograph.map(|own| own[0]), photograph.map(|own| own[1])]);
        }
        if mean_exposed.is_some() {
            values.push(exposed.map(|own| own.psnr));
        }
        (name.to_owned(), values)
    };
    let of_view = |view: &ViewScore| {
        let others = [view.r0.as_ref(), view.aligned.as_ref(), view.exposed.as_ref()];
        row(&view.name, &view.scores, others, view.photograph, view.residual_transmittance)
    };
    let mut rows: Vec<_> = scored.iter().map(of_view).collect();
    let others = [mean_r0.as_ref(), mean_aligned.as_ref(), mean_exposed.as_ref()];
    rows.extend(mean.map(|mean| row("mean", &mean, others, mean_photograph, mean_transmittance)));
    Table { title: "Test views".to_owned(), label: "view".to_owned(), columns, rows }
}

/// The images of the page, gathered while views are scored.
#[derive(Debug, Default)]
pub(crate) struct EvalPage {
    /// PSNR, and the images of a view.
    views: Vec<(f64, Comparison)>,
}

impl EvalPage {
    /// Adds a scored view.
    pub(crate) fn add(&mut self, score: &ViewScore, compared: &ScoredImages<'_>) {
        let ScoredImages { view, render, target } = compared;
        let picture = |caption: &str, image: &Image| {
            Picture::shrunk(caption, String::new(), &view.upright(image.clone()), PICTURE_WIDTH)
        };
        let error = |(a, b): (&f32, &f32)| (ERROR_SCALE * (a - b).abs()).min(1.0);
        let data = render.data.iter().zip(&target.data).map(error).collect();
        let error = Image { data, ..*render };
        let Scores { psnr, ssim, .. } = score.scores;
        let pictures = vec![
            picture("render", render),
            picture(score.against.name().trim_end_matches('s'), target),
            picture(&format!("error, times {ERROR_SCALE}"), &error),
        ];
        let title = format!("{}: {psnr:.2} dB, SSIM {ssim:.3}", score.name);
        self.views.push((psnr, Comparison { title, pictures }));
        // Only the worst views are shown.
        self.views.sort_by(|a, b| a.0.total_cmp(&b.0));
        self.views.truncate(SHOWN);
    }

    /// The page of the run in the folder `run`.
    pub(crate) fn html(self, run: &Path, scored: &[ViewScore], measure: Option<Measure>) -> String {
        let mut comparisons: Vec<Comparison> =
            self.views.into_iter().map(|(_, view)| view).collect();
        if let [worst, _, ..] = &mut comparisons[..] {
            worst.title = format!("The worst view, {}", worst.title);
        }
        let mean = means(scored).0.map(|Scores { psnr, ssim, .. }| {
            format!("Mean over {} test views: {psnr:.2} dB, SSIM {ssim:.3}.", scored.len())
        });
        let shown = format!("Images of {} views, the worst first.", comparisons.len());
        let against = label(scored).map(|label| format!("Scores are {label}."));
        Report {
            title: format!("Evaluation of {}", run.display()),
            intro: mean.into_iter().chain(against).chain([shown]).collect(),
            tables: vec![score_table(scored, measure)],
            plots: history(run),
            comparisons,
            ..Report::default()
        }
        .html()
    }
}

/// Loss and intermediate scores against the step, from the logs of the run.
fn history(run: &Path) -> Vec<String> {
    let log = std::fs::read_to_string(run.join("train.csv")).unwrap_or_default();
    let point = |line: &str| {
        let mut cells = line.split(',');
        let step: f64 = cells.next()?.parse().ok()?;
        Some((step, cells.nth(1)?.parse().ok()?))
    };
    let losses: Vec<(f64, f64)> = log.lines().filter_map(point).collect();
    let mean = |points: &[(f64, f64)]| {
        let sum = points.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        (sum.0 / points.len() as f64, sum.1 / points.len() as f64)
    };
    let bins = losses.chunks(losses.len().div_ceil(LOSS_POINTS).max(1)).map(mean).collect();
    let scores = load_progress(run).iter().map(|one| (one.step as f64, one.psnr)).collect();
    let series = [("loss", "loss", bins), ("PSNR, dB", "test views", scores)];
    let drawn = series.into_iter().filter(|(.., points): &(_, _, Vec<_>)| points.len() > 1);
    let plots = drawn.map(|(axis, name, points)| {
        plot("step", axis, &[Series { name: name.to_owned(), points, ..Series::default() }])
    });
    plots.collect()
}
