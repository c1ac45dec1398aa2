//! A run of a sweep: a `nightsplat train` process with its run directory.

use std::ffi::OsString;
use std::path::Path;

use clap::Args;

use super::arguments::arguments_of;
use crate::cli::quoted;
use crate::cli::train::TrainArgs;
use crate::results::run;
use crate::results::sweep::{PRESET, SweepPoint, SweepRun};
use crate::train::TrainConfig;
use crate::train::plan::Plan;
use crate::{Error, Result};

/// A run with the arguments of its training.
#[derive(Clone, Debug)]
pub(super) struct SweepTraining {
    pub(super) run: SweepRun,
    /// Arguments of `nightsplat`.
    pub(super) arguments: Vec<String>,
    /// Configuration by these arguments, without a plan.
    pub(super) config: TrainConfig,
    args: TrainArgs,
}

impl SweepTraining {
    /// The run of a point with the options `shared`, in a folder of `out`; both paths are absolute. Points with a
    /// preset train with its plan for the photographs, as `train --preset` does; others train without a plan, so that
    /// they differ in nothing but their settings.
    pub(super) fn new(
        point: SweepPoint,
        dataset: &str,
        shared: &[String],
        out: &Path,
    ) -> Result<Self> {
        let name = point.name();
        let folder = out.join(&name);
        let mut arguments = vec!["train".to_owned(), dataset.to_owned()];
        arguments.extend_from_slice(shared);
        arguments.extend(arguments_of(&point));
        let end = ["--out".to_owned(), unicode(&folder)?, "--resume".to_owned()];
        let mut args: TrainArgs = parsed(&name, arguments.iter().chain(&end))?;
        if point.value(PRESET).is_none() || !args.options.wants_a_plan() {
            arguments.extend(["--plan", "none"].map(str::to_owned));
            args.plan = Some("none".into());
        }
        arguments.extend(end);
        let config = args.options.config(&args.dataset, None)?;
        Ok(Self { run: SweepRun { name, point, folder }, arguments, config, args })
    }

    /// Whether the run directory contains this run, finished.
    pub(super) fn is_finished(&self) -> Result<bool> {
        let path = self.run.folder.join("config.toml");
        if !path.exists() {
            return Ok(false);
        }
        let found = run::load_config(&self.run.folder)?;
        let plan = if self.args.plan.is_none() { run::plan_of(&self.run.folder) } else { None };
        let plan = plan.map(|path| Plan::read(&path)).transpose()?;
        let config = self.args.options.config(&self.args.dataset, plan.as_ref())?;
        let config = config.with_absolute_paths();
        // A run records its tile, frame and up direction; if none is required, any matches.
        let (tile, frame) = (config.tile.and(found.tile), config.frame.and(found.frame));
        let found = TrainConfig { tile, frame, up: config.up.and(found.up), ..found };
        if found != config {
            let differs = difference(&found.to_toml()?, &config.to_toml()?);
            let problem = format!("contains another run ({differs}); choose another --out");
            return Err(Error::output(&self.run.folder, problem));
        }
        Ok(self.run.metrics().is_some())
    }

    /// The command for a shell; repeating it is safe.
    pub(super) fn command_line(&self) -> Result<String> {
        let program = std::env::current_exe()
            .map_err(|error| Error::input("nightsplat", format!("cannot be found: {error}")))?;
        let words = std::iter::once(unicode(&program)?).chain(self.arguments.iter().cloned());
        Ok(words.map(|word| quoted(&word)).collect::<Vec<_>>().join(" "))
    }
}

/// Parses the arguments of a command, its name first.
pub(in crate::cli) fn parsed<A: Args>(
    what: &str,
    arguments: impl IntoIterator<Item: Into<OsString> + Clone>,
) -> Result<A> {
    let matches = A::augment_args(clap::Command::new("")).try_get_matches_from(arguments);
    matches.and_then(|matches| A::from_arg_matches(&matches)).map_err(|error| {
        let text = error.to_string();
        let line = text.lines().next().unwrap_or_default();
        Error::Usage(format!("{what}: {}", line.trim_start_matches("error: ")))
    })
}

/// The first line of `found` that `wanted` lacks.
pub(super) fn difference(found: &str, wanted: &str) -> String {
    let wanted: Vec<&str> = wanted.lines().collect();
    let is_new = |line: &&str| !wanted.contains(line);
    let line = found.lines().find(is_new).unwrap_or("its configuration lacks a setting");
    line.to_owned()
}

/// The absolute path as an argument.
pub(super) fn absolute(path: &Path) -> Result<String> {
    let path = std::path::absolute(path)
        .map_err(|error| Error::input(path, format!("cannot be found: {error}")))?;
    unicode(&path)
}

pub(super) fn unicode(path: &Path) -> Result<String> {
    path.to_str().map(str::to_owned).ok_or_else(|| {
        Error::Usage(format!("{} is not Unicode; move it to a path that is", path.display()))
    })
}
