//! `nightsplat diagnose`: what a capture is, what its model needs, and why.

mod page;

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;
use serde::Serialize;

use super::finished_run::FinishedRun;
use super::table;
use crate::Error;
use crate::base::output::write_whole;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::results::eval::{ResidualTransmittance, hole_warning};
use crate::train::diagnose::{Diagnosis, Noise, Plan, SceneDiagnosis, ViewDiagnosis};
use crate::train::{Preset, TrainConfig, diagnosed};

/// Look at dark photographs before training: what they are, and what a model of them needs.
///
/// Measures brightness, noise, blur, exposures and overlap of the training photographs, in
/// seconds, and decides which parts the model has, each with its reason. `nightsplat train`
/// does the same by itself; here one sees why, and may disagree:
///
///   nightsplat diagnose photos --report photos.html
///   nightsplat diagnose photos --plan plan.toml         edit plan.toml, then
///   nightsplat train photos --out run --plan plan.toml
///   nightsplat diagnose photos --run run                where the model has holes
///
/// In the table, p10, p90, mean and cubic mean are of the luminance of encoded values, r is
/// p10 / p90; EV are stops more light than the other views show of the same points; noise is
/// its standard deviation at the mean, in linear light; blur is that of the edges, in pixels;
/// overlap is how much of what a view shows the others look at. No reference image is looked at.
#[expect(clippy::doc_markdown, reason = "in help, {setting} stands for its default")]
#[derive(Clone, Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub struct DiagnoseArgs {
    /// The dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model in sparse/, as `nightsplat pose` makes one
    pub dataset: PathBuf,
    /// Print everything as JSON
    #[arg(long)]
    pub json: bool,
    /// Write a page with the photographs, dark and lifted, and every figure
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// Write the plan, for `nightsplat train --plan`
    #[arg(long, value_name = "FILE.toml")]
    pub plan: Option<PathBuf>,
    /// Look at the model of this run as well: how much of the background it shows in each view
    #[arg(long, value_name = "RUN")]
    pub run: Option<PathBuf>,
    /// Plan for photographs shrunk by this factor; they are measured as stored [default: {downscale}]
    #[arg(long, value_name = "F")]
    pub downscale: Option<f64>,
    /// Plan for photographs of at most so many pixels on their longest side, as `train` has it; 0 or none: no limit [default: {max_resolution}]
    #[arg(long, value_name = "N|none", value_parser = max_resolution)]
    pub max_resolution: Option<u32>,
    /// Plan for this preset: draft, fast, balanced or best [default: balanced]
    #[arg(long, value_name = "NAME")]
    pub preset: Option<Preset>,
    /// Plan for so many steps [default: the preset's]
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// The device: uuid:, pci: or index of `nightsplat doctor`, a part of its name, or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Output<'a> {
    device: &'a str,
    #[serde(flatten)]
    diagnosis: &'a Diagnosis,
    plan: &'a Plan,
    /// Of the model of a run, by view.
    #[serde(skip_serializing_if = "Option::is_none")]
    residual_transmittance: Option<&'a BTreeMap<String, ResidualTransmittance>>,
}

/// Measures, plans and prints.
///
/// # Errors
/// The dataset is not usable or black altogether, there is no device, or a file cannot be written.
pub fn run(args: &DiagnoseArgs) -> Result<()> {
    let mut config = TrainConfig { dataset: args.dataset.clone(), ..TrainConfig::default() };
    args.preset.unwrap_or(Preset::Balanced).apply(&mut config)?;
    config.steps = args.steps.unwrap_or(config.steps);
    config.downscale = args.downscale.unwrap_or(config.downscale);
    config.max_resolution = args.max_resolution.unwrap_or(config.max_resolution);
    let gpu = Gpu::new(&args.device.clone().unwrap_or_default())?;
    let options = diagnosed(&config);
    let (dataset, mut diagnosis) = Diagnosis::load(&config.dataset, &options)?;
    let run = args.run.as_deref().map(|run| holes(run, args)).transpose()?;
    diagnosis.remarks.extend(run.iter().map(|(remark, _)| remark.clone()));
    let diagnosis = diagnosis;
    let plan = Plan::new(&diagnosis, &config, gpu.properties().memory);
    if let Some(path) = &args.plan {
        write_whole(path, plan.to_toml()?.as_bytes())?;
    }
    if let Some(path) = &args.report {
        write_whole(path, page::html(&dataset, &diagnosis, &plan).as_bytes())?;
    }
    let device = gpu.properties().name.as_str();
    let text = if args.json {
        let residual_transmittance =
            run.as_ref().map(|(_, residual_transmittances)| residual_transmittances);
        let output = Output { device, diagnosis: &diagnosis, plan: &plan, residual_transmittance };
        let json = serde_json::to_string_pretty(&output);
        json.map_err(|error| Error::output("standard output", error.to_string()))? + "\n"
    } else {
        text(device, &dataset, &diagnosis, &plan)
    };
    write!(std::io::stdout().lock(), "{text}")?;
    Ok(())
}

/// How much of the background the model of a run shows in every view of the dataset, and what to say of it.
fn holes(
    run: &Path,
    args: &DiagnoseArgs,
) -> Result<(String, BTreeMap<String, ResidualTransmittance>)> {
    let FinishedRun { config, dataset, mut model_renderer, .. } =
        FinishedRun::open(run, Some(&args.dataset), args.device.as_ref())?;
    let mut residual_transmittances = BTreeMap::new();
    for view in &dataset.views {
        let residual_transmittance = ResidualTransmittance::of(&model_renderer.render(view)?, view);
        residual_transmittances.extend(
            residual_transmittance
                .map(|residual_transmittance| (view.name.clone(), residual_transmittance)),
        );
    }
    let views = residual_transmittances
        .iter()
        .map(|(name, residual_transmittance)| (name.as_str(), *residual_transmittance));
    let healthy = || {
        let mean = ResidualTransmittance::mean(residual_transmittances.values().copied())
            .map_or(0.0, |own| own.mean);
        format!(
            "{}: {:.1} % of the background shows through the model",
            run.display(),
            100.0 * mean
        )
    };
    let remark = hole_warning(views, config.background).unwrap_or_else(healthy);
    Ok((remark, residual_transmittances))
}

/// What `--max-resolution` says.
fn max_resolution(text: &str) -> Result<u32, String> {
    match text {
        "none" => Ok(0),
        _ => text.parse().map_err(|_| "a number of pixels, or none".to_owned()),
    }
}

fn text(device: &str, dataset: &Dataset, diagnosis: &Diagnosis, plan: &Plan) -> String {
    let Diagnosis { views, test_views, remarks, .. } = diagnosis;
    let mut text = format!(
        "{}\n{} photographs to train on ({}), {test_views} held out, {} points; on {device}\n\n",
        dataset.root.display(),
        views.len(),
        sizes(views),
        dataset.points.len()
    );
    text += &table::aligned(&rows(diagnosis));
    text.push('\n');
    for (name, figures) in scene_facts(&diagnosis.scene) {
        text += &format!("{name:<12}{figures}\n");
    }
    for remark in remarks {
        text += &format!("note: {remark}\n");
    }
    text.push('\n');
    text + &decisions(plan)
}

/// The plan, a decision a line.
pub(super) fn decisions(plan: &Plan) -> String {
    let decisions = plan.decisions();
    let width =
        |of: fn(&(&str, String, &str)) -> usize| decisions.iter().map(of).max().unwrap_or(0);
    let (name, value) = (width(|one| one.0.len()), width(|one| one.1.len()));
    let line = |(part, decided, why): &(&str, String, &str)| {
        format!("{part:name$}  {decided:value$}  {why}\n")
    };
    decisions.iter().map(line).collect()
}

/// The size of the photographs, or the smallest and the largest.
fn sizes(views: &[ViewDiagnosis]) -> String {
    let area = |view: &&ViewDiagnosis| u64::from(view.size[0]) * u64::from(view.size[1]);
    let size = |view: Option<&ViewDiagnosis>| {
        view.map_or_else(String::new, |view| format!("{}x{}", view.size[0], view.size[1]))
    };
    let (least, most) = (size(views.iter().min_by_key(area)), size(views.iter().max_by_key(area)));
    if least == most { least } else { format!("{least} to {most}") }
}

/// What each column of the table is.
const COLUMNS: [&str; 14] = [
    "view", "p10", "p90", "r", "mean", "cubic", "EV", "white %", "black %", "codes", "noise",
    "blur", "points", "overlap",
];

fn rows(diagnosis: &Diagnosis) -> Vec<Vec<String>> {
    let mut rows = vec![COLUMNS.map(str::to_owned).to_vec()];
    rows.extend(diagnosis.views.iter().map(|view| {
        let mut row = vec![view.name.clone()];
        row.extend(values(view).iter().zip(DIGITS).map(|(value, digits)| cell(*value, digits)));
        row
    }));
    rows
}

/// Digits after the point of the columns behind the name.
const DIGITS: [usize; 13] = [4, 4, 2, 4, 4, 2, 2, 1, 0, 4, 1, 0, 2];

fn cell(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

/// The numbers of a view, in the order of the columns.
fn values(view: &ViewDiagnosis) -> [Option<f64>; 13] {
    [
        Some(view.p10),
        Some(view.p90),
        Some(view.r),
        Some(view.mean_luminance),
        Some(view.cubic_mean),
        view.exposure,
        Some(100.0 * view.clipped_fraction),
        Some(100.0 * view.zero_fraction),
        Some(view.code_values as f64),
        view.noise.map(|noise| noise.deviation(view.light)),
        view.blur,
        Some(view.points as f64),
        Some(view.overlap),
    ]
}

/// What was measured of all views together: a name and figures in each row.
fn scene_facts(scene: &SceneDiagnosis) -> [(&'static str, String); 5] {
    let noise = match scene.noise {
        Some(Noise { gain, read }) => format!(
            "gain {gain:.2e}, read {read:.2e} of white in linear light; {:.3} in a target, averaged over its views",
            scene.target_noise
        ),
        None => "not measurable: no part of the photographs is flat and not cut off".to_owned(),
    };
    let brightness = format!(
        "mean {:.4}, p10 {:.4}, p90 {:.4}, cubic mean {:.4}; lift {:.1}, {:.0} times too little light",
        scene.mean_luminance,
        scene.p10,
        scene.p90,
        scene.cubic_mean,
        scene.brightening,
        scene.darkening
    );
    let exposure = format!(
        "spread {:.2} stops between the views, light uneven by {:.1} stops within",
        scene.exposure_spread, scene.unevenness
    );
    let blur = scene.blur.map_or_else(|| "-".to_owned(), |blur| format!("{blur:.1} pixels"));
    let detail = format!(
        "blur {blur}, {:.0} code values in use, {:.2} % white, {:.1} % black",
        scene.code_values,
        100.0 * scene.clipped_fraction,
        100.0 * scene.zero_fraction
    );
    let cameras = format!(
        "a place is seen by {:.0} views, overlap {:.2}, {} points",
        scene.views_per_point, scene.overlap, scene.points
    );
    [
        ("brightness", brightness),
        ("exposure", exposure),
        ("noise", noise),
        ("detail", detail),
        ("cameras", cameras),
    ]
}
