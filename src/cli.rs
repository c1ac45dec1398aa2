//! The command line: one file per subcommand.

use std::path::Path;

use anyhow::Result;
use clap::error::{ContextKind, ContextValue};
use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};

use crate::base::output::printable;
use crate::base::settings::Setting;
use crate::photographs::image::Image;
use crate::train::settings::setting;

pub mod bench;
pub mod check;
pub mod completions;
mod defaults;
pub mod demo;
pub mod diagnose;
pub mod doctor;
pub mod eval;
pub mod export;
mod finished_run;
pub mod man;
pub mod pose;
pub mod progress;
pub mod render;
mod signals;
pub mod sweep;
pub mod synth;
mod table;
pub mod tone;
pub mod train;

/// 3D Gaussian Splatting from dark photographs, on any Vulkan device.
#[derive(Debug, Parser)]
#[command(name = "nightsplat", version, max_term_width = 98, after_help = EXAMPLES)]
#[command(mut_subcommands = defaults::shown)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Say more on stderr: -v what is done, -vv how
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
}

const EXAMPLES: &str = "Start with:
  nightsplat demo                                   see it work, without any data
  nightsplat doctor                                 which devices there are
  nightsplat pose photos --out scene                find the cameras of photographs that have none
  nightsplat diagnose photos                        what they are, and what their model needs
  nightsplat train photos --out run                 train from a folder of dark photographs
  nightsplat eval run --save-images                 score it where there are references
  nightsplat render run --split all --out pictures  see the model from every camera
  nightsplat export run --to html                   a page with the splat to fly through
  nightsplat sweep photos --out sweep --curves all  train with every curve, and rank them
  nightsplat sweep photos --out s --table presets   what time and memory buy

For developers:
  check        hold every pass of a training step to its CPU reference, on this device
  synth        write a small dark set with known references
  completions  print what a shell completes
  man          write the man pages

Exit codes:
  0 done; 1 failed; 2 misuse; 3 data that cannot be used; 4 no device, or not enough memory;
  75 saved, run it again (train --max-minutes); 130 and 143 saved (SIGINT and SIGTERM)";

#[derive(Debug, Subcommand)]
enum Command {
    Train(Box<train::TrainArgs>),
    Diagnose(diagnose::DiagnoseArgs),
    Pose(pose::PoseArgs),
    Eval(eval::EvalArgs),
    Render(render::RenderArgs),
    Export(export::ExportArgs),
    Tone(tone::ToneArgs),
    Sweep(Box<sweep::SweepArgs>),
    #[command(hide = true)]
    Synth(synth::SynthArgs),
    Demo(demo::DemoArgs),
    Doctor(doctor::DoctorArgs),
    Bench(bench::BenchArgs),
    #[command(hide = true)]
    Check(Box<check::CheckArgs>),
    #[command(hide = true)]
    Completions(completions::CompletionsArgs),
    #[command(hide = true)]
    Man(man::ManArgs),
}

/// Commands that have another name now, and that name.
const RENAMED: [(&str, &str); 4] = [
    ("ablate", "sweep DATASET --out DIR --table parts"),
    ("tradeoff", "sweep DATASET --out DIR --table presets"),
    ("curves", "tone list"),
    ("fit", "tone fit"),
];

/// The new name of the command that a command line gives by its old one.
pub fn renamed(error: &clap::Error) -> Option<String> {
    let Some(ContextValue::String(name)) = error.get(ContextKind::InvalidSubcommand) else {
        return None;
    };
    let (old, new) = RENAMED.iter().find(|(old, _)| old == name)?;
    Some(format!("`nightsplat {old}` is now `nightsplat {new}`"))
}

impl Cli {
    /// The level of the log: 0 for warnings, 1 and 2 for more.
    pub fn verbosity(&self) -> u8 {
        self.verbose
    }

    /// Runs the subcommand.
    ///
    /// # Errors
    /// What stopped it, in one line.
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::Train(args) => train::run(&args),
            Command::Diagnose(args) => diagnose::run(&args),
            Command::Pose(args) => pose::run(&args),
            Command::Eval(args) => eval::run(&args),
            Command::Render(args) => render::run(&args),
            Command::Export(args) => export::run(&args),
            Command::Tone(args) => tone::run(&args),
            Command::Sweep(args) => sweep::run(&args),
            Command::Synth(args) => Ok(synth::run(args)?),
            Command::Demo(args) => demo::run(&args),
            Command::Doctor(args) => doctor::run(&args),
            Command::Bench(args) => bench::run(&args),
            Command::Check(args) => check::run(&args),
            Command::Completions(args) => completions::run(args),
            Command::Man(args) => Ok(man::run(&args)?),
        }
    }
}

/// What is said of an error, in one line: a setting by its key and by its option, where it has one.
pub fn message(error: &anyhow::Error) -> String {
    let message = format!("{error:#}");
    let Some(crate::Error::Setting { key, .. }) = error.downcast_ref() else { return message };
    match setting(key).and_then(Setting::option) {
        Some((option, _)) => message.replacen(key, &format!("{key} (--{option})"), 1),
        None => message,
    }
}

/// A message as it is printed, whatever the names in it hold.
pub fn in_one_line(message: &str) -> String {
    printable(&message.replace('\n', "\\n")).into_owned()
}

/// The picture files that a command writes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ImageFormat {
    /// 8 bits a channel, sRGB-encoded, clamped.
    #[default]
    Png,
    /// 16 bits a channel, sRGB-encoded, clamped.
    Png16,
    /// 32-bit float, linear light.
    Exr,
}

impl ImageFormat {
    /// The extension of its files.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Png | Self::Png16 => "png",
            Self::Exr => "exr",
        }
    }

    fn save(self, image: &Image, path: &Path) -> crate::Result<()> {
        match self {
            Self::Png => image.save_png8(path),
            Self::Png16 => image.save_png16(path),
            Self::Exr => image.save_exr(path),
        }
    }
}

/// A bar on standard error, shown only where that is a terminal.
fn progress_bar(len: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:32} {pos}/{len}  {msg}  {eta} left");
    ProgressBar::new(len as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_is_named_by_its_key_and_its_option() {
        let refused = |key: &str| {
            let (key, value, rule) = (key.to_owned(), "0".to_owned(), "at least 1".to_owned());
            message(&crate::Error::Setting { key, value, rule }.into())
        };
        assert_eq!(refused("steps"), "steps (--steps) is 0; it must be at least 1");
        assert_eq!(
            refused("density.control"),
            "density.control (--density) is 0; it must be at least 1"
        );
        assert_eq!(refused("stop.every"), "stop.every is 0; it must be at least 1");
    }
}

#[cfg(all(test, not(feature = "fit")))]
mod without_fit {
    use super::*;

    #[test]
    fn fit_says_which_feature_has_it() {
        let cli =
            Cli::try_parse_from(["nightsplat", "tone", "fit", "pairs", "--family", "ase"]).unwrap();
        let message = cli.run().unwrap_err().to_string();
        assert!(message.contains("feature `fit`"), "{message}");
    }
}
