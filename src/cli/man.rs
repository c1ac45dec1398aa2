//! `nightsplat man`: the help of every subcommand as man pages.

use std::iter;
use std::path::PathBuf;

use clap::CommandFactory;
use clap_mangen::Man;

use super::Cli;
use crate::base::output::write_whole;
use crate::{Error, Result};

/// Write the man pages into a folder: nightsplat.1, and one for each command
#[derive(Clone, Debug, clap::Args)]
pub struct ManArgs {
    /// The folder, such as ~/.local/share/man/man1; it is created
    pub dir: PathBuf,
}

/// Writes the pages.
///
/// # Errors
/// The folder cannot be written.
pub fn run(args: &ManArgs) -> Result<()> {
    let problem = |error: std::io::Error| Error::output(&args.dir, error.to_string());
    std::fs::create_dir_all(&args.dir).map_err(problem)?;
    let mut command = Cli::command().disable_help_subcommand(true);
    command.build();
    let nested = command.get_subcommands().flat_map(clap::Command::get_subcommands);
    for command in iter::once(&command).chain(command.get_subcommands()).chain(nested) {
        let page = Man::new(command.clone());
        let mut text = vec![];
        page.render(&mut text).map_err(problem)?;
        write_whole(&args.dir.join(page.get_filename()), &text)?;
    }
    Ok(())
}
