//! `nightsplat synth`: writes a small dark multi-view dataset with references.

use std::path::PathBuf;

use nightsplat_synth::{self, CameraFaults, Capture, Night, SyntheticOptions};

use super::{finish, word};
use crate::Error;

/// Write a small dark multi-view dataset of an analytic scene, with references, in the layout of LOM.
#[derive(Clone, Debug, clap::Args)]
pub struct SynthArgs {
    /// Folder to write to
    pub dir: PathBuf,
    /// A street of this many plots, whose light falls eightfold along it; each view sees about three of them
    #[arg(long, value_name = "PLOTS", conflicts_with = "fisheye")]
    pub street: Option<u32>,
    /// Number of photographs; every 8th is a test view [default: 24; of a street, 6 a plot]
    #[arg(long)]
    pub views: Option<usize>,
    /// Width, pixels [default: 160; of a street, 128]
    #[arg(long)]
    pub width: Option<u32>,
    /// Height, pixels [default: 120; of a street, 96]
    #[arg(long)]
    pub height: Option<u32>,
    /// Seed of textures, noise and sampled points
    #[arg(long, default_value_t = SyntheticOptions::default().seed)]
    pub seed: u64,
    /// Use a fisheye lens (`OPENCV_FISHEYE`) of 130 degrees across the longer side
    #[arg(long)]
    pub fisheye: bool,
    /// Light the photographs by a lamp that is fixed to the camera, such as a headlamp, of half its strength this many
    /// degrees off its axis; `high/` stays evenly lit, and `lit/` has the test views in the lamp's light, bright and
    /// without noise [of --lamp alone: 16]
    #[arg(long, value_name = "DEGREES", num_args = 0..=1, require_equals = true, default_missing_value = "16")]
    pub lamp: Option<f64>,
    /// Write the normal map of every training view to `normals/`, for `train --parts normals`
    #[arg(long)]
    pub normals: bool,
    /// What the scene has at night
    #[command(flatten)]
    pub night: Night,
    /// What the camera does wrong
    #[command(flatten)]
    pub faults: CameraFaults,
    /// Expose a third of the photographs this many stops shorter, and a third as much longer [of --brackets alone: 2]
    #[arg(long, value_name = "STOPS", num_args = 0..=1, require_equals = true, default_missing_value = "2")]
    pub brackets: Option<f64>,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long)]
    pub overwrite: bool,
}

/// Writes the dataset.
pub fn run(args: SynthArgs) -> anyhow::Result<()> {
    let SynthArgs { dir, street, views, width, height, seed, fisheye, lamp, night, faults, .. } =
        args;
    let usual = street.map_or_else(SyntheticOptions::default, SyntheticOptions::street);
    let options = SyntheticOptions {
        views: views.unwrap_or(usual.views),
        width: width.unwrap_or(usual.width),
        height: height.unwrap_or(usual.height),
        seed,
        fisheye,
        lamp,
        night,
        normals: args.normals,
        ..usual
    };
    let stops = args.brackets.map_or(vec![0.0], |stops| vec![-stops, 0.0, stops]);
    let capture = Capture { faults, stops, ..Capture::default() };
    let is_empty = std::fs::read_dir(&dir).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !args.overwrite {
        let problem = "is not empty; choose another folder or pass --overwrite";
        return Err(Error::output(dir, problem).into());
    }
    nightsplat_synth::write_captured(&dir, &options, &capture)?;
    let SyntheticOptions { views, width, height, .. } = options;
    let wrote = format!("{}: {views} views of {width}x{height}", dir.display());
    finish(&wrote, &format!("nightsplat train {} --out run", word(&dir)));
    Ok(())
}
