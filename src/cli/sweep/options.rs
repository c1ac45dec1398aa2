//! The options of `train` in `sweep`: checked as in `train`, kept as text for the commands of the points.

use std::path::Path;

use clap::builder::ValueParser;
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, Error, FromArgMatches, ValueHint};

use super::GRID;
use super::arguments::pair;
use crate::cli::train::TrainOptions;

/// Options of `train` that take a list here: name in `train`, name here, help.
const LISTS: [(&str, &str, &str); 5] = [
    ("preset", "presets", "Presets, each with its plan for the photographs"),
    ("curve", "curves", "Tone curves by name, formula or file, or all [default: {tone.curve}]"),
    ("gain", "gain", "Values of the gain constant c, or auto"),
    ("theta", "theta", "Target means of the curve linear"),
    ("seed", "seeds", "Seeds to average over"),
];

/// The options of `train` on the command line.
#[derive(Clone, Debug)]
pub(super) struct Options {
    /// Common arguments of all points, in the order of `train`.
    pub(super) shared: Vec<String>,
    /// Option of `train` and its list.
    pub(super) lists: Vec<(&'static str, String)>,
}

impl Args for Options {
    fn augment_args(command: Command) -> Command {
        LISTS.iter().fold(TrainOptions::augment_args(command), |command, &(option, name, help)| {
            command.mut_arg(option, |arg| {
                let arg = arg.long(name).value_name("LIST").help(help).help_heading(GRID);
                let arg = if name == option { arg } else { arg.visible_alias(option) };
                arg.value_parser(ValueParser::string())
            })
        })
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Options {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let mut options = Self { shared: vec![], lists: vec![] };
        let train = TrainOptions::augment_args(Command::new("train"));
        for arg in train.get_arguments() {
            let id = arg.get_id().as_str();
            if matches.value_source(id) != Some(ValueSource::CommandLine) {
                continue;
            }
            let list = LISTS.iter().find(|(option, ..)| *option == id);
            for value in matches.get_raw(id).unwrap_or_default() {
                let value = text(value.as_ref())?;
                match list {
                    Some((option, ..)) => options.lists.push((option, value)),
                    None => options.push(arg, value)?,
                }
            }
        }
        Ok(options)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Options {
    fn push(&mut self, arg: &Arg, value: String) -> Result<(), Error> {
        let long = arg.get_long().unwrap_or_default();
        if !arg.get_action().takes_values() {
            // The raw value of a flag is a boolean.
            self.shared.push(format!("--{long}"));
            return Ok(());
        }
        let is_path = arg.get_value_hint() == ValueHint::AnyPath;
        let absolute = |path| {
            super::absolute(path).map_err(|error| Error::raw(ErrorKind::ValueValidation, error))
        };
        let value = if is_path { absolute(Path::new(&value))? } else { value };
        self.shared.extend(pair(long, &value));
        Ok(())
    }
}

fn text(value: &Path) -> Result<String, Error> {
    value.to_str().map(str::to_owned).ok_or_else(|| {
        Error::raw(ErrorKind::InvalidUtf8, format!("{} is not Unicode", value.display()))
    })
}
