//! `nightsplat vary`: writes a set of varying exposure.

use std::path::PathBuf;
use std::str::FromStr;

use nightsplat_photographs::dataset::{Dataset, LoadOptions, bright_folder};
use nightsplat_synth::varied::{self, Variation};

use super::{finish, word};
use crate::Error;

/// Write a set of varying exposure from one in normal light, with the clean photographs as references.
///
/// Every photograph gets a drawn number of stops, in linear light and clipped at white, and a drawn gamma. The same
/// seed gives the same bytes. varied.csv has the drawn numbers. Of a dataset that also has dark photographs, those in
/// `high` or `images` are taken. The set is nightsplat's own: the pictures of the published benchmark (Mip-NeRF 360,
/// varying) are of an unpublished generator.
#[derive(Clone, Debug, clap::Args)]
pub struct VaryArgs {
    /// Dataset in normal light
    pub bright: PathBuf,
    /// Folder to write to
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// The most stops by which a photograph is brighter or darker
    #[arg(long, default_value_t = 2.0, value_name = "STOPS")]
    pub stops: f64,
    /// The smallest and the largest gamma of encoded values
    #[arg(long, default_value = "1,1", value_name = "LOW,HIGH")]
    pub gamma: Gamma,
    /// Seed of the drawn numbers
    #[arg(long, default_value_t = 1, value_name = "S")]
    pub seed: u64,
    /// Resize the photographs by 1/F
    #[arg(long, default_value_t = 1.0, value_name = "F")]
    pub downscale: f64,
    /// Use every Nth view by name as a test view, instead of the dataset's split
    #[arg(long, value_name = "N")]
    pub test_every: Option<usize>,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long)]
    pub overwrite: bool,
}

/// A range of exponents.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gamma(pub [f64; 2]);

impl FromStr for Gamma {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (low, high) = text.split_once(',').unwrap_or((text, text));
        let number = |text: &str| text.trim().parse().ok();
        let both = number(low).zip(number(high));
        both.map(|(low, high)| Self([low, high]))
            .ok_or_else(|| "is not LOW,HIGH, two numbers such as 0.8,1.25".to_owned())
    }
}

/// Writes the set.
pub fn run(args: &VaryArgs) -> anyhow::Result<()> {
    let VaryArgs { bright, out, stops, gamma, seed, downscale, test_every, overwrite } = args;
    let is_empty = std::fs::read_dir(out).map_or(true, |mut entries| entries.next().is_none());
    if !is_empty && !overwrite {
        let problem = "is not empty; choose another folder or pass --overwrite";
        return Err(Error::output(out, problem).into());
    }
    let options = LoadOptions {
        images: bright_folder(bright),
        downscale: *downscale,
        test_every: *test_every,
        mask_borders: false,
        mask_overlays: false,
        undistort: true,
        ..LoadOptions::default()
    };
    let dataset = Dataset::load(bright, &options)?;
    let variation = Variation { stops: *stops, gamma: gamma.0, seed: *seed };
    let count = varied::write(out, &dataset, &variation)?;
    let wrote = format!("{}: {count} photographs, up to {stops} stops off", out.display());
    finish(&wrote, &format!("nightsplat train {} --out run", word(out)));
    Ok(())
}
