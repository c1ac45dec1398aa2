//! `nightsplat synth`: write a small dark multi-view set with known references.

use std::path::PathBuf;

use crate::photographs::dataset::synthetic::{self, SyntheticOptions};
use crate::{Error, Result};

/// Write a small dark multi-view set, made from an analytic scene, in the layout of the LOM benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct SynthArgs {
    /// The folder to write to; made if it does not exist.
    pub dir: PathBuf,
    /// Photographs; every 8th is for testing.
    #[arg(long, default_value_t = SyntheticOptions::default().views)]
    pub views: usize,
    /// Pixels per row.
    #[arg(long, default_value_t = SyntheticOptions::default().width)]
    pub width: u32,
    /// Rows.
    #[arg(long, default_value_t = SyntheticOptions::default().height)]
    pub height: u32,
    /// Changes the textures, the noise and the sampled points.
    #[arg(long, default_value_t = SyntheticOptions::default().seed)]
    pub seed: u64,
    /// Take the photographs with a fisheye (`OPENCV_FISHEYE`) that sees 130 degrees across the longer side
    #[arg(long)]
    pub fisheye: bool,
    /// Write into a folder that is not empty; files of the same names are replaced.
    #[arg(long)]
    pub overwrite: bool,
}

/// Writes the set.
///
/// # Errors
/// [`Error::Output`] where the folder is not empty and `--overwrite` is not given, and those of [`synthetic::write`].
pub fn run(args: SynthArgs) -> Result<()> {
    let SynthArgs { dir, views, width, height, seed, fisheye, overwrite } = args;
    let is_empty = std::fs::read_dir(&dir).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !overwrite {
        return Err(Error::output(dir, "is not empty; choose another folder or pass --overwrite"));
    }
    synthetic::write(&dir, &SyntheticOptions { views, width, height, seed, fisheye })?;
    tracing::info!("{views} views of {width}x{height} are in {}", dir.display());
    Ok(())
}
