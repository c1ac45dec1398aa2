//! `nightsplat tone apply`: measures photographs and applies a tone curve to them.

use std::path::PathBuf;

use nightsplat_core::output::one_line;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::tone::{CurveChoice, Tone};

use crate::cli::settings::{CurveOptions, Selection, SettingOptions};
use crate::cli::tell::wrapped;
use crate::cli::{OutputFormat, finish, print, progress_bar, quoted, word, words};
use crate::gpu::DeviceChoice;
use crate::results::eval;
use crate::results::toned::{self, ToneOutput, ToneProgress, ToneRequest, table};
use crate::train::{RequestedSettings, TrainConfig};
use crate::{Result, driver};

/// Apply a tone curve to photographs, and measure the effect.
#[derive(Clone, Debug, clap::Args)]
pub struct ApplyArgs {
    /// Photograph (PNG, JPEG, WebP, TIFF, EXR), folder of photographs, or dataset
    ///
    /// Photograph (PNG, JPEG, WebP, TIFF, EXR), folder of photographs, or dataset. Photographs are turned upright by
    /// Exif; those of a dataset are taken as stored, and not undistorted.
    pub input: PathBuf,
    #[command(flatten)]
    tone: CurveOptions,
    #[command(flatten)]
    settings: SettingOptions<OfTargets>,
    /// Folder for the results, under the same names [default: write nothing]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// References in normal light to score against: a folder with the same names, or a file
    #[arg(long, value_name = "DIR|FILE")]
    pub reference: Option<PathBuf>,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// Write a page with all photographs, dark and lit, measurements and histograms
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// More curves for the page
    #[arg(long, value_name = "NAME|FILE,..", value_delimiter = ',', requires = "report")]
    #[arg(value_parser = words::curves::<CurveChoice>())]
    pub compare: Vec<CurveChoice>,
    /// Image format
    #[arg(long, value_enum, default_value_t)]
    pub format: OutputFormat,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the best]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

/// Settings of targets, without those of [`CurveOptions`].
#[derive(Clone, Copy, Debug)]
struct OfTargets;

impl Selection for OfTargets {
    fn has(key: &str) -> bool {
        let of_tone = ["brightness", "colour", "theta", "scene_statistics"];
        key.strip_prefix("tone.").is_some_and(|name| of_tone.contains(&name))
            || ["light", "white_balance", "invert_masks"].contains(&key)
    }
}

impl ApplyArgs {
    /// The settings of the command line; `curve`: with another curve.
    fn config(&self, curve: Option<&CurveChoice>) -> Result<TrainConfig> {
        let mut tone = self.tone.clone();
        if let Some(curve) = curve {
            (tone.curve, tone.profile) = (Some(curve.clone()), None);
        }
        let is_auto = tone.profile.is_none()
            && tone.curve.as_ref().is_none_or(|curve| *curve == Tone::Auto.into());
        let mut requested = RequestedSettings::default();
        tone.push(&mut requested.options)?;
        self.settings.push(&mut requested.options)?;
        let mut config = requested.settings(None)?.config()?;
        if is_auto && self.settings.get("tone.colour").is_none() && !Dataset::is_at(&self.input) {
            // References of single photographs are less saturated than those of scenes.
            config.tone.colour = 0.0;
        }
        config.tone.check()?;
        Ok(config)
    }
}

/// Applies the curve and prints the measurements.
pub fn run(args: &ApplyArgs) -> anyhow::Result<()> {
    let output = apply(args)?;
    if args.json {
        return Ok(print(serde_json::to_string_pretty(&output)?)?);
    }
    print(text(&output))?;
    let images =
        args.out.as_ref().map(|out| format!("{} images to {}", output.views.len(), out.display()));
    let wrote: Vec<String> = images
        .into_iter()
        .chain(args.report.iter().map(|page| page.display().to_string()))
        .collect();
    let next = match Dataset::is_at(&args.input) {
        true => {
            let curve = quoted(&args.tone.name());
            format!("nightsplat train {} --out run --curve {curve}", word(&args.input))
        }
        false => format!("nightsplat pose {} --out scene", word(&args.input)),
    };
    finish(&wrote.join(", "), &next);
    Ok(())
}

fn text(output: &ToneOutput) -> String {
    let remarks: String = output
        .remarks
        .iter()
        .map(|remark| wrapped(&format!("note: {}", one_line(remark)), 6))
        .collect();
    let reason = output.exposure.as_ref().map(|exposure| wrapped(&exposure.reason(), 0));
    let label = output.with_reference.as_deref().map(eval::with_reference);
    let label = label.map(|line| line + "\n").unwrap_or_default();
    reason.unwrap_or_default() + &table(output).text() + &remarks + &label
}

/// Maps every photograph, writes it to `args.out` under its own name, and shows how far it is.
pub fn apply(args: &ApplyArgs) -> Result<ToneOutput> {
    let named = |curve: &CurveChoice| Ok((curve.to_string(), args.config(Some(curve))?));
    let request = ToneRequest {
        input: &args.input,
        reference: args.reference.as_deref(),
        out: args.out.as_deref().map(|out| (out, args.format.extension())),
        report: args.report.as_deref(),
        curve: (args.tone.name(), args.config(None)?),
        compared: args.compare.iter().map(named).collect::<Result<_>>()?,
    };
    let bar = progress_bar(0);
    let follow = |progress: ToneProgress<'_>| {
        match progress {
            ToneProgress::Next { name, done, all } => {
                bar.set_length(all as u64);
                bar.set_position(done as u64);
                bar.set_message(one_line(name).into_owned());
            }
            ToneProgress::Mapped(image, target) => args.format.save(image, target)?,
            ToneProgress::Skipped(error) => {
                bar.suspend(|| tracing::warn!("skipped: {error}"));
            }
            // What follows may warn.
            ToneProgress::Finished => bar.finish_and_clear(),
        }
        Ok(())
    };
    let open = || driver::open(&args.device.clone().unwrap_or_default());
    toned::apply(&request, &open, &follow)
}
