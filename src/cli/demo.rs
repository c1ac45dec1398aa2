//! `nightsplat demo`: make a dark multi-view set, train on it with three curves, and show what comes out.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::comparison::{self, Run};
use super::{progress, table};
use crate::Error;
use crate::base::output::write_whole;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::photographs::dataset::synthetic::{self, SyntheticOptions};
use crate::photographs::pseudo_gt::PseudoGt;
use crate::photographs::tone::{Scene, ToneCurve, ToneSettings};
use crate::results::eval::{self, ViewScore};
use crate::results::report::{Distribution, Report, distributions};
use crate::results::run::HeldRun;
use crate::splats::optimizer::Schedule;
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
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// In the order of the page: the baseline first.
const CURVES: [ToneCurve; 3] = [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3];

/// Enough for a clear picture, few enough for two processor cores.
const STEPS: u64 = 400;

/// Marks a folder as ours to overwrite.
const MARK: &str = ".nightsplat-demo";

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
    let dataset = Dataset::load(&folder, &TrainConfig::bare().load_options())?;
    let mut runs = vec![];
    for curve in CURVES {
        runs.push(train_with(curve, &gpu, &dataset, &args.out)?);
    }
    let dark = dark_scores(&dataset)?;
    let page = args.out.join("index.html");
    let luminances = luminances(&gpu, &dataset)?;
    write_whole(&page, report(&gpu, &dataset, &dark, &runs, luminances)?.html().as_bytes())?;
    let mut out = std::io::stdout().lock();
    let table = table::of(&comparison::score_table("target", &dark, &runs));
    write!(out, "{table}\n{}\n", page.display())?;
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
            ..Schedule::paper()
        },
        ..TrainConfig::bare()
    }
}

fn train_with(curve: ToneCurve, gpu: &Gpu, dataset: &Dataset, out: &Path) -> crate::Result<Run> {
    let config = config(curve, dataset, gpu);
    let folder = out.join(curve.name());
    let trained = progress::train(gpu, &config, dataset, &folder, HeldRun::Replace)?;
    Run::new(title(curve), trained, dataset)
}

/// What the dark photographs themselves score: the least that a model must beat.
fn dark_scores(dataset: &Dataset) -> crate::Result<Vec<ViewScore>> {
    let nothing = || Error::input(&dataset.root, "has a test view without its dark photograph");
    eval::score(dataset, |view| Ok(view.loaded()?.ok_or_else(nothing)?.into_owned().into()))
}

/// The name of a run on the page.
fn title(curve: ToneCurve) -> String {
    let ToneSettings { gain_c, theta, .. } = ToneSettings::new(curve);
    match curve {
        ToneCurve::Linear => format!("linear, theta {theta}"),
        ToneCurve::Ase => format!("ASE, c {gain_c}"),
        ToneCurve::Ap3 => format!("AP3, c {gain_c}"),
        other => other.name().to_owned(),
    }
}

// ---------------------------------------------------------------------------
// The page

/// How the luminance of the photographs with a reference image is distributed, before and after each curve.
fn luminances(gpu: &Gpu, dataset: &Dataset) -> crate::Result<String> {
    let mut pairs = vec![];
    for view in &dataset.views {
        pairs.extend(view.loaded()?.zip(view.loaded_reference()?));
    }
    let mut photographs = Distribution::new("photograph");
    let mut references = Distribution::new("reference");
    for (photograph, reference) in &pairs {
        photographs.add(&photograph.data);
        references.add(&reference.data);
    }
    let mut drawn = vec![photographs];
    for curve in CURVES {
        let settings = ToneSettings::new(curve);
        let mut pseudo_gt = PseudoGt::new(gpu, &settings)?;
        let mut targets = Distribution::new(title(curve));
        for (photograph, _) in &pairs {
            let measured = pseudo_gt.measure(&photograph.data)?;
            let lift = settings.lift(&Scene::default(), &measured);
            targets.add(&pseudo_gt.lifted(photograph, &lift)?.data);
        }
        drawn.push(targets);
    }
    drawn.push(references);
    Ok(distributions(&drawn))
}

fn report(
    gpu: &Gpu,
    dataset: &Dataset,
    dark: &[ViewScore],
    runs: &[Run],
    luminances: String,
) -> crate::Result<Report> {
    let train_views = dataset.train_views().count();
    let size = dataset.views.first().map_or([0; 2], |view| [view.camera.width, view.camera.height]);
    Ok(Report {
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
        tables: vec![comparison::score_table("target", dark, runs)],
        plots: vec![luminances],
        comparisons: comparison::of_views(dataset, dark, runs)?,
        ..Report::default()
    })
}
