//! The defaults that the help shows, read from the configuration that has them.

use clap::Command;
use toml::Value;

use crate::train::{TrainConfig, values};

/// The command with `{tone.theta}` in an option's help replaced by the default of that setting, and `{tone.gain_c of
/// ase}` by the one that comes with that curve. A negative number is a value, so that what refuses it names its option.
pub(super) fn shown(command: Command) -> Command {
    command.mut_args(|arg| {
        let takes_values = arg.get_action().takes_values();
        let arg = arg.allow_negative_numbers(takes_values);
        match arg.get_help().map(ToString::to_string) {
            Some(help) if help.contains('{') => arg.help(filled(&help)),
            _ => arg,
        }
    })
}

fn filled(help: &str) -> String {
    let parts = help.split(['{', '}']).enumerate();
    parts.map(|(i, part)| if i % 2 == 0 { part.to_owned() } else { default_of(part) }).collect()
}

/// The default as an option takes it; the braces stay where there is no such setting.
fn default_of(setting: &str) -> String {
    let (key, curve) = setting.split_once(" of ").unwrap_or((setting, ""));
    let mut config = TrainConfig::default();
    if let Ok(curve) = curve.parse() {
        config.tone = config.tone.with_curve(curve);
    }
    match values(&config).unwrap_or_default().get(key) {
        Some(Value::String(text)) => text.clone(),
        Some(Value::Float(number)) => number.to_string(),
        Some(value) => value.to_string(),
        None => format!("{{{setting}}}"),
    }
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, Parser};

    use super::*;
    use crate::cli::{self, Cli};

    #[test]
    fn the_help_names_no_setting_that_there_is_not() {
        let command = Cli::command();
        let nested = command.get_subcommands().flat_map(Command::get_subcommands);
        let commands = command.get_subcommands().chain(nested);
        for arg in commands.flat_map(Command::get_arguments) {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            assert!(!help.contains('{'), "{}: {help}", arg.get_id());
        }
    }

    /// Whatever stands there, written out on the command line, changes nothing.
    #[test]
    fn the_defaults_in_the_help_are_those_of_the_configuration() {
        let command = Cli::command();
        let expected = TrainConfig { dataset: "photos".into(), ..TrainConfig::default() };
        let mut checked = 0;
        for arg in command.find_subcommand("train").unwrap().get_arguments() {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            let default = help.split_once("[default: ").and_then(|(_, rest)| rest.split_once(']'));
            // A default in words depends on the device, the curve or the dataset.
            let Some((default, _)) = default.filter(|(text, _)| !text.contains(' ')) else {
                continue;
            };
            let option = format!("--{}={default}", arg.get_long().unwrap());
            let line = ["nightsplat", "train", "photos", "--out", "run", &option];
            let cli::Command::Train(args) = Cli::try_parse_from(line).unwrap().command else {
                panic!("`train` is another command");
            };
            let mut config = args.options.config("photos".as_ref(), None).unwrap();
            if option.starts_with("--steps") {
                // A length that is named keeps no views from training.
                config.stop.views = expected.stop.views;
            }
            assert_eq!(config, expected, "{option}");
            checked += 1;
        }
        assert_eq!(checked, 26);
        assert_eq!(filled("c [{tone.gain_c of ase}, {tone.gain_c of ap3}]"), "c [3, 1]");
    }
}
