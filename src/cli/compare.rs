//! `nightsplat compare`: runs on one dataset, and renders of other programs, side by side.

use std::path::PathBuf;

use anyhow::Result;
use nightsplat_core::output::{one_line, write_whole};
use nightsplat_photographs::tree::check_writable;

use super::eval::LpipsRange;
use super::tell::wrapped;
use super::{finish, opener, print, word};
use crate::Error;
use crate::gpu::DeviceChoice;
use crate::results::comparison::{CompareOptions, NamedRenders, RunComparison};

/// Compare runs or models on the test views of one dataset.
///
/// Renders the test views of each and scores them against the same images: the references or, without any, the targets
/// of the first run; a model file states the tone curve and the size of its run. Prints a row per run and, for every
/// view, the PSNR of the first run and the gains of the others. The page adds the settings that differ, and renders
/// side by side, the most different views first.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct CompareArgs {
    /// Run directories and models; the first is the one that others are compared with
    #[arg(required = true)]
    pub runs: Vec<PathBuf>,
    /// Renders of another program, scored as another row: a folder with a picture of every test view, of its size and
    /// under its name; repeatable
    #[arg(long, value_name = "NAME=DIR")]
    pub renders: Vec<NamedRenders>,
    /// Write a page
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
    /// Print JSON instead of tables
    #[arg(long)]
    pub json: bool,
    /// Dataset of models without a run, or if it moved since training [default: the runs']
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Score models that do not state their tone curve against the dark photographs, even if they are brighter
    #[arg(long)]
    pub photographs: bool,
    /// Add LPIPS, with AlexNet or VGG-16 weights as safetensors (scripts/lpips-weights.py writes them)
    #[arg(long, value_name = "WEIGHTS")]
    pub lpips: Option<PathBuf>,
    /// Input range of the LPIPS network; scores of different ranges or networks do not compare
    #[arg(long, value_name = "RANGE", value_enum, default_value_t, requires = "lpips")]
    pub lpips_range: LpipsRange,
    /// Vulkan device: its index, part of its name, uuid:..., pci:... or cpu [default: each run's]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceChoice>,
}

const EXAMPLES: &str = "Examples:
  nightsplat compare run1 run2 --report compare.html
  nightsplat compare run clean.ply                        a run and its edited model
  nightsplat compare run --renders gsplat=other/renders   a run and another program's renders";

/// Compares the runs.
pub fn run(args: &CompareArgs) -> Result<()> {
    if args.runs.len() + args.renders.len() < 2 {
        let problem = "compare takes two or more: <RUNS>..., or a run and --renders NAME=DIR";
        return Err(Error::Usage(problem.to_owned()).into());
    }
    args.report.iter().try_for_each(|path| check_writable(path))?;
    let options = CompareOptions {
        renders: &args.renders,
        dataset: args.dataset.as_deref(),
        opener: opener(args.device.as_ref()),
        lpips: args.lpips.as_deref().map(|weights| (weights, args.lpips_range.into())),
        with_pictures: args.report.is_some(),
        photographs: args.photographs,
    };
    let comparison = RunComparison::new(&args.runs, &options)?;
    let mut wrote = String::new();
    if let Some(path) = &args.report {
        write_whole(path, comparison.html().as_bytes())?;
        wrote = path.display().to_string();
    }
    if args.json {
        return Ok(print(format_args!("{:#}", comparison.json()))?);
    }
    let tables = [comparison.means(), comparison.views()].map(|scores| scores.text());
    print(tables.join("\n") + "\n")?;
    for [key, values] in comparison.settings() {
        print(one_line(&format!("{key}: {values}")))?;
    }
    if let Some(label) = comparison.label() {
        print(wrapped(&label, 0))?;
    }
    let next = match &args.report {
        Some(path) => format!("open {} in a browser", word(path)),
        None => {
            let runs: Vec<String> = args.runs.iter().map(|run| word(run)).collect();
            let dataset =
                args.dataset.as_ref().map(|folder| format!(" --dataset {}", word(folder)));
            let dataset = dataset.unwrap_or_default();
            format!("nightsplat compare {}{dataset} --report compare.html", runs.join(" "))
        }
    };
    finish(&wrote, &next);
    Ok(())
}
