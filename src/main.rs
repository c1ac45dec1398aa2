//! The `nightsplat` command: parses, runs, prints an error once and sets the exit code.

use std::io::IsTerminal;
use std::process::ExitCode;

use nightsplat::Error;
use nightsplat::cli::{
    Cli, Phases, ending, event_field, hint, one_line, report_long_files, tell_on_stderr,
};
use tracing_subscriber::filter::{LevelFilter, filter_fn};
use tracing_subscriber::fmt::format::debug_fn;
use tracing_subscriber::prelude::*;

fn main() -> ExitCode {
    report_long_files();
    let cli = match Cli::read(std::env::args_os().collect()) {
        Ok(cli) => cli,
        Err(error) => return misuse(&error),
    };
    let level = match cli.verbosity() {
        0 => LevelFilter::WARN,
        1 => LevelFilter::INFO,
        _ => LevelFilter::DEBUG,
    };
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .fmt_fields(debug_fn(event_field))
        .with_target(false)
        // They would be told on standard error, which is what has failed.
        .log_internal_errors(false)
        .without_time();
    let is_line = filter_fn(move |metadata| metadata.is_event() && *metadata.level() <= level);
    let phases = (cli.verbosity() > 0).then(|| Phases::begin().with_filter(Phases::filter()));
    tracing_subscriber::registry()
        .with(lines.with_filter(is_line.with_max_level_hint(level)))
        .with(phases)
        .init();
    let Err(error) = cli.run() else { return ExitCode::SUCCESS };
    tell_on_stderr(one_line(&ending(&error)));
    ExitCode::from(error.downcast_ref::<Error>().map_or(1, Error::exit_code))
}

/// Prints help as it is, and a misuse on one line like every other error.
fn misuse(error: &clap::Error) -> ExitCode {
    use clap::error::ErrorKind;
    let help = [
        ErrorKind::DisplayHelp,
        ErrorKind::DisplayVersion,
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand,
    ];
    if help.contains(&error.kind()) {
        return match error.print() {
            Err(problem) if problem.kind() != std::io::ErrorKind::BrokenPipe => {
                tell_on_stderr(format_args!("error: help cannot be written ({problem})"));
                ExitCode::from(1)
            }
            _ => ExitCode::from(error.exit_code() as u8),
        };
    }
    let text = error.to_string();
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let told =
        lines.take_while(|line| !line.starts_with("Usage:") && !line.starts_with("For more"));
    let line = told.collect::<Vec<_>>().join(" ").replace(" tip: ", "; ");
    let line = hint(error).map_or(line, |line| format!("error: {line}"));
    tell_on_stderr(format_args!("{}; see --help", one_line(&line)));
    ExitCode::from(2)
}
