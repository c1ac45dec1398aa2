//! `nightsplat demo`: make a dark multi-view set, train on it with three curves, and show what comes out.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::{table, train};
use crate::Error;
use crate::dataset::synthetic::{self, SyntheticOptions};
use crate::dataset::{Dataset, View};
use crate::eval::{self, ViewScore};
use crate::export::{self, RunDirectory};
use crate::gpu::{DeviceChoice, Gpu};
use crate::image::Image;
use crate::metrics::Scores;
use crate::optimizer::Schedule;
use crate::report::{Best, Column, Comparison, Picture, Report, Series, Table, plot};
use crate::tone::{ToneCurve, ToneSettings};
use crate::train::TrainConfig;

/// Make a small dark multi-view set, train on it with three tone curves, and show the results side by side.
///
/// Takes less than three minutes on two processor cores. Leaves DIR/index.html, a page that needs no other file, and
/// beside it the set (DIR/dataset) and the three runs (DIR/linear, DIR/ase, DIR/ap3).
#[derive(Clone, Debug, clap::Args)]
pub struct DemoArgs {
    /// The folder to write to; an earlier demo in it is replaced
    #[arg(long, value_name = "DIR", default_value = "demo")]
    pub out: PathBuf,
    /// The device: a part of its name or its index in `nightsplat doctor` [default: the best]
    #[arg(long, value_name = "NAME|INDEX")]
    pub device: Option<DeviceChoice>,
}

/// In the order of the page: the baseline first.
const CURVES: [ToneCurve; 3] = [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3];

/// Enough for a clear picture, few enough for two processor cores.
const STEPS: u64 = 400;

/// Marks a folder as ours to overwrite.
const MARK: &str = ".nightsplat-demo";

/// One curve's run and what it made of the test views.
struct Run {
    curve: ToneCurve,
    scored: Vec<ViewScore>,
    seconds: f64,
    gaussians: usize,
    /// Of every step.
    losses: Vec<f64>,
}

/// Runs the demo.
///
/// # Errors
/// The folder holds something else, a file cannot be written, or there is no device.
pub fn run(args: &DemoArgs) -> Result<()> {
    let gpu = Gpu::new(&args.device.clone().unwrap_or_default())?;
    claim(&args.out)?;
    // Absolute, so that the runs can be evaluated from anywhere.
    let folder = std::path::absolute(args.out.join("dataset"))?;
    synthetic::write(&folder, &SyntheticOptions::default())?;
    let dataset = Dataset::load(&folder, &TrainConfig::default().load_options())?;
    let mut runs = vec![];
    for curve in CURVES {
        runs.push(train_with(curve, &gpu, &dataset, &args.out)?);
    }
    let dark = dark_scores(&dataset)?;
    let page = args.out.join("index.html");
    export::write_whole(&page, report(&gpu, &dataset, &dark, &runs).html().as_bytes())?;
    let mut out = std::io::stdout().lock();
    write!(out, "{}\n{}\n", table::of(&score_table(&dark, &runs)), page.display())?;
    Ok(())
}

/// Makes the folder, or takes one that an earlier demo made.
fn claim(folder: &Path) -> crate::Result<()> {
    let mark = folder.join(MARK);
    let is_empty = std::fs::read_dir(folder).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !mark.exists() {
        let problem = "is not empty and holds no earlier demo; choose another folder with --out";
        return Err(Error::output(folder, problem));
    }
    std::fs::create_dir_all(folder)
        .and_then(|()| std::fs::write(&mark, "`nightsplat demo` overwrites what it wrote here.\n"))
        .map_err(|error| Error::output(folder, format!("cannot be written: {error}")))
}

/// The paper's settings of a curve, on schedules that fit a short run.
fn config(curve: ToneCurve, dataset: &Dataset, gpu: &Gpu) -> TrainConfig {
    TrainConfig {
        dataset: dataset.root.clone(),
        steps: STEPS,
        device: gpu.properties().name.clone(),
        sh_degree: 1,
        tone: ToneSettings::new(curve),
        schedule: Schedule {
            means_rate_steps: STEPS,
            sh_degree_interval: STEPS / 2,
            densify_after: STEPS / 5,
            densify_before: 3 * STEPS / 5,
            densify_interval: STEPS / 10,
            ..Schedule::default()
        },
        ..TrainConfig::default()
    }
}

fn train_with(curve: ToneCurve, gpu: &Gpu, dataset: &Dataset, out: &Path) -> crate::Result<Run> {
    let config = config(curve, dataset, gpu);
    let mut directory = RunDirectory::create(&out.join(curve.name()), &config, true)?;
    let mut losses = vec![];
    let trained = train::train(gpu, &config, dataset, |step| {
        losses.push(step.loss);
        directory.log(step)
    })?;
    let (gaussians, seconds) = (trained.gaussians.count, trained.seconds);
    directory.save_model(&trained.gaussians)?;
    directory.save_metrics(&eval::metrics(&trained.scored, seconds, gaussians, config.steps))?;
    Ok(Run { curve, scored: trained.scored, seconds, gaussians, losses })
}

/// What the dark photographs themselves score: the least that a model must beat.
fn dark_scores(dataset: &Dataset) -> crate::Result<Vec<ViewScore>> {
    let nothing = || Error::input(&dataset.root, "has a test view without its dark photograph");
    eval::score(dataset, |view| view.image.clone().ok_or_else(nothing))
}

fn mean(scored: &[ViewScore]) -> Option<Scores> {
    Scores::mean(&scored.iter().map(|view| view.scores).collect::<Vec<_>>())
}

/// The name of a run on the page.
fn title(curve: ToneCurve) -> String {
    let ToneSettings { gain_c, theta, .. } = ToneSettings::new(curve);
    match curve {
        ToneCurve::None => "as it is".to_owned(),
        ToneCurve::Linear => format!("linear, theta {theta}"),
        ToneCurve::Ase => format!("ASE, c {gain_c}"),
        ToneCurve::Ap3 => format!("AP3, c {gain_c}"),
    }
}

// ---------------------------------------------------------------------------
// The page

fn report(gpu: &Gpu, dataset: &Dataset, dark: &[ViewScore], runs: &[Run]) -> Report {
    let train_views = dataset.train_views().count();
    let size = dataset.views.first().map_or([0; 2], |view| [view.camera.width, view.camera.height]);
    let test_views = dataset.test_views().filter(|view| view.reference.is_some());
    Report {
        title: "3D Gaussian Splatting from dark photographs".to_owned(),
        intro: vec![
            format!(
                "Trained on {train_views} photographs of {}x{} pixels that were exposed {} times too short: shot and \
                 read noise, 8 bits. Each curve lifts every photograph into the target that supervises training. The \
                 normal-light reference images are used for nothing but the scores below.",
                size[0],
                size[1],
                synthetic::DARKENING
            ),
            format!("{STEPS} steps each, on {}.", gpu.properties().name),
        ],
        tables: vec![score_table(dark, runs)],
        plots: vec![plot("step", "loss", &loss_series(runs, train_views))],
        comparisons: test_views.map(|view| comparison(view, dark, runs)).collect(),
    }
}

fn score_table(dark: &[ViewScore], runs: &[Run]) -> Table {
    let column = |name: &str, digits, best| Column { name: name.to_owned(), digits, best };
    let scores = |scored: &[ViewScore]| {
        let mean = mean(scored);
        vec![
            mean.map(|mean| mean.psnr),
            mean.map(|mean| mean.psnr_channel_mean),
            mean.map(|mean| mean.ssim),
        ]
    };
    let mut rows = vec![("dark photograph".to_owned(), scores(dark))];
    rows.extend(runs.iter().map(|run| {
        let mut values = scores(&run.scored);
        values.extend([Some(run.seconds), Some(run.gaussians as f64)]);
        (title(run.curve), values)
    }));
    Table {
        title: "Means over the test views".to_owned(),
        label: "target".to_owned(),
        columns: vec![
            column("PSNR, dB", 2, Best::Greatest),
            column("channel-mean PSNR, dB", 2, Best::Greatest),
            column("SSIM", 3, Best::Greatest),
            column("training, s", 0, Best::Unmarked),
            column("Gaussians", 0, Best::Unmarked),
        ],
        rows,
    }
}

/// The mean loss of every epoch: single views differ too much for a line.
fn loss_series(runs: &[Run], epoch: usize) -> Vec<Series> {
    let of_run = |run: &Run| {
        let epochs = run.losses.chunks_exact(epoch.max(1)).enumerate();
        let point = |(index, losses): (usize, &[f64])| {
            let mean = losses.iter().sum::<f64>() / losses.len() as f64;
            (((index + 1) * epoch) as f64, mean)
        };
        Series { name: title(run.curve), points: epochs.map(point).collect() }
    };
    runs.iter().map(of_run).collect()
}

/// One test view: what came in, what each curve made of it, and what it should be.
fn comparison(view: &View, dark: &[ViewScore], runs: &[Run]) -> Comparison {
    let picture = |caption: String, scored: &[ViewScore]| {
        let scored = scored.iter().find(|scored| scored.name == view.name)?;
        let Scores { psnr, ssim, .. } = scored.scores;
        let scores = format!("{psnr:.2} dB, SSIM {ssim:.3}");
        Some(Picture { caption, scores, image: scored.render.clone() })
    };
    let reference = |image: &Image| Picture {
        caption: "normal-light reference".to_owned(),
        scores: String::new(),
        image: image.clone(),
    };
    let mut pictures: Vec<Picture> =
        picture("dark photograph".to_owned(), dark).into_iter().collect();
    pictures.extend(runs.iter().filter_map(|run| picture(title(run.curve), &run.scored)));
    pictures.extend(view.reference.as_ref().map(reference));
    Comparison { title: format!("Test view {}", view.name), pictures }
}
