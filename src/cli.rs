//! The command line: one file per subcommand.

use std::ffi::OsString;
use std::fmt;
use std::path::Path;

use anyhow::Result;
use clap::{FromArgMatches, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use nightsplat_core::output::in_a_line;
pub use nightsplat_core::output::one_line;
use nightsplat_core::settings::Setting;
use nightsplat_photographs::image::{Image, ImageFile};
use tracing::field::Field;
use tracing_subscriber::fmt::format::Writer;

use crate::driver;
use crate::gpu::DeviceChoice;
use crate::results::finished_run::Opener;
use crate::train::settings::setting;

pub mod bench;
pub mod blocks;
pub mod check;
mod child;
pub mod compare;
pub mod completions;
pub mod demo;
pub mod diagnose;
pub mod doctor;
pub mod edit;
pub mod eval;
pub mod export;
mod help;
mod hints;
pub mod make;
pub mod man;
mod phases;
pub mod pose;
pub mod progress;
pub mod render;
mod settings;
mod signals;
mod stopped;
pub mod sweep;
pub mod synth;
mod tell;
pub mod tone;
pub mod train;
pub mod vary;
pub mod view;
mod words;

pub use hints::hint;
pub use phases::Phases;
pub use signals::report_long_files;
pub use stopped::ending;
pub use tell::tell_on_stderr;
use tell::{print, tell};

/// 3D Gaussian Splatting from dark photographs, on any Vulkan device.
#[derive(Debug, Parser)]
#[command(
    name = "nightsplat",
    version,
    max_term_width = 98,
    override_usage = "nightsplat PHOTOS\n       nightsplat [OPTIONS] <COMMAND>",
    after_help = EXAMPLES
)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Log more to stderr, of a training also the seconds of its phases; -vv for debugging
    #[arg(short, long, global = true, action = clap::ArgAction::Count, display_order = 998)]
    verbose: u8,
}

const EXAMPLES: &str = "Start with:
  nightsplat photos                                 from a folder of dark photographs to a page to share
  nightsplat demo                                   see it work, without any data
  nightsplat doctor                                 which devices there are
  nightsplat pose photos --out scene                find the cameras of photographs that have none
  nightsplat diagnose photos                        what they are, and what their model needs
  nightsplat train photos --out run                 train from a folder of dark photographs
  nightsplat eval run --save-images                 score it where there are references
  nightsplat compare run1 run2 --report page.html   runs side by side
  nightsplat render run --split all --out pictures  see the model from every camera
  nightsplat export run --format html               a page with the splat to fly through
  nightsplat view run                               the same while it trains, in a browser
  nightsplat edit run --floaters --out clean.ply    crop, clean, transform and merge models
  nightsplat sweep photos --out sweep --curves all  train with every curve, and rank them
  nightsplat sweep photos --out s --table presets   what time and memory buy
  nightsplat blocks plan photos --out city          a scene larger than the device, in blocks

For developers:
  bench        time every kernel, and find the fastest tiles
  check        hold every pass of a training step to its CPU reference, on this device
  synth        write a small dark set with known references
  vary         write a set of varying exposure from one in normal light
  completions  print what a shell completes
  man          write the man pages

Exit codes:
  0 done; 1 failed; 2 misuse; 3 data that cannot be used; 4 no device, or not enough memory;
  75 saved, run it again (train --max-minutes); 129, 130 and 143 saved (SIGHUP, SIGINT, SIGTERM)";

#[derive(Debug, Subcommand)]
enum Command {
    // `nightsplat PHOTOS` is its name.
    #[command(hide = true)]
    Make(Box<make::MakeArgs>),
    Train(Box<train::TrainArgs>),
    Diagnose(diagnose::DiagnoseArgs),
    Pose(pose::PoseArgs),
    Eval(eval::EvalArgs),
    Compare(compare::CompareArgs),
    Render(render::RenderArgs),
    Export(export::ExportArgs),
    View(view::ViewArgs),
    Edit(edit::EditArgs),
    Tone(tone::ToneArgs),
    Sweep(Box<sweep::SweepArgs>),
    Blocks(Box<blocks::BlocksArgs>),
    #[command(hide = true)]
    Synth(synth::SynthArgs),
    #[command(hide = true)]
    Vary(vary::VaryArgs),
    Demo(demo::DemoArgs),
    Doctor(doctor::DoctorArgs),
    #[command(hide = true)]
    Bench(bench::BenchArgs),
    #[command(hide = true)]
    Check(Box<check::CheckArgs>),
    #[command(hide = true)]
    Completions(completions::CompletionsArgs),
    #[command(hide = true)]
    Man(man::ManArgs),
}

impl Cli {
    /// Reads a command line, the program's name first.
    pub fn read(mut arguments: Vec<OsString>) -> Result<Self, clap::Error> {
        let everything = arguments.iter().any(|argument| argument == "--help-all");
        let command = help::command(everything);
        if let Some(at) = make::place_of_photographs(&command, &arguments) {
            arguments.insert(at, "make".into());
        }
        Self::from_arg_matches(&command.try_get_matches_from(arguments)?)
    }

    /// The number of -v flags.
    pub fn verbosity(&self) -> u8 {
        self.verbose
    }

    /// Runs the command.
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::Make(args) => make::run(&args, self.verbose > 0),
            Command::Train(args) => train::run(&args, self.verbose > 0),
            Command::Diagnose(args) => diagnose::run(&args, self.verbose > 0),
            Command::Pose(args) => pose::run(&args),
            Command::Eval(args) => eval::run(&args),
            Command::Compare(args) => compare::run(&args),
            Command::Render(args) => render::run(&args),
            Command::Export(args) => export::run(&args),
            Command::View(args) => view::run(&args),
            Command::Edit(args) => edit::run(&args),
            Command::Tone(args) => tone::run(&args),
            Command::Sweep(args) => sweep::run(&args),
            Command::Blocks(args) => blocks::run(&args),
            Command::Synth(args) => synth::run(args),
            Command::Vary(args) => vary::run(&args),
            Command::Demo(args) => demo::run(&args),
            Command::Doctor(args) => doctor::run(&args),
            Command::Bench(args) => bench::run(&args),
            Command::Check(args) => check::run(&args),
            Command::Completions(args) => completions::run(args),
            Command::Man(args) => man::run(&args),
        }
    }
}

/// The message of an error; settings are named by key and option.
fn message(error: &anyhow::Error) -> String {
    let message = format!("{error:#}");
    let Some(crate::Error::Setting { key, .. }) = error.downcast_ref() else { return message };
    match setting(key).and_then(Setting::option) {
        Some((option, _)) => message.replacen(key, &format!("{key} (--{option})"), 1),
        None => message,
    }
}

/// Tells the end of a command: the files that it wrote, if any, and the command to run next.
fn finish(wrote: &str, next: &str) {
    let wrote =
        if wrote.is_empty() { String::new() } else { format!("wrote {}\n", one_line(wrote)) };
    tell(format_args!("{wrote}next: {}", one_line(next)));
}

/// A run or a model as words of a command, with the dataset that was named for it.
fn with_dataset(run: &Path, dataset: Option<&Path>) -> String {
    let dataset = dataset.map(|dataset| format!(" --dataset {}", word(dataset)));
    word(run) + &dataset.unwrap_or_default()
}

/// A path as a word of a command.
fn word(path: &Path) -> String {
    quoted(&path.display().to_string())
}

/// A word quoted for a POSIX shell.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,+:@%".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', "'\\''"))
}

/// Writes a field of an event on one line, whatever the names in it contain.
pub fn event_field(writer: &mut Writer<'_>, field: &Field, value: &dyn fmt::Debug) -> fmt::Result {
    let text = format!("{value:?}");
    match field.name() {
        "message" => write!(writer, "{}", in_a_line(&text)),
        name => write!(writer, "{name}={}", one_line(&text)),
    }
}

/// Image formats for output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum OutputFormat {
    /// 8 bits per channel, sRGB
    #[default]
    Png,
    /// 16 bits per channel, sRGB
    Png16,
    /// 32-bit float, linear
    Exr,
}

impl OutputFormat {
    /// File extension.
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

/// A progress bar on standard error, hidden unless that is a terminal.
fn progress_bar(len: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:32} {pos}/{len}  {msg}  {eta} left");
    ProgressBar::new(len as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// How a command opens the device of a run: the chosen one, or that of its configuration.
fn opener(device: Option<&DeviceChoice>) -> Opener {
    Opener { device: device.cloned(), open: driver::open }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

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

    #[test]
    fn a_warning_is_one_line_whatever_names_it_has() {
        use tracing_subscriber::fmt::format::{FormatFields, debug_fn};
        use tracing_subscriber::prelude::*;

        #[derive(Clone, Default)]
        struct LastEvent(Arc<Mutex<String>>);
        impl<S: tracing::Subscriber> tracing_subscriber::Layer<S> for LastEvent {
            fn on_event(
                &self,
                event: &tracing::Event<'_>,
                _: tracing_subscriber::layer::Context<'_, S>,
            ) {
                let mut line = String::new();
                let fields = debug_fn(event_field);
                fields.format_fields(Writer::new(&mut line), event).unwrap();
                self.0.lock().unwrap().push_str(&line);
            }
        }
        let lines = LastEvent::default();
        tracing::subscriber::with_default(
            tracing_subscriber::registry().with(lines.clone()),
            || {
                tracing::warn!("skipped {}", "no\nerror: lost\u{202e}.png");
                tracing::warn!("skipped {}", "x".repeat(100_000));
            },
        );
        let lines = lines.0.lock().unwrap();
        assert!(lines.starts_with(r"skipped no\nerror: lost\u{202e}.pngskipped xxx"), "{lines}");
        assert!(lines.len() < 1100 && lines.ends_with("x ..."), "{lines}");
    }

    #[test]
    fn words_are_quoted_if_a_shell_requires_it() {
        assert_eq!(quoted("--set"), "--set");
        assert_eq!(quoted("curve=ap3,seed=1"), "curve=ap3,seed=1");
        assert_eq!(quoted("a b"), "'a b'");
        assert_eq!(quoted("it's"), "'it'\\''s'");
        assert_eq!(quoted(""), "''");
    }
}
