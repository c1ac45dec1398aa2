//! `nightsplat diagnose`: measures photographs and chooses a model for them, with reasons.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Result;
use nightsplat_core::output::{one_line, write_whole};
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::tree::check_writable;
use serde::Serialize;

use super::settings::{Selection, SettingOptions, push_dataset};
use super::tell::wrapped;
use super::{finish, opener, print, word, words};
use crate::Error;
use crate::driver;
use crate::gpu::DeviceChoice;
use crate::results::eval::{ResidualTransmittance, hole_warning, photographs_show_sky};
use crate::results::finished_run::FinishedRun;
use crate::results::{diagnosis, verdict};
use crate::train::plan::Plan;
use crate::train::{Preset, RequestedSettings, diagnosed};
use nightsplat_diagnose::Diagnosis;

/// Measure photographs before training, and choose a model for them.
///
/// Measures brightness, noise, blur, exposures and overlap of the training photographs in seconds, and chooses the
/// parts of the model from that, each with its reason. `nightsplat train` does the same; this command shows why, and
/// lets you edit the plan. Reference images are not used.
///
/// Begins with a verdict and the photographs that need attention. -v adds all measurements and what is off.
///
/// Columns of the table of -v: p10, p90, mean and cubic mean of the encoded luminance; r = p10 / p90; EV: stops above
/// the other views of the same points; white and black: values near white (0.94 and above) and zero values; codes:
/// distinct values; luma and chroma noise: standard deviations in the target, after the tone curve, with JPEG and
/// quantisation noise; blur: width of edges, pixels; points: visible points; overlap: share of the view that other
/// views see.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct DiagnoseArgs {
    /// Dataset: a folder with transforms*.json (LOM, RealX3D, NeRF) or a COLMAP model, such as `nightsplat pose` writes
    pub dataset: PathBuf,
    /// Print JSON instead of text
    #[arg(long)]
    pub json: bool,
    /// Write a page with plan, photographs and all measurements
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// Write the plan, for `nightsplat train --plan`
    #[arg(long, value_name = "FILE.toml")]
    pub plan: Option<PathBuf>,
    /// Also look for holes in the model of this run
    #[arg(long, value_name = "RUN")]
    pub run: Option<PathBuf>,
    /// Plan for this preset: draft, fast, balanced or best [default: balanced]
    #[arg(long, value_name = "NAME", value_parser = words::presets())]
    pub preset: Option<Preset>,
    #[command(flatten)]
    settings: SettingOptions<OfPhotographs>,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// Settings on which measurements or plan depend.
#[derive(Clone, Copy, Debug)]
struct OfPhotographs;

impl Selection for OfPhotographs {
    fn has(key: &str) -> bool {
        ["downscale", "max_resolution", "light", "white_balance", "orientation", "steps"]
            .contains(&key)
    }
}

/// The output of `--json`.
#[derive(Serialize)]
struct DiagnoseOutput<'a> {
    device: &'a str,
    #[serde(flatten)]
    diagnosis: &'a Diagnosis,
    plan: &'a Plan,
    /// Residual transmittance of the model by view.
    #[serde(skip_serializing_if = "Option::is_none")]
    residual_transmittance: Option<&'a BTreeMap<String, ResidualTransmittance>>,
}

const EXAMPLES: &str = "Examples:
  nightsplat diagnose photos --report photos.html
  nightsplat diagnose photos --plan plan.toml           edit plan.toml, then
  nightsplat train photos --out run --plan plan.toml";

/// Measures, plans and prints; `everything`: with all measurements.
pub fn run(args: &DiagnoseArgs, everything: bool) -> Result<()> {
    let mut requested = RequestedSettings { preset: args.preset, ..Default::default() };
    push_dataset(&mut requested.options, &args.dataset)?;
    args.settings.push(&mut requested.options)?;
    let config = requested.settings(None)?.config()?;
    args.report.iter().chain(&args.plan).try_for_each(|path| check_writable(path))?;
    let gpu = driver::open(&args.device.clone().unwrap_or_default())?;
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
        write_whole(path, diagnosis::page(&dataset, &diagnosis, &plan).as_bytes())?;
    }
    let device = gpu.properties().name.as_str();
    let text = if args.json {
        let residual_transmittance =
            run.as_ref().map(|(_, residual_transmittances)| residual_transmittances);
        let output =
            DiagnoseOutput { device, diagnosis: &diagnosis, plan: &plan, residual_transmittance };
        let json = serde_json::to_string_pretty(&output);
        json.map_err(|error| Error::output("standard output", error.to_string()))? + "\n"
    } else {
        text(device, &dataset, &diagnosis, &plan, everything)
    };
    print(text)?;
    if args.json {
        return Ok(());
    }
    let plan = args.plan.as_ref().map(|plan| format!(" --plan {}", word(plan)));
    let wrote = args.report.iter().chain(&args.plan).map(|path| path.display().to_string());
    finish(
        &wrote.collect::<Vec<_>>().join(", "),
        &format!("nightsplat train {} --out run{}", word(&args.dataset), plan.unwrap_or_default()),
    );
    Ok(())
}

/// The residual transmittance of the model of a run in every view, and a remark on it.
fn holes(
    run: &Path,
    args: &DiagnoseArgs,
) -> Result<(String, BTreeMap<String, ResidualTransmittance>)> {
    let FinishedRun { config, dataset, mut model_renderer, .. } =
        FinishedRun::open(run, Some(&args.dataset), &opener(args.device.as_ref()))?;
    let mut found = BTreeMap::new();
    for view in &dataset.views {
        let residual_transmittance =
            ResidualTransmittance::measure(&model_renderer.render(view)?, view);
        found.extend(residual_transmittance.map(|one| (view.name.clone(), one)));
    }
    let views = found.iter().map(|(name, one)| (name.as_str(), one.mean));
    let healthy = || {
        let mean = found.values().map(|one| one.mean).sum::<f64>() / found.len().max(1) as f64;
        format!(
            "{}: {:.1} % of the background shows through the model",
            run.display(),
            100.0 * mean
        )
    };
    let warning = hole_warning(views, config.background);
    let warning = warning.filter(|_| !photographs_show_sky(&config, &dataset));
    let remark = warning.unwrap_or_else(healthy);
    Ok((remark, found))
}

/// The verdict, what needs attention, and what will be on; with `everything`, all measurements and what is off.
fn text(
    device: &str,
    dataset: &Dataset,
    diagnosis: &Diagnosis,
    plan: &Plan,
    everything: bool,
) -> String {
    let Diagnosis { views, test_views, remarks, .. } = diagnosis;
    let mut text = wrapped(&verdict::of_set(diagnosis), 0);
    for remark in remarks {
        text += &wrapped(&format!("note: {}", one_line(remark)), 6);
    }
    text.push('\n');
    if everything {
        text += &wrapped(
            &format!(
                "{}: {} photographs to train on ({}), {test_views} held out, {} points; on {device}",
                one_line(&dataset.root.to_string_lossy()),
                views.len(),
                diagnosis::sizes(views),
                dataset.points.len()
            ),
            0,
        );
        text.push('\n');
        text += &diagnosis::table(diagnosis).text();
        text.push('\n');
        for [name, figures] in diagnosis::scene_facts(&diagnosis.scene) {
            text += &wrapped(&format!("{name:<12}{figures}"), 12);
        }
        text.push('\n');
    }
    text += &decisions(plan, everything);
    if !everything {
        text += "-v shows all measurements, and what is off\n";
    }
    text
}

/// The plan, one decision per paragraph; without `everything`, what is on.
pub(super) fn decisions(plan: &Plan, everything: bool) -> String {
    let decisions = plan.decisions();
    // What makes the targets is told in any case.
    let is_shown = |(part, decided, _): &&(&str, String, &str)| {
        everything || decided != "off" || *part == "curve"
    };
    let shown: Vec<&(&str, String, &str)> = decisions.iter().filter(is_shown).collect();
    let width =
        |of: fn(&(&str, String, &str)) -> usize| decisions.iter().map(of).max().unwrap_or(0);
    let (name, value) = (width(|one| one.0.len()), width(|one| one.1.len()));
    let paragraph = |(part, decided, why): &&(&str, String, &str)| {
        let text = format!("{part:name$}  {decided:value$}  {}", one_line(why));
        wrapped(&text, name + value + 4)
    };
    shown.iter().map(paragraph).collect()
}
