//! `nightsplat export`: writes the model of a run in other formats.

mod tiles;
mod up;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::ValueEnum;
use glam::DVec3;

use super::{driver, finish, word};
use crate::base::output::{check_writable, is_same_file, write_whole};
use crate::camera::frame::relative_to;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::image::Image;
use crate::photographs::targets::{SceneTone, Targets};
use crate::photographs::tone::ToneCurve;
use crate::results::edit::fingerprint;
use crate::results::export::page::{Bookmark, Page, Picture, moved};
use crate::results::export::streamed::{self, Division, MAX_LEVELS, Tile, Written};
use crate::results::export::{Format, Provenance, spz};
use crate::results::finished_run::{FinishedRun, config_of_file, is_model, needs_photographs};
use crate::results::linear_light::linear_gaussians;
use crate::results::models;
use crate::splats::joined::Manifest;
use crate::splats::levels;
use crate::splats::render::RenderSettings;
use crate::splats::scene::{Facts, Gaussians, MAX_SH_DEGREE};
use crate::train::TrainConfig;
use crate::{Error, results::run};

pub use up::Up;

/// Write a run's model in the format of a viewer, as bright as it was trained to be.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct ExportArgs {
    /// Run directory, or a model: PLY, SPZ or SOG
    pub run: PathBuf,
    /// Format
    #[arg(long = "format", alias = "to", value_enum, value_name = "FORMAT")]
    pub to: To,
    /// File to write or replace [default: model.FORMAT in the run]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// The dataset's up direction: x, y, z, -x, -y, -z or X,Y,Z. It becomes +Y in GLB and SPZ, -Y in PLY and SOG;
    /// none keeps the dataset's axes [default: the run's for GLB, SPZ and html; none for PLY and SOG]
    #[arg(long, value_name = "DIRECTION", allow_hyphen_values = true)]
    pub up: Option<Up>,
    /// Colours in linear light, for engines: that of the photographs, raised to the brightness of the target by the
    /// stops that the file states. For ply and glb, whose numbers are floats
    #[arg(long)]
    pub linear: bool,
    /// Version of SPZ; more programs read 3
    #[arg(long, value_name = "3|4", default_value_t = 4, value_parser = clap::value_parser!(u8).range(3..=4))]
    pub spz: u8,
    /// Level of detail to write: 0 has all Gaussians, each further level half as many
    #[arg(long, value_name = "LEVEL", default_value_t = 0)]
    pub level: usize,
    /// For streamed-sog: number of levels of detail [default: until the coarsest is no larger than a chunk]
    #[arg(long, value_name = "N")]
    pub levels: Option<usize>,
    /// For streamed-sog: the most Gaussians of a chunk; levels of detail are made in cells of a quarter of it
    #[arg(long, value_name = "N", default_value_t = Division::default().chunk)]
    pub chunk: usize,
    /// For html: number of views to start from, with photographs
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub views: usize,
    /// For html and --linear: dataset, if it moved since training [default: the run's]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat export run --format html             run/model.html: a viewer with photographs
  nightsplat export run --format spz --out a.spz  a tenth of the size, eight bits per number
  nightsplat export run --format glb              glTF with KHR_gaussian_splatting, at full precision
  nightsplat export run --format streamed-sog     run/model.streamed-sog: levels of detail, for large scenes";

/// The formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum To {
    /// The layout of 3DGS, with its origin in the header
    Ply,
    /// A tenth of the size, eight bits per number
    Spz,
    /// glTF with `KHR_gaussian_splatting`
    Glb,
    /// A fifteenth of the size, by `PlayCanvas`
    Sog,
    /// A folder of SOG in chunks at several levels of detail, which viewers of `PlayCanvas` load as needed
    StreamedSog,
    /// A self-contained page with a viewer
    Html,
}

impl To {
    const fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Spz => "spz",
            Self::Glb => "glb",
            Self::Sog => "sog",
            Self::StreamedSog => "streamed-sog",
            Self::Html => "html",
        }
    }
}

/// Writes the file.
pub fn run(args: &ExportArgs) -> Result<()> {
    let (out, wrote) = write(args)?;
    let out = word(&out);
    let next = match args.to {
        To::Html => format!("open {out} in a browser"),
        To::Spz | To::Sog | To::Glb => format!("open {out} in a viewer of Gaussian splats"),
        To::StreamedSog => format!("serve {out} and open its {} in a viewer", streamed::INDEX),
        To::Ply => format!("open {out} in a viewer of 3DGS models"),
    };
    finish(&wrote, &next)
}

/// Writes the file, and returns its path and a line on its contents.
pub(super) fn write(args: &ExportArgs) -> Result<(PathBuf, String)> {
    check_ending(args)?;
    check_levels(args)?;
    check_linear(args)?;
    let joined = if is_model(&args.run) { None } else { Manifest::of_scene(&args.run)? };
    if let (To::StreamedSog, Some(manifest)) = (args.to, &joined) {
        return Ok(tiles::write(args, manifest)?);
    }
    let (gaussians, facts, config) = opened(args)?;
    let (gaussians, facts) =
        if args.linear { linear(args, &config, gaussians, facts)? } else { (gaussians, facts) };
    let own = own_file(args);
    let out = args.out.as_ref().unwrap_or(&own);
    if args.to == To::Ply && is_same_file(out, &own) {
        let problem = "is the model itself; name another file with --out";
        return Err(Error::output(out, problem).into());
    }
    if let Some(step) = run::stopped_at(&args.run) {
        tracing::warn!("{}: stopped at step {step} of {}", args.run.display(), config.steps);
    }
    if has_networks(&config) {
        tracing::warn!("{}: the networks are not exported, only the Gaussians", args.run.display());
    }
    let (rotation, turned) = args.rotation(&config).unwrap_or_default();
    let mut gaussians = up::turned(gaussians, rotation);
    let division = Division { levels: args.levels, chunk: args.chunk };
    if args.level > 0 {
        let whole = || vec![gaussians.count];
        let tiles = joined.map_or_else(whole, |joined| joined.counts());
        gaussians = levels::level(&gaussians, &tiles, division.cell(), args.level);
    }
    let provenance = Provenance { rotation, facts, ..provenance(args, &config) };
    let format = match args.to {
        To::Ply => Some(Format::Ply),
        To::Spz if args.spz == 3 => Some(Format::Spz(spz::Version::V3)),
        To::Spz => Some(Format::Spz(spz::Version::V4)),
        To::Glb => Some(Format::Glb),
        To::Sog => Some(Format::Sog),
        To::StreamedSog | To::Html => None,
    };
    match format {
        // Viewers with a fixed layout expect the coefficients of degree 3.
        Some(Format::Ply) => {
            let padded = gaussians.with_sh_degree(MAX_SH_DEGREE);
            Format::Ply.write(&padded, &provenance, out)?;
        }
        Some(format) => format.write(&gaussians, &provenance, out)?,
        None if args.to == To::StreamedSog => {
            let tile = Tile::whole(&args.run, &gaussians);
            let written = streamed::write(out, &[tile], &provenance, division)?;
            return Ok((out.clone(), streamed_line(out, &written, &turned)));
        }
        None => write_whole(out, page(args, &config, &gaussians, provenance)?.as_bytes())?,
    }
    let (shown, count) = (out.display().to_string(), gaussians.count);
    let kib = std::fs::metadata(out).map_or(0, |file| file.len()).div_ceil(1024);
    let brightness = if is_model(&args.run) { "" } else { ", as bright as their targets" };
    let relative = relative_to(gaussians.origin).map(|line| format!("; {line}"));
    let relative = relative.unwrap_or_default();
    let wrote = format!("{shown}: {count} Gaussians in {kib} KiB{brightness}{turned}{relative}");
    Ok((out.clone(), wrote))
}

/// Refuses an output file whose ending is that of another format, and one that cannot be written.
fn check_ending(args: &ExportArgs) -> crate::Result<()> {
    let Some(out) = &args.out else { return Ok(()) };
    let ending = out.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let formats = To::value_variants();
    if let Some(other) = formats.iter().find(|to| to.extension() == ending && **to != args.to) {
        let (out, other, own) = (out.display(), other.extension(), args.to.extension());
        let problem = format!(
            "--out {out} is a file of --format {other}, not of --format {own}; change either"
        );
        return Err(Error::Usage(problem));
    }
    check_writable(out)
}

/// Refuses options of levels that the format does not have.
fn check_levels(args: &ExportArgs) -> crate::Result<()> {
    let is_streamed = args.to == To::StreamedSog;
    let problem = match args {
        ExportArgs { levels: Some(_), .. } if !is_streamed => {
            "--levels is of --format streamed-sog; pass --level for one level of another format"
                .to_owned()
        }
        ExportArgs { level: 1.., .. } if is_streamed => {
            "--level is of formats with one level; pass --levels for the number of levels"
                .to_owned()
        }
        ExportArgs { levels: Some(levels), .. } if !(1..=MAX_LEVELS).contains(levels) => {
            format!("--levels {levels} cannot be made; ask for 1 to {MAX_LEVELS}")
        }
        ExportArgs { level, .. } if *level >= MAX_LEVELS => {
            format!("--level {level} cannot be made; the coarsest is {}", MAX_LEVELS - 1)
        }
        ExportArgs { chunk: 0, .. } => "--chunk 0 holds no Gaussian; pass at least 1".to_owned(),
        _ => return Ok(()),
    };
    Err(Error::Usage(problem))
}

/// Refuses linear light for formats of eight bits, which would show banding, and for model files, whose tone curve is
/// unknown.
fn check_linear(args: &ExportArgs) -> crate::Result<()> {
    let problem = match args.to {
        _ if !args.linear => return Ok(()),
        To::Spz | To::Sog | To::StreamedSog | To::Html => {
            "--linear needs floats; export to ply or glb".to_owned()
        }
        _ if is_model(&args.run) => {
            let run = args.run.display();
            format!(
                "--linear inverts the tone curve of a run, and {run} is a model file; pass the run directory"
            )
        }
        To::Ply | To::Glb => return Ok(()),
    };
    Err(Error::Usage(problem))
}

/// A line on the contents of a streamed SOG.
fn streamed_line(out: &Path, Written { counts, chunks }: &Written, turned: &str) -> String {
    let (out, kib) = (out.display(), size_of(out).div_ceil(1024));
    let numbers: Vec<String> = counts.iter().map(ToString::to_string).collect();
    let (levels, numbers) = (counts.len(), numbers.join(", "));
    format!("{out}: {levels} levels of {numbers} Gaussians in {chunks} chunks, {kib} KiB{turned}")
}

/// The bytes of the files in the folders of a folder.
fn size_of(folder: &Path) -> u64 {
    let size = |entry: std::fs::DirEntry| match entry.metadata() {
        Ok(found) if found.is_dir() => size_of(&entry.path()),
        Ok(found) => found.len(),
        Err(_) => 0,
    };
    std::fs::read_dir(folder).map_or(0, |entries| entries.flatten().map(size).sum())
}

/// The model in linear light, and the facts that state it.
fn linear(
    args: &ExportArgs,
    config: &TrainConfig,
    gaussians: Gaussians,
    facts: Facts,
) -> crate::Result<(Gaussians, Facts)> {
    let inverse = scene_tone(args, config)?.inverse_of_scene()?;
    let stops = inverse.stops_to_target();
    let (linear, clipped) = linear_gaussians(&gaussians, &inverse, stops);
    if clipped > 0 {
        let count = gaussians.count;
        tracing::warn!(
            "{clipped} of {count} Gaussians are as bright as the tone curve gets in some direction: their light is \
             at least what is written"
        );
    }
    Ok((linear, Facts { linear: Some(stops as f32), law: None, ..facts }))
}

/// The curves of the photographs of a run.
fn scene_tone(args: &ExportArgs, config: &TrainConfig) -> crate::Result<SceneTone> {
    let mut config = config.clone();
    if let Some(dataset) = &args.dataset {
        config.move_dataset(dataset);
    }
    let dataset = Dataset::load(&config.dataset, &config.load_options())?;
    SceneTone::measure(&config.tone, &dataset)
}

/// The model as stored, what is stated of it, and its settings.
fn opened(args: &ExportArgs) -> crate::Result<(Gaussians, Facts, TrainConfig)> {
    let from = &args.run;
    if !is_model(from) {
        let config = run::load_config(from)?;
        let (gaussians, facts) = models::read(from)?;
        return Ok((gaussians, facts, config));
    }
    if args.to == To::Html && args.dataset.is_none() {
        return Err(needs_photographs(from));
    }
    let (gaussians, facts) = models::read(from)?;
    let config = config_of_file(&gaussians, &facts, args.dataset.as_deref());
    Ok((gaussians, facts, config))
}

/// The default output file.
fn own_file(args: &ExportArgs) -> PathBuf {
    let (from, extension) = (&args.run, args.to.extension());
    match is_model(from) {
        true => from.with_extension(extension),
        false => from.join(format!("model.{extension}")),
    }
}

fn has_networks(config: &TrainConfig) -> bool {
    config.model.denoiser || config.model.tonemapper
}

fn provenance(args: &ExportArgs, config: &TrainConfig) -> Provenance {
    let dataset = config.dataset.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if is_model(&args.run) {
        return Provenance { dataset, ..Provenance::default() };
    }
    let gain = run::load_metrics(&args.run)[run::TARGET_EXPOSURE]["model_gain"].as_f64();
    let exposure =
        gain.map(|gain| format!("{gain:.2} times that of its photographs, before the curve"));
    Provenance {
        dataset,
        curve: config.tone.curve.to_string(),
        exposure: exposure.unwrap_or_else(|| "that of its targets".to_owned()),
        ..Provenance::default()
    }
}

/// The page, with bookmarks of test views, or of all views if there are none. Its viewer has a pinhole camera:
/// photographs of a fisheye are undistorted and cropped to 60 degrees off the axis.
fn page(
    args: &ExportArgs,
    config: &TrainConfig,
    gaussians: &Gaussians,
    provenance: Provenance,
) -> Result<String> {
    let mut frame = config.frame.unwrap_or_default();
    let title = format!("{} by nightsplat", provenance.dataset);
    let up = args.up(config);
    let (bookmarks, up) = if has_networks(config) {
        let FinishedRun { gpu, config, mut model_renderer, dataset, .. } = FinishedRun::open_with(
            &args.run,
            args.dataset.as_deref(),
            &driver::opener(args.device.as_ref()),
            |own| {
                own.undistort = true;
            },
        )?;
        let targets = targets(&config, &dataset, || Ok(gpu.clone()))?;
        let bookmarks = bookmarks(args, gaussians.origin, &dataset, targets, |view| {
            let networks = model_renderer.render(view)?.output().clone();
            Ok(Some(("model with its networks".to_owned(), networks)))
        })?;
        (bookmarks, up.unwrap_or_else(|| dataset.up()))
    } else {
        let mut config = config.clone();
        if let Some(dataset) = &args.dataset {
            config.move_dataset(dataset);
        }
        let mut options = config.load_options();
        options.load_low_test = true;
        options.undistort = true;
        let dataset = Dataset::load(&config.dataset, &options)?;
        if is_model(&args.run) {
            frame = dataset.frame();
        }
        let device = || match &args.device {
            Some(device) => driver::open(device),
            None => driver::open(&config.device.parse()?),
        };
        let targets = targets(&config, &dataset, device)?;
        let bookmarks = bookmarks(args, gaussians.origin, &dataset, targets, |_| Ok(None))?;
        (bookmarks, up.unwrap_or_else(|| dataset.up()))
    };
    let near = provenance.facts.near.or(config.facts(&frame).near);
    let near = near.unwrap_or_else(|| RenderSettings::default().near).into();
    let (origin, fingerprint) = (gaussians.origin, Some(fingerprint(gaussians)));
    let lamp = if is_model(&args.run) { None } else { run::load_lamp(&args.run)? };
    let gaussians = Some(gaussians);
    let page =
        Page { title, gaussians, provenance, bookmarks, origin, fingerprint, near, up, lamp };
    Ok(page.html()?)
}

/// What makes the targets of views that have a photograph and no reference image, where there are such views and a
/// curve. Without a device the page has no targets.
fn targets(
    config: &TrainConfig,
    dataset: &Dataset,
    gpu: impl FnOnce() -> crate::Result<Gpu>,
) -> crate::Result<Option<Targets>> {
    let lacks = |view: &View| view.has_photograph() && !view.has_reference();
    if config.tone.curve == ToneCurve::None || !dataset.views.iter().any(lacks) {
        return Ok(None);
    }
    match gpu() {
        Ok(gpu) => Targets::new(&gpu, &config.tone, dataset).map(Some),
        Err(error) => {
            tracing::warn!("the page has no targets to compare with: {error}");
            Ok(None)
        }
    }
}

fn bookmarks(
    args: &ExportArgs,
    origin: DVec3,
    dataset: &Dataset,
    targets: Option<Targets>,
    mut rendered: impl FnMut(&View) -> crate::Result<Option<(String, Image)>>,
) -> crate::Result<Vec<Bookmark>> {
    let mut views: Vec<&View> = dataset.test_views().collect();
    if views.is_empty() {
        views = dataset.views.iter().collect();
    }
    let (all, count) = (views.len(), args.views.clamp(1, views.len().max(1)));
    let bookmark = |place: usize| {
        let view = views[place * all / count];
        let lit = match (view.loaded_reference()?, &targets) {
            (Some(image), _) => Some(("reference".to_owned(), image.into_owned())),
            (None, Some(targets)) => {
                targets.target(view)?.map(|image| ("target".to_owned(), image))
            }
            (None, None) => None,
        };
        let photograph = view.loaded()?.map(|own| ("photograph".to_owned(), own.into_owned()));
        let pictures = [photograph, lit, rendered(view)?];
        // A mirrored photograph is of a mirrored world, which the page shows as it is.
        let turned = |(label, image): (String, Image)| {
            (label, Picture::Embedded(image.turned(view.orientation.turn())))
        };
        Ok(Bookmark {
            name: view.name.clone(),
            camera: moved(&view.upright_camera(), origin),
            pictures: pictures.into_iter().flatten().map(turned).collect(),
        })
    };
    (0..count).map(bookmark).collect()
}
