//! `nightsplat tone`: apply a tone curve to photographs.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{ImageFormat, progress_bar};
use crate::gpu::{Buffer, DeviceChoice, Gpu};
use crate::image::Image;
use crate::kernels::ToneParameters;
use crate::pseudo_gt::PseudoGt;
use crate::tone::{CurveChoice, ToneSettings};
use crate::{Error, Result};

/// Apply a tone curve to a photograph or to a folder of them.
#[derive(Clone, Debug, clap::Args)]
pub struct ToneArgs {
    /// A photograph (PNG, JPEG or EXR), or a folder of them.
    pub input: PathBuf,
    /// The curve: a name that `nightsplat curves` lists, or a .toml, .csv or .cube file
    #[arg(long, value_name = "NAME|FILE")]
    pub curve: CurveChoice,
    /// The folder to write to; made if it does not exist. Images of the same names are replaced.
    #[arg(long)]
    pub out: PathBuf,
    /// c of ASE and AP3: how much a brighter photograph raises the gain [default: 3 for ase, 1 for ap3].
    #[arg(long, value_name = "C")]
    pub gain: Option<f64>,
    /// The mean that the linear curve aims at.
    #[arg(long, default_value_t = ToneSettings::default().theta)]
    pub theta: f64,
    /// Print the statistics of every photograph as JSON.
    #[arg(long)]
    pub json: bool,
    /// The files to write: 8-bit PNG, or float EXR in linear light.
    #[arg(long, value_enum, default_value_t)]
    pub format: ImageFormat,
    /// The device, by a part of its name or by index [default: the best].
    #[arg(long, value_name = "NAME|INDEX")]
    pub device: Option<DeviceChoice>,
}

/// What `tone` tells of a photograph.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ToneReport {
    /// The 10th percentile of the luminance, plus 1e-6.
    pub p10: f32,
    /// The 90th percentile of the luminance, plus 1e-6.
    pub p90: f32,
    /// p10 / p90.
    pub r: f64,
    /// The black level that ASE and AP3 give a photograph with this r.
    pub delta0: f64,
    /// The mean of the luminance.
    pub mean_luminance: f32,
    /// The mean over all channels.
    pub mean: f32,
    /// The fraction of the mapped values, over all channels, that are 1.
    pub clipped_fraction: f64,
}

/// Applies the curve and prints what was measured, as a table or as JSON.
///
/// # Errors
/// As [`apply`], or standard output cannot be written to.
pub fn run(args: ToneArgs) -> Result<()> {
    let views = apply(&args)?;
    let mut text = String::new();
    if args.json {
        #[derive(Serialize)]
        struct Output {
            views: BTreeMap<String, ToneReport>,
        }
        let json = serde_json::to_string_pretty(&Output { views });
        text += &json.map_err(|error| Error::output("standard output", error.to_string()))?;
    } else {
        let width = views.keys().map(|name| name.chars().count()).max().unwrap_or(0).max(4);
        text +=
            &format!("{:width$}     p10     p90      r  delta0  mean Y    mean  clipped", "name");
        for (name, view) in &views {
            let ToneReport { p10, p90, r, delta0, mean_luminance, mean, clipped_fraction } = view;
            let clipped = 100.0 * clipped_fraction;
            text += &format!(
                "\n{name:width$}  {p10:.4}  {p90:.4}  {r:.3}  {delta0:.4}  {mean_luminance:.4}  {mean:.4}  {clipped:5.1} %"
            );
        }
    }
    writeln!(std::io::stdout().lock(), "{text}")
        .map_err(|error| Error::output("standard output", error.to_string()))
}

/// Maps every photograph and writes it to `args.out` under its own name; what was measured, by name.
///
/// A photograph of a folder that cannot be used is named in a warning and left out.
///
/// # Errors
/// [`Error::Usage`] for settings that make no sense; [`Error::Input`] where there is nothing to map or two photographs
/// would be written to one file; [`Error::Output`] where a file cannot be written or a photograph would be replaced;
/// those of the device.
pub fn apply(args: &ToneArgs) -> Result<BTreeMap<String, ToneReport>> {
    let mut settings = args.curve.settings()?;
    settings.theta = args.theta;
    settings.gain_c = args.gain.unwrap_or(settings.gain_c);
    settings.check()?;
    let photographs = photographs(&args.input)?;
    let targets = targets(&photographs, &args.out, args.format)?;
    std::fs::create_dir_all(&args.out)
        .map_err(|error| Error::output(&args.out, format!("cannot be made: {error}")))?;

    let mut mapper = Mapper::new(&Gpu::new(&args.device.clone().unwrap_or_default())?, settings)?;
    let progress = progress_bar(photographs.len());
    let mut views = BTreeMap::new();
    let mut unusable = None;
    for (photograph, (name, target)) in photographs.iter().zip(targets) {
        progress.set_message(name.clone());
        match mapper.map(photograph) {
            Ok((report, image)) => {
                args.format.save(&image, &target)?;
                views.insert(name, report);
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
    match unusable {
        Some(error) if views.is_empty() => Err(error),
        _ => Ok(views),
    }
}

/// The photographs of `input`: itself, or those of a folder by name.
fn photographs(input: &Path) -> Result<Vec<PathBuf>> {
    let unreadable =
        |error: std::io::Error| Error::input(input, format!("cannot be read: {error}"));
    if !std::fs::metadata(input).map_err(unreadable)?.is_dir() {
        return Ok(vec![input.to_owned()]);
    }
    let entries = std::fs::read_dir(input).map_err(unreadable)?;
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    let mut paths: Vec<PathBuf> = paths.collect::<std::io::Result<_>>().map_err(unreadable)?;
    paths.retain(|path| {
        let extension =
            path.extension().and_then(OsStr::to_str).unwrap_or_default().to_ascii_lowercase();
        ["png", "jpg", "jpeg", "exr"].contains(&extension.as_str()) && path.is_file()
    });
    paths.sort();
    if paths.is_empty() {
        return Err(Error::input(input, "holds no PNG, JPEG or EXR image"));
    }
    Ok(paths)
}

/// The name of every photograph and the file it is written to, all different and none of them a photograph.
fn targets(
    photographs: &[PathBuf],
    out: &Path,
    format: ImageFormat,
) -> Result<Vec<(String, PathBuf)>> {
    let extension = format.extension();
    let sources: Vec<_> = photographs.iter().filter_map(|path| path.canonicalize().ok()).collect();
    let mut seen = BTreeMap::new();
    let mut target = |photograph: &PathBuf| {
        let name = photograph.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let target = out.join(format!("{name}.{extension}"));
        if let Some(other) = seen.insert(name.clone(), photograph.clone()) {
            let problem =
                format!("would be written to the same file as {}; rename one", other.display());
            return Err(Error::input(photograph, problem));
        }
        if target.canonicalize().is_ok_and(|target| sources.contains(&target)) {
            return Err(Error::output(target, "is one of the photographs; choose another --out"));
        }
        Ok((name, target))
    };
    photographs.iter().map(&mut target).collect()
}

/// Maps photographs on the device, one at a time.
struct Mapper {
    gpu: Gpu,
    pseudo_gt: PseudoGt,
    parameters: Buffer<ToneParameters>,
}

impl Mapper {
    fn new(gpu: &Gpu, settings: ToneSettings) -> Result<Self> {
        Ok(Self {
            gpu: gpu.clone(),
            pseudo_gt: PseudoGt::new(gpu, &settings)?,
            parameters: gpu.uninit("tone parameters", 1)?,
        })
    }

    /// The photograph's statistics, and what the curve makes of it.
    fn map(&mut self, photograph: &Path) -> Result<(ToneReport, Image)> {
        let mut image = Image::load(photograph)?;
        let Image { width, height, .. } = image;
        let too_large = |error| match error {
            Error::BufferTooLarge { limit, device, .. } => {
                let problem = format!(
                    "{width}x{height} pixels exceed the {limit} bytes that {device} binds; resize it"
                );
                Error::input(photograph, problem)
            }
            error => error,
        };
        let source = self.gpu.buffer("photograph", &image.data).map_err(too_large)?;
        let mut target = self.gpu.uninit("pseudo-GT", source.len())?;
        self.gpu.run("tone", |pass| {
            self.pseudo_gt.statistics(pass, &source, [width, height], &mut self.parameters, 0)?;
            self.pseudo_gt.map(pass, &source, &self.parameters, 0, &mut target)
        })?;
        image.data = self.gpu.read(&target)?;
        let statistics = self.pseudo_gt.measured()?;
        let clipped = image.data.iter().filter(|&&value| value >= 1.0).count();
        let report = ToneReport {
            p10: statistics.p10,
            p90: statistics.p90,
            r: statistics.ratio(),
            delta0: self.pseudo_gt.settings().offset(statistics.ratio()),
            mean_luminance: statistics.mean_luminance,
            mean: statistics.mean,
            clipped_fraction: clipped as f64 / image.data.len() as f64,
        };
        Ok((report, image))
    }
}
