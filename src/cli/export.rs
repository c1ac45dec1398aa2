//! `nightsplat export`: writes the model of a run in other formats.

use std::path::{Path, PathBuf};

use anyhow::Result;
use nightsplat_core::camera::frame::relative_to;
use nightsplat_models::export::streamed::{self, Division, MAX_LEVELS, Written};
use nightsplat_models::export::{Format, spz};
use nightsplat_photographs::tree::check_writable;

use super::{finish, opener, word, words};
use crate::Error;
use crate::gpu::DeviceChoice;
use crate::results::finished_run::is_model;
use crate::results::run_export::up::{Turn, Up};
use crate::results::run_export::{ExportOptions, Exported};
use crate::train::CacheSize;

/// Write a run's model in the format of a viewer, as bright as it was trained to be.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct ExportArgs {
    /// Run directory, or a model: PLY, SPZ or SOG
    pub run: PathBuf,
    /// Format [default: that of the ending of --out]
    #[arg(long, value_name = "FORMAT", value_parser = words::formats(), required_unless_present = "out")]
    pub format: Option<Format>,
    /// File to write or replace [default: model.FORMAT in the run]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// The dataset's up direction: x, y, z, -x, -y, -z or X,Y,Z. It becomes +Y in GLB, USD and SPZ, -Y in PLY and
    /// SOG; none keeps the dataset's axes [default: the run's for GLB, USD, SPZ and html; none for PLY and SOG]
    #[arg(long, value_name = "DIRECTION", allow_hyphen_values = true)]
    pub up: Option<Up>,
    /// Colours in linear light, for engines: that of the photographs, raised to the brightness of the target by the
    /// stops that the file states. For ply, glb, usda and usdz, whose numbers are floats
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
    /// The largest file, such as 8M: coefficients of colours are left out, then levels of detail, until it fits; in
    /// html, photographs shrink, and coefficients are rounded first. Not for ply and streamed-sog
    #[arg(long, value_name = "SIZE")]
    pub max_size: Option<CacheSize>,
    /// For html: number of views to start from, with photographs
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub views: usize,
    /// For html: the title of the page and of links to it [default: the dataset's name]
    #[arg(long, value_name = "TITLE")]
    pub title: Option<String>,
    /// For html: a sentence below the title, and below that of links
    #[arg(long, value_name = "TEXT")]
    pub text: Option<String>,
    /// For html: the address at which you publish the page
    ///
    /// The poster is then written beside the page, with the ending jpg, for you to publish with it, and links to the
    /// page show it. Services that show links fetch a picture from its own address and read none from within a page (a
    /// data URI): without this option they show title and text only.
    #[arg(long, value_name = "ADDRESS")]
    pub url: Option<String>,
    /// For html and --linear: dataset, if it moved since training [default: the run's]
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: the run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat export run --format html             run/model.html: a viewer with photographs
  nightsplat export run --format html --max-size 8M --title 'Our attic'
  nightsplat export run --out a.spz               a tenth of the size, eight bits per number
  nightsplat export run --format glb              glTF: KHR_gaussian_splatting
  nightsplat export run --format usda             OpenUSD 26.03; usdz is its package
  nightsplat export run --format streamed-sog     chunks and levels, for large scenes";

/// Writes the file.
pub fn run(args: &ExportArgs) -> Result<()> {
    let written = write(args)?;
    let out = word(&written.path);
    let next = match format(args)? {
        Format::Html => format!("open {out} in a browser"),
        Format::Usda | Format::Usdz => {
            format!("open {out} in usdview or an engine with OpenUSD 26.03")
        }
        Format::Spz(_) | Format::Sog | Format::Glb => {
            format!("open {out} in a viewer of Gaussian splats")
        }
        Format::StreamedSog => format!("serve {out} and open its {} in a viewer", streamed::INDEX),
        Format::Ply => format!("open {out} in a viewer of 3DGS models"),
    };
    finish(&line(&args.run, &written), &next);
    Ok(())
}

/// Writes the file without a message.
pub(super) fn write(args: &ExportArgs) -> crate::Result<Exported> {
    let format = format(args)?;
    if let Some(out) = &args.out {
        check_writable(out)?;
    }
    check_levels(args, format)?;
    check_linear(args, format)?;
    check_page(args, format)?;
    let options = ExportOptions {
        source: &args.run,
        format: match format {
            Format::Spz(_) if args.spz == 3 => Format::Spz(spz::Version::V3),
            format => format,
        },
        out: args.out.as_deref(),
        up: args.up,
        linear: args.linear,
        level: args.level,
        division: Division { levels: args.levels, chunk: args.chunk },
        max_size: args.max_size.map(|CacheSize(bytes)| bytes),
        views: args.views,
        title: args.title.as_deref(),
        text: args.text.as_deref(),
        address: args.url.as_deref(),
        dataset: args.dataset.as_deref(),
        opener: opener(args.device.as_ref()),
    };
    options.write()
}

/// A line on the contents of the file.
fn line(source: &Path, exported: &Exported) -> String {
    let Exported { path, count, fitted, streamed, origin, turn } = exported;
    let turn = turn.as_ref().map(|Turn { angle, up, axis, .. }| {
        let [x, y, z] = up.to_array().map(|part| format!("{:.3}", part + 0.0));
        let angle = angle.to_degrees();
        format!("; turned by {angle:.1} degrees: ({x}, {y}, {z}) of the dataset is {axis}, up")
    });
    let (shown, turn, kib) =
        (path.display(), turn.unwrap_or_default(), size_of(path).div_ceil(1024));
    if let Some(Written { counts, chunks }) = streamed {
        let numbers: Vec<String> = counts.iter().map(ToString::to_string).collect();
        let (levels, numbers) = (counts.len(), numbers.join(", "));
        return format!(
            "{shown}: {levels} levels of {numbers} Gaussians in {chunks} chunks, {kib} KiB{turn}"
        );
    }
    let brightness = if is_model(source) { "" } else { ", as bright as their targets" };
    let relative = relative_to(*origin).map(|line| format!("; {line}")).unwrap_or_default();
    format!("{shown}: {count} Gaussians in {kib} KiB{brightness}{fitted}{turn}{relative}")
}

/// The bytes of a file, or of the files in a folder.
fn size_of(path: &Path) -> u64 {
    let entries = std::fs::read_dir(path).into_iter().flatten().flatten();
    match std::fs::metadata(path) {
        Ok(file) if file.is_dir() => entries.map(|entry| size_of(&entry.path())).sum(),
        Ok(file) => file.len(),
        Err(_) => 0,
    }
}

/// The format: the given one, which must agree with the ending of the output file, or else that of the ending.
fn format(args: &ExportArgs) -> crate::Result<Format> {
    let out = args.out.as_deref().unwrap_or(Path::new(""));
    let ending = out.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let of_ending = Format::ALL.into_iter().find(|format| format.name() == ending);
    let out = out.display();
    let problem = match (args.format, of_ending) {
        (Some(format), Some(other)) if format.name() != other.name() => format!(
            "--out {out} is a file of --format {}, not of --format {}; change either",
            other.name(),
            format.name()
        ),
        (Some(format), _) | (None, Some(format)) => return Ok(format),
        (None, None) => {
            let names = Format::ALL.map(Format::name).join(", ");
            format!("--out {out} has the ending of no format; pass --format: {names}")
        }
    };
    Err(Error::Usage(problem))
}

/// Refuses options of levels that the format does not have.
fn check_levels(args: &ExportArgs, format: Format) -> crate::Result<()> {
    let is_streamed = format == Format::StreamedSog;
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

/// Refuses what only pages have, and a size of what has a layout of its own.
fn check_page(args: &ExportArgs, format: Format) -> crate::Result<()> {
    let is_sized = !matches!(format, Format::Ply | Format::StreamedSog);
    let has_page_options = args.title.is_some() || args.text.is_some() || args.url.is_some();
    let problem = if args.max_size.is_some() && !is_sized {
        "--max-size is not of --format ply and streamed-sog; pass --level"
    } else if has_page_options && format != Format::Html {
        "--title, --text and --url are of --format html"
    } else if args.url.as_ref().is_some_and(|url| !url.starts_with("http")) {
        "--url is an address such as https://example.org/room/"
    } else {
        return Ok(());
    };
    Err(Error::Usage(problem.to_owned()))
}

/// Refuses linear light for formats of eight bits, which would show banding, and for model files, whose tone curve is
/// unknown.
fn check_linear(args: &ExportArgs, format: Format) -> crate::Result<()> {
    let problem = match format {
        _ if !args.linear => return Ok(()),
        Format::Spz(_) | Format::Sog | Format::StreamedSog | Format::Html => {
            "--linear needs floats; export to ply, glb or usda".to_owned()
        }
        _ if is_model(&args.run) => {
            let run = args.run.display();
            format!(
                "--linear inverts the tone curve of a run, and {run} is a model file; pass the run directory"
            )
        }
        Format::Ply | Format::Glb | Format::Usda | Format::Usdz => return Ok(()),
    };
    Err(Error::Usage(problem))
}
