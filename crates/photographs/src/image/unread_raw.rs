//! Camera RAW in a build without its decoder: `raw` has the same functions.

use std::path::Path;

use nightsplat_core::{Error, Result};

use super::Image;
use super::files::RAW_REMEDY;

pub(super) fn load(path: &Path, _: Vec<u8>) -> Result<Image> {
    Err(unread(path))
}

pub(super) fn size_of(path: &Path, _: Vec<u8>) -> Result<(u32, u32)> {
    Err(unread(path))
}

fn unread(path: &Path) -> Error {
    Error::input(path, format!("is camera RAW, which this build does not read; {RAW_REMEDY}"))
}
