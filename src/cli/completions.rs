//! `nightsplat completions`: what a shell completes after `nightsplat`.

use std::io::Write;

use anyhow::Result;
use clap::CommandFactory;
use clap_complete::Shell;

use super::Cli;

/// Print the completions for a shell: `nightsplat completions bash > ~/.local/share/bash-completion/completions/nightsplat`
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct CompletionsArgs {
    /// The shell
    pub shell: Shell,
}

/// Prints the script.
///
/// # Errors
/// Standard output is closed.
pub fn run(args: CompletionsArgs) -> Result<()> {
    let mut script = vec![];
    clap_complete::generate(args.shell, &mut Cli::command(), "nightsplat", &mut script);
    Ok(std::io::stdout().lock().write_all(&script)?)
}
