//! `nightsplat synth`: writes a small dark multi-view dataset with references.

use std::path::PathBuf;

use super::{finish, word};
use crate::Error;
use crate::photographs::dataset::synthetic::{self, SyntheticOptions};

/// Write a small dark multi-view dataset of an analytic scene, with references, in the layout of LOM.
#[derive(Clone, Debug, clap::Args)]
pub struct SynthArgs {
    /// Folder to write to
    pub dir: PathBuf,
    /// Number of photographs; every 8th is a test view
    #[arg(long, default_value_t = SyntheticOptions::default().views)]
    pub views: usize,
    /// Width, pixels
    #[arg(long, default_value_t = SyntheticOptions::default().width)]
    pub width: u32,
    /// Height, pixels
    #[arg(long, default_value_t = SyntheticOptions::default().height)]
    pub height: u32,
    /// Seed of textures, noise and sampled points
    #[arg(long, default_value_t = SyntheticOptions::default().seed)]
    pub seed: u64,
    /// Use a fisheye lens (`OPENCV_FISHEYE`) of 130 degrees across the longer side
    #[arg(long)]
    pub fisheye: bool,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long)]
    pub overwrite: bool,
}

/// Writes the dataset.
///
/// # Errors
/// [`Error::Output`] if the folder is not empty and `--overwrite` is not given, and those of [`synthetic::write`].
pub fn run(args: SynthArgs) -> anyhow::Result<()> {
    let SynthArgs { dir, views, width, height, seed, fisheye, overwrite } = args;
    let is_empty = std::fs::read_dir(&dir).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !overwrite {
        let problem = "is not empty; choose another folder or pass --overwrite";
        return Err(Error::output(dir, problem).into());
    }
    synthetic::write(&dir, &SyntheticOptions { views, width, height, seed, fisheye })?;
    let wrote = format!("{}: {views} views of {width}x{height}", dir.display());
    finish(&wrote, &format!("nightsplat train {} --out run", word(&dir)))
}
