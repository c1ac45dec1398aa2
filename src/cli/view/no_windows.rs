//! `--window` in a build without windows.

use std::path::Path;

use super::ViewArgs;
use crate::gpu::{DeviceChoice, Gpu};
use crate::photographs::dataset::Dataset;
use crate::results::run::Requests;
use crate::{Error, Result};

/// The display of this machine, which nothing makes.
pub(in crate::cli) struct Screen {
    pub(in crate::cli) gpu: Gpu,
}

fn refused<T>() -> Result<T> {
    let problem = "this build has no windows; build it with `cargo install --locked --path . --features window`, or \
                   leave --window out";
    Err(Error::Usage(problem.to_owned()))
}

pub(super) fn run(_: &ViewArgs) -> Result<()> {
    refused()
}

pub(in crate::cli) fn screen(_: &DeviceChoice) -> Result<Screen> {
    refused()
}

/// Trains; there is no screen to show it on.
pub(in crate::cli) fn beside<T>(
    _: Screen,
    _: (&Path, &Dataset),
    _: &Requests,
    train: impl FnOnce() -> Result<T>,
) -> Result<T> {
    train()
}
