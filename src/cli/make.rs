//! `nightsplat PHOTOS`: from photographs to a page.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Result;
use nightsplat_core::output::about;

use super::export::{self, ExportArgs};
use super::pose::{self, PoseChoices};
use super::progress::ProgressForm;
use super::sweep::parsed;
use super::train::{self, TrainArgs, TrainOptions};
use super::{one_line, signals, tell, tell_on_stderr, word};
use crate::driver;
use crate::gpu::DeviceChoice;
use crate::live;
use crate::make::{MadePaths, MakeStage};
use crate::results::run::{Requests, has_checkpoint};
use crate::{Error, Stop};
use nightsplat_pose::PoseOptions;

/// From photographs to a page: cameras, training, page.
///
/// `nightsplat PHOTOS` is the short form. Finds the cameras of the photographs if they have none (`pose`), diagnoses
/// them and trains (`train`), and writes a page to fly through and share (`export --format html`), which it opens where
/// there is a desktop. Everything is in PHOTOS-splat beside the photographs: dataset, run and page, for the other
/// commands.
///
/// Stop it at any time, with Ctrl-C or a kill: the same command goes on where it was. --finish ends a stopped training
/// early, and writes the page. Options of `train` and `pose` are taken.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct MakeArgs {
    /// Folder of photographs of one scene, a clip (.mp4, .mov, .mkv), or a dataset with cameras
    pub photos: PathBuf,
    /// Folder to write [default: PHOTOS-splat, beside the photographs]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Title of the page and of links to it [default: the name of the photographs]
    #[arg(long, value_name = "TEXT")]
    pub title: Option<String>,
    /// Do not open the page
    #[arg(long)]
    pub no_open: bool,
    /// Good enough: cool the stopped training down, score it, and write the page
    #[arg(long, conflicts_with = "overwrite")]
    pub finish: bool,
    /// Begin anew
    #[arg(long)]
    pub overwrite: bool,
    /// Progress output [default: a bar on a terminal, else plain]
    #[arg(long, value_enum, value_name = "FORM")]
    pub progress: Option<ProgressForm>,
    /// Serve a live page of the training on this address [default with the option: 127.0.0.1:7007]
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = live::DEFAULT_ADDRESS)]
    pub view: Option<live::Listen>,
    #[command(flatten)]
    cameras: PoseChoices,
    #[command(flatten)]
    options: TrainOptions,
}

const EXAMPLES: &str = "Examples:
  nightsplat photos                                     photos-splat/photos.html
  nightsplat clip.mp4 --title 'Our attic' --fps 3
  nightsplat photos --downscale 2 --preset draft        a first look, sooner
  nightsplat photos --finish                            enough: end the stopped training, write the page";

/// Runs the stages that are left; `everything`: prints also what the plan leaves off.
pub fn run(args: &MakeArgs, everything: bool) -> Result<()> {
    let made = MadePaths::new(&args.photos, args.out.as_deref())?;
    if args.finish && !has_checkpoint(&made.run) {
        let problem = "has no checkpoint to finish from; without --finish, the training goes on";
        return Err(Error::input(&made.run, problem).into());
    }
    // Misuse ends before hours of work.
    let config = args.options.requested(&made.dataset)?.settings(None)?.config()?;
    config.check()?;
    let device = config.device.parse::<DeviceChoice>()?;
    let cameras = PoseOptions {
        light: config.light,
        overwrite: args.overwrite,
        ..args.cameras.options(&args.photos, &made.dataset)
    };
    let needs_cameras = made.needs_cameras(&cameras)?;
    let is_cpu = driver::open(&device)?.properties().is_cpu;
    let form = args.progress.unwrap_or_else(ProgressForm::of_terminal);
    let display = Display { made: &made, times: made.expected(&cameras, &config, is_cpu), form };
    display.tell_times();
    let requests = signals::requests()?;
    if needs_cameras {
        display.begin(MakeStage::Cameras);
        let wrote = pose::posed(&cameras, &device, &display.prefix(MakeStage::Cameras), &requests)?;
        if form != ProgressForm::Json {
            tell(one_line(&wrote));
        }
        stop_between(&made, &requests)?;
    }
    display.begin(MakeStage::Training);
    let training = training(args, &made, display.prefix(MakeStage::Training));
    train::train(&training, everything, Some(&requests))?;
    let page = page(args, &made)?;
    display.end(&page, open_page(&page, args.no_open));
    Ok(())
}

/// One display over all stages.
struct Display<'a> {
    made: &'a MadePaths,
    /// Estimates of the stages that are left, in seconds.
    times: Vec<(MakeStage, Option<f64>)>,
    form: ProgressForm,
}

impl Display<'_> {
    fn tell_times(&self) {
        if self.form != ProgressForm::None {
            tell_on_stderr(expected(&self.times));
        }
    }

    /// Begins every line of a stage: "2 of 3 training: ".
    fn prefix(&self, stage: MakeStage) -> String {
        let stages = &self.made.stages;
        let before = stages.iter().take_while(|&&one| one != stage).count();
        format!("{} of {} {}: ", before + 1, stages.len(), stage.name())
    }

    fn begin(&self, stage: MakeStage) {
        let time = self.times.iter().find_map(|(of, time)| time.filter(|_| *of == stage));
        if self.form != ProgressForm::None {
            let time = time.map_or_else(|| "begins".to_owned(), about);
            tell_on_stderr(format_args!("{}{time}", self.prefix(stage)));
        }
    }

    fn end(&self, page: &Path, opens: bool) {
        if self.form == ProgressForm::Json {
            return tell(serde_json::json!({ "event": "page", "path": page, "opens": opens }));
        }
        let wrote = format!("{}wrote {}", self.prefix(MakeStage::Page), page.display());
        let next = match opens {
            true => "it opens in your browser".to_owned(),
            false => format!("open {} in a browser", word(page)),
        };
        tell(format_args!("{}\nnext: {next}; send the file to share it", one_line(&wrote)));
    }
}

/// The estimates in a line, as coarse as they are.
fn expected(times: &[(MakeStage, Option<f64>)]) -> String {
    let known: f64 = times.iter().filter_map(|(_, seconds)| *seconds).sum();
    let part = |(stage, seconds): &(MakeStage, Option<f64>)| match seconds {
        Some(seconds) => format!("{} {}", stage.name(), about(*seconds)),
        None => format!("{} as its frames need", stage.name()),
    };
    let parts = times.iter().map(part).collect::<Vec<_>>().join(", ");
    let more = if times.iter().any(|(_, seconds)| seconds.is_none()) { " and more" } else { "" };
    format!("{}{more} in all, a coarse estimate: {parts}", about(known))
}

/// A stop that was requested while no stage looked.
fn stop_between(made: &MadePaths, requests: &Requests) -> Result<()> {
    let stopped = |cause: Stop| Error::StageStopped {
        folder: made.out.clone(),
        stage: MakeStage::Training.name().to_owned(),
        cause,
    };
    requests.stops().map_or(Ok(()), |cause| Err(stopped(cause).into()))
}

/// The arguments of the training.
fn training(args: &MakeArgs, made: &MadePaths, prefix: String) -> TrainArgs {
    TrainArgs {
        dataset: made.dataset.clone(),
        out: made.run.clone(),
        overwrite: args.overwrite,
        resume: !args.overwrite,
        finish: args.finish,
        plan: None,
        progress: args.progress,
        view: args.view,
        explain: false,
        options: args.options.clone(),
        prefix,
    }
}

/// Writes the page.
fn page(args: &MakeArgs, made: &MadePaths) -> Result<PathBuf> {
    let word = |path: &Path| path.as_os_str().to_owned();
    let mut line: Vec<OsString> =
        vec!["export".into(), word(&made.run), "--out".into(), word(&made.page)];
    line.extend(["--format", "html", "--title"].map(OsString::from));
    let name = made.page.file_stem().unwrap_or_default().to_owned();
    line.push(args.title.as_ref().map_or(name, OsString::from));
    Ok(export::write(&parsed::<ExportArgs>("page", line)?)?.path)
}

/// Opens the page if there is a desktop; false if there is none.
fn open_page(page: &Path, is_unwanted: bool) -> bool {
    !is_unwanted && has_desktop() && open::that_detached(page).is_ok()
}

/// Whether this process can open windows.
fn has_desktop() -> bool {
    let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    if cfg!(any(windows, target_os = "macos")) {
        return !is_set("SSH_CONNECTION");
    }
    is_set("DISPLAY") || is_set("WAYLAND_DISPLAY")
}

/// The place of the photographs in a command line that names no command: `make` belongs before it.
pub(super) fn place_of_photographs(
    command: &clap::Command,
    arguments: &[OsString],
) -> Option<usize> {
    let is_flag = |word: &OsString| word.to_string_lossy().starts_with("-v") || word == "--verbose";
    let at = 1 + arguments.iter().skip(1).take_while(|word| is_flag(word)).count();
    let first = arguments.get(at)?.to_string_lossy();
    let is_path = !first.starts_with('-') && Path::new(first.as_ref()).exists();
    (is_path && first != "help" && command.find_subcommand(first.as_ref()).is_none()).then_some(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_in_place_of_a_command_is_made() {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().to_str().unwrap();
        let command = crate::cli::help::command(false);
        let found = |line: &[&str]| {
            let words: Vec<OsString> = line.iter().map(OsString::from).collect();
            place_of_photographs(&command, &words)
        };
        assert_eq!(found(&["nightsplat", photos, "--no-open"]), Some(1));
        assert_eq!(found(&["nightsplat", "-v", photos]), Some(2));
        for line in
            [&["nightsplat"][..], &["nightsplat", "train", photos], &["nightsplat", "--help"]]
        {
            assert_eq!(found(line), None);
        }
        assert_eq!(found(&["nightsplat", &format!("{photos}/absent")]), None);
    }

    #[test]
    fn the_time_is_told_as_coarsely_as_it_is_known() {
        let stages = [(MakeStage::Cameras, Some(340.0)), (MakeStage::Training, Some(200.0))];
        let line =
            "about 9 min in all, a coarse estimate: cameras about 6 min, training about 3 min";
        assert_eq!(expected(&stages), line);
        let line = expected(&[(MakeStage::Cameras, None), (MakeStage::Page, Some(10.0))]);
        assert!(line.starts_with("about 10 s and more in all"), "{line}");
    }
}
