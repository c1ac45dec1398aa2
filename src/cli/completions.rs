//! `nightsplat completions`: completion scripts for shells.

use anyhow::Result;
use clap_complete::Shell;

use super::{help, print};

/// Print the completion script of a shell
///
/// For bash: `nightsplat completions bash > ~/.local/share/bash-completion/completions/nightsplat`
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct CompletionsArgs {
    /// Shell
    pub shell: Shell,
}

/// Prints the script.
pub fn run(args: CompletionsArgs) -> Result<()> {
    let mut script = vec![];
    clap_complete::generate(args.shell, &mut help::command(true), "nightsplat", &mut script);
    Ok(print(String::from_utf8_lossy(&script))?)
}
