//! Help: `-h` shows the options that most people use, `--help-all` shows all of them in groups.

use clap::{Arg, ArgAction, Command, CommandFactory};
use nightsplat_photographs::tone::Tone;
use toml::Value;

use super::Cli;
use crate::train::{TrainConfig, values};

/// The options of a command that `-h` shows; of a command that is not listed it shows all.
const COMMON: [(&str, &str); 11] = [
    ("make", "out title no-open finish overwrite preset downscale fps device view"),
    (
        "train",
        "out resume finish overwrite preset steps curve downscale max-vram device view explain",
    ),
    ("sweep", "out curves presets seeds grid table steps downscale jobs dry-run"),
    ("check", "json steps curve parts downscale device"),
    ("pose", "out matcher fps camera-model patience colmap overwrite device"),
    ("render", "out split path frames video size layer format dataset device"),
    ("export", "format out up level max-size views title text url dataset device"),
    ("apply", "out curve gain brightness reference report compare format json device"),
    ("fit", "normal family out cross-validate plot profile json"),
    ("synth", "street views width height seed fisheye lamp sky street-lamp night-mode overwrite"),
    ("diagnose", "report plan run preset steps downscale json device"),
];

/// The headings of the options of a training in `--help-all`.
const GROUPS: [(&str, &str); 6] = [
    (
        "Photographs",
        "images exclude exclude-file orientation reference light white-balance downscale max-resolution patch-pixels \
         test-every invert-masks undistort",
    ),
    (
        "Tone curve",
        "curve profile targets gain brightness colour theta scene-statistics law exposure exposures",
    ),
    (
        "Model",
        "preset model parts sh-degree init freeze max-gaussians density near background ssim-weight raw-colors \
         antialiasing depth \
         depth-is-disparity normals \
         denoiser-stages denoiser-repeats denoiser-channels denoiser-precision denoiser-crop",
    ),
    ("Settings", "config set frame plan explain seed"),
    (
        "Time, memory and checkpoints",
        "steps max-minutes checkpoint-every checkpoint-minutes device max-vram max-ram cache",
    ),
    ("Logs and checks", "progress view eval-every tensorboard hash-every check-every check-stops"),
];

/// Whether a list of names contains a name.
fn lists(names: &str, name: &str) -> bool {
    names.split_whitespace().any(|listed| listed == name)
}

/// The command line; with `everything`, its help shows all options.
pub(super) fn command(everything: bool) -> Command {
    with_help(Cli::command(), everything)
}

fn with_help(command: Command, everything: bool) -> Command {
    let command = command.mut_subcommands(|inner| with_help(inner, everything));
    let name = command.get_name().to_owned();
    let common = COMMON.iter().find(|(listed, _)| *listed == name).map(|(_, options)| *options);
    let is_training = ["make", "train", "check", "sweep"].contains(&name.as_str());
    let help = |name: &'static str, text: &'static str| {
        Arg::new(name).long(name).action(ArgAction::HelpShort).help(text).display_order(999)
    };
    let (less, all) =
        (help("help", "Print help").short('h'), help("help-all", "Show all options, in groups"));
    let command = match command.get_long_about().filter(|_| everything).cloned() {
        Some(about) => command.about(about),
        None => command,
    };
    let command = command.mut_args(|arg| {
        let is_rare =
            common.zip(arg.get_long()).is_some_and(|(common, option)| !lists(common, option));
        let group = GROUPS.iter().find(|(_, names)| {
            is_training && arg.get_long().is_some_and(|option| lists(names, option))
        });
        let arg = match (everything, group) {
            (false, _) => arg.help_heading(None::<&str>).hide_short_help(is_rare),
            (true, Some((heading, _))) if arg.get_help_heading().is_none() => {
                arg.help_heading(*heading)
            }
            _ => arg,
        };
        let text = match arg.get_long_help().filter(|_| everything) {
            Some(long) => Some(long.to_string()),
            None => arg.get_help().map(ToString::to_string),
        };
        // A negative number is a value, so that its error names the option.
        let takes_values = arg.get_action().takes_values();
        let is_enum = arg.get_possible_values().iter().any(|value| value.get_help().is_some());
        let arg =
            arg.allow_negative_numbers(takes_values).hide_possible_values(takes_values && !is_enum);
        match text {
            Some(text) => arg.help(filled(&text)),
            None => arg,
        }
    });
    command.disable_help_flag(true).arg(less).arg(all.hide(common.is_none()))
}

/// A help text with `{tone.theta}` replaced by the default of that setting, and `{tone.gain_c of ase}` by the one
/// that comes with that curve.
fn filled(help: &str) -> String {
    let parts = help.split(['{', '}']).enumerate();
    parts.map(|(i, part)| if i % 2 == 0 { part.to_owned() } else { default_of(part) }).collect()
}

/// The default as a value of its option; unknown settings keep their braces.
fn default_of(setting: &str) -> String {
    let (key, curve) = setting.split_once(" of ").unwrap_or((setting, ""));
    let mut config = TrainConfig::default();
    if let Ok(curve) = curve.parse::<Tone>() {
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
    use super::*;
    use crate::cli;

    fn options(command: &Command) -> Vec<&str> {
        command.get_arguments().filter_map(Arg::get_long).collect()
    }

    #[test]
    fn every_option_that_a_list_names_exists_and_every_option_of_train_has_a_group() {
        let command = command(true);
        let train = command.find_subcommand("train").unwrap();
        for (_, names) in &GROUPS {
            assert!(names.split(' ').all(|name| options(train).contains(&name)), "{names}");
        }
        let in_none = ["out", "overwrite", "resume", "finish", "help", "help-all"];
        let grouped = |name: &&str| {
            in_none.contains(name) || GROUPS.iter().any(|(_, names)| lists(names, name))
        };
        assert!(options(train).iter().all(grouped), "{:?}", options(train));
        for (name, common) in &COMMON {
            let nested =
                command.find_subcommand("tone").and_then(|tone| tone.find_subcommand(name));
            let Some(command) = command.find_subcommand(name).or(nested) else { continue };
            assert!(
                common.split(' ').all(|name| options(command).contains(&name)),
                "{name}: {common}"
            );
        }
    }

    #[test]
    fn the_help_names_no_setting_that_does_not_exist() {
        let command = command(true);
        let nested = command.get_subcommands().flat_map(Command::get_subcommands);
        let commands = command.get_subcommands().chain(nested);
        for arg in commands.flat_map(Command::get_arguments) {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            assert!(!help.contains('{'), "{}: {help}", arg.get_id());
        }
    }

    /// Each default, given as an option, leaves the configuration as it is.
    #[test]
    fn the_defaults_in_the_help_are_those_of_the_configuration() {
        let command = command(true);
        let expected = TrainConfig { dataset: "photos".into(), ..TrainConfig::default() };
        let mut checked = 0;
        for arg in command.find_subcommand("train").unwrap().get_arguments() {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            let default = help.split_once("[default: ").and_then(|(_, rest)| rest.split_once(']'));
            // A default in words depends on the device, the curve or the dataset.
            let Some((default, _)) = default.filter(|(text, _)| {
                !text.contains(' ') && !["all", "none", "nothing"].contains(text)
            }) else {
                continue;
            };
            let option = format!("--{}={default}", arg.get_long().unwrap());
            let line = ["nightsplat", "train", "photos", "--out", "run", &option];
            let cli::Command::Train(args) =
                Cli::read(line.map(Into::into).to_vec()).unwrap().command
            else {
                panic!("`train` is another command");
            };
            let mut config = args.options.config("photos".as_ref(), None).unwrap();
            if option.starts_with("--steps") {
                // An explicit length holds out no views.
                config.stop.views = expected.stop.views;
            }
            assert_eq!(config, expected, "{option}");
            checked += 1;
        }
        assert!(checked >= 26, "{checked}");
        assert_eq!(filled("c [{tone.gain_c of ase}, {tone.gain_c of ap3}]"), "c [3, 1]");
    }
}
