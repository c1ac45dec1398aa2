//! The command line: one file per subcommand.

use anyhow::Result;
use clap::{Parser, Subcommand};

pub mod synth;
pub mod tone;
pub mod train;

/// 3D Gaussian Splatting from dark photographs, on any Vulkan device.
#[derive(Debug, Parser)]
#[command(name = "nightsplat", version, max_term_width = 100, after_help = EXAMPLES)]
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
  nightsplat train photos --out run                 train from a folder of dark photographs
  nightsplat eval run --save-images                 score it where there are references";

#[derive(Debug, Subcommand)]
enum Command {
    Train(Box<train::TrainArgs>),
    Tone(tone::ToneArgs),
    Synth(synth::SynthArgs),
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
            Command::Tone(args) => Ok(tone::run(args)?),
            Command::Synth(args) => Ok(synth::run(args)?),
        }
    }
}
