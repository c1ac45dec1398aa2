//! Synthetic sets: their layout, light, nights and lamps.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

#[path = "../../../../tests/common/files.rs"]
mod common;
#[path = "../../../../tests/common/sets.rs"]
mod sets;

mod lamp;
mod night;
mod street;
mod synthetic;

use std::path::Path;

use nightsplat_photographs::dataset::{Dataset, LoadOptions};
use nightsplat_photographs::image::{Image, ImageFile as _, linear_from_srgb};

use sets::{captured, written};

fn loaded(folder: &Path) -> Dataset {
    Dataset::load(folder, &LoadOptions::default()).unwrap()
}

fn image(folder: &Path, name: &str) -> Image {
    Image::load(folder.join(name)).unwrap()
}

/// The mean in linear light.
fn light(image: &Image) -> f64 {
    let values = image.data.iter().map(|&value| f64::from(linear_from_srgb(value)));
    values.sum::<f64>() / image.data.len() as f64
}
