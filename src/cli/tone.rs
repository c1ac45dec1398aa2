//! `nightsplat tone`: lists tone curves, applies one to photographs, or fits one to pairs of photographs.

use std::ffi::OsString;

use anyhow::Result;

use crate::Error;

pub mod apply;
#[cfg(feature = "fit")]
pub mod fit;
pub mod list;

/// List tone curves, apply one to photographs, or fit one to pairs of photographs.
#[derive(Clone, Debug, clap::Args)]
pub struct ToneArgs {
    #[command(subcommand)]
    command: Command,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum Command {
    List(list::ListArgs),
    Apply(Box<apply::ApplyArgs>),
    #[cfg(feature = "fit")]
    Fit(fit::FitArgs),
    /// Arguments of the former `tone`, without a subcommand; `fit` if the feature is off.
    #[command(external_subcommand)]
    Other(Vec<OsString>),
}

/// Runs the subcommand.
pub fn run(args: &ToneArgs) -> Result<()> {
    match &args.command {
        Command::List(args) => list::run(args),
        Command::Apply(args) => apply::run(args),
        #[cfg(feature = "fit")]
        Command::Fit(args) => fit::run(args),
        Command::Other(words) => {
            let first = words.first().map(|word| word.to_string_lossy()).unwrap_or_default();
            let problem = match first.as_ref() {
                "fit" => "this build has no `tone fit`; install nightsplat with the feature `fit`, which is on \
                 by default"
                    .to_owned(),
                photos => format!("`nightsplat tone {photos}` is now `nightsplat tone apply {photos}`"),
            };
            Err(Error::Usage(problem).into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_build_without_fit_names_the_feature() {
        // What such a build makes of `tone fit`.
        let command = Command::Other(vec!["fit".into()]);
        let problem = run(&ToneArgs { command }).unwrap_err().to_string();
        assert!(problem.contains("feature `fit`"), "{problem}");
    }
}
