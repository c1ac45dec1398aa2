//! `nightsplat man`: the help of every command as man pages.

use std::io::Write;
use std::iter;
use std::path::PathBuf;

use clap::Command;
use clap_mangen::Man;
use nightsplat_core::output::{create_folder, write_whole};

use super::{finish, help};
use crate::Error;

/// Write man pages: nightsplat.1 and one per command
#[derive(Clone, Debug, clap::Args)]
pub struct ManArgs {
    /// Folder to write to, such as ~/.local/share/man/man1
    pub dir: PathBuf,
}

/// Writes the pages.
pub fn run(args: &ManArgs) -> anyhow::Result<()> {
    let problem = |error: std::io::Error| Error::output(&args.dir, error.to_string());
    create_folder(&args.dir)?;
    let mut command = help::command(true).disable_help_subcommand(true);
    command.build();
    let nested = command.get_subcommands().flat_map(Command::get_subcommands);
    for command in iter::once(&command).chain(command.get_subcommands()).chain(nested) {
        let name = Man::new(command.clone()).get_filename();
        write_whole(&args.dir.join(name), &page(command).map_err(problem)?)?;
    }
    finish(&format!("man pages to {}", args.dir.display()), "man nightsplat");
    Ok(())
}

/// The page of a command. Its examples keep their lines.
fn page(command: &Command) -> std::io::Result<Vec<u8>> {
    let examples = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    let mut page = vec![];
    Man::new(command.clone().after_help("")).render(&mut page)?;
    if !examples.is_empty() {
        let lines = examples.replace('\\', "\\\\").replace('-', "\\-");
        let lines = lines.lines().map(|line| format!("\\&{line}\n")).collect::<String>();
        write!(page, ".SH EXAMPLES\n.nf\n{lines}.fi\n")?;
    }
    Ok(page)
}
