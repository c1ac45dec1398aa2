//! Runs of one dataset side by side: the tables, curves and pictures of `demo` and `ablate`.

use std::collections::BTreeMap;

use crate::Result;
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::Image;
use crate::photographs::metrics::Scores;
use crate::results::eval::{self, ViewScore};
use crate::results::report::{Best, Column, Comparison, Picture, Series, Table};
use crate::results::run::{Spent, Trained};

/// A run and what it made of the test views.
pub(super) struct Run {
    title: String,
    scored: Vec<ViewScore>,
    /// What it shows of those that have a reference image, by name.
    renders: BTreeMap<String, Image>,
    gaussians: usize,
    spent: Spent,
    /// Of every step.
    losses: Vec<f64>,
}

impl Run {
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn new(title: String, trained: Trained, dataset: &Dataset) -> Result<Self> {
        let Trained { mut trainer, scored, losses, spent, .. } = trained;
        let mut renders = BTreeMap::new();
        for view in pictured(dataset) {
            let render = trainer.render(&view.camera)?;
            renders.insert(view.name.clone(), render.output().clone());
        }
        let gaussians = trainer.gaussian_count();
        Ok(Self { title, scored, renders, gaussians, spent, losses })
    }
}

/// Means over the test views, first of the dark photographs.
pub(super) fn score_table(label: &str, dark: &[ViewScore], runs: &[Run]) -> Table {
    let column = |name: &str, digits, best| Column { name: name.to_owned(), digits, best };
    let has_r0 = runs.iter().any(|run| eval::means(&run.scored).1.is_some());
    let scores = |scored: &[ViewScore]| {
        let (mean, r0) = eval::means(scored);
        let mut values = vec![
            mean.map(|mean| mean.psnr),
            mean.map(|mean| mean.psnr_channel_mean),
            mean.map(|mean| mean.ssim),
        ];
        if has_r0 {
            // Without a denoiser what is scored is R_0.
            let r0 = r0.or(mean);
            values.extend([r0.map(|r0| r0.psnr), r0.map(|r0| r0.ssim)]);
        }
        values
    };
    let mut rows = vec![("dark photograph".to_owned(), scores(dark))];
    rows.extend(runs.iter().map(|run| {
        let mut values = scores(&run.scored);
        let mebibytes = run.spent.device_bytes as f64 / f64::from(1 << 20);
        values.extend([Some(run.spent.seconds), Some(mebibytes), Some(run.gaussians as f64)]);
        (run.title.clone(), values)
    }));
    let mut columns = vec![
        column("PSNR, dB", 2, Best::Greatest),
        column("channel-mean PSNR, dB", 2, Best::Greatest),
        column("SSIM", 3, Best::Greatest),
    ];
    if has_r0 {
        columns.push(column("PSNR of R_0, dB", 2, Best::Greatest));
        columns.push(column("SSIM of R_0", 3, Best::Greatest));
    }
    columns.extend([
        column("training, s", 0, Best::Unmarked),
        column("peak, MiB", 0, Best::Unmarked),
        column("Gaussians", 0, Best::Unmarked),
    ]);
    let title = "Means over the test views".to_owned();
    Table { title, label: label.to_owned(), columns, rows }
}

/// The mean loss of every epoch: single views differ too much for a line. Losses against one target alone compare.
pub(super) fn loss_series(runs: &[Run], epoch: usize) -> Vec<Series> {
    let of_run = |run: &Run| {
        let epochs = run.losses.chunks_exact(epoch.max(1)).enumerate();
        let point = |(index, losses): (usize, &[f64])| {
            let mean = losses.iter().sum::<f64>() / losses.len() as f64;
            (((index + 1) * epoch) as f64, mean)
        };
        let points = epochs.map(point).collect();
        Series { name: run.title.clone(), points, ..Series::default() }
    };
    runs.iter().map(of_run).collect()
}

/// The test views that are shown.
fn pictured(dataset: &Dataset) -> impl Iterator<Item = &View> {
    dataset.test_views().filter(|view| view.has_reference())
}

/// Every test view that has a reference image: what came in, what each run made of it, and what it should be.
///
/// # Errors
/// A photograph that is not kept can no longer be read.
pub(super) fn of_views(
    dataset: &Dataset,
    dark: &[ViewScore],
    runs: &[Run],
) -> Result<Vec<Comparison>> {
    pictured(dataset).map(|view| of_view(view, dark, runs)).collect()
}

fn of_view(view: &View, dark: &[ViewScore], runs: &[Run]) -> Result<Comparison> {
    let picture = |caption: &str, scored: &[ViewScore], image: &Image| {
        let scored = scored.iter().find(|scored| scored.name == view.name)?;
        let Scores { psnr, ssim, .. } = scored.scores;
        let scores = format!("{psnr:.2} dB, SSIM {ssim:.3}");
        Some(Picture { caption: caption.to_owned(), scores, image: image.clone() })
    };
    let photograph = view.loaded()?;
    let photograph = photograph.and_then(|image| picture("dark photograph", dark, &image));
    let mut pictures: Vec<Picture> = photograph.into_iter().collect();
    let of_run = |run: &Run| picture(&run.title, &run.scored, run.renders.get(&view.name)?);
    pictures.extend(runs.iter().filter_map(of_run));
    pictures.extend(view.loaded_reference()?.map(|image| Picture {
        caption: "normal-light reference".to_owned(),
        scores: String::new(),
        image: image.into_owned(),
    }));
    Ok(Comparison { title: format!("Test view {}", view.name), pictures })
}
