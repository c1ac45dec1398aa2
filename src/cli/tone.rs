//! `nightsplat tone`: lists tone curves, applies one to photographs, or fits one to pairs of photographs.

use anyhow::Result;

pub mod apply;
pub mod fit;
pub mod list;

/// List tone curves, apply one to photographs, or fit one to pairs of photographs.
#[derive(Clone, Debug, clap::Args)]
pub struct ToneArgs {
    #[command(subcommand)]
    command: ToneCommand,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum ToneCommand {
    List(list::ListArgs),
    Apply(Box<apply::ApplyArgs>),
    Fit(Box<fit::FitArgs>),
}

/// Runs the subcommand.
pub fn run(args: &ToneArgs) -> Result<()> {
    match &args.command {
        ToneCommand::List(args) => list::run(args),
        ToneCommand::Apply(args) => apply::run(args),
        ToneCommand::Fit(args) => fit::run(args),
    }
}
