//! Small synthetic datasets, and changes of their photographs.

#![allow(dead_code, reason = "no test binary uses everything")]

use std::path::Path;

use nightsplat_photographs::image::{Image, ImageFile as _, linear_from_srgb, srgb_from_linear};
use nightsplat_synth::{Capture, SyntheticOptions};

use crate::common::{Folder, paths};

/// A synthetic set of this many views of a size.
pub(crate) fn small_set(views: usize, [width, height]: [u32; 2], seed: u64) -> SyntheticOptions {
    SyntheticOptions { views, width, height, seed, ..SyntheticOptions::default() }
}

/// A folder with a synthetic set.
pub(crate) fn written(options: &SyntheticOptions) -> Folder {
    captured(options, &Capture::default())
}

/// [`written`], as captured in this way.
pub(crate) fn captured(options: &SyntheticOptions, capture: &Capture) -> Folder {
    let folder = Folder::empty();
    nightsplat_synth::write_captured(&folder, options, capture).unwrap();
    folder
}

/// Replaces the photographs of a set that are trained on.
pub(crate) fn repaint(set: &Path, change: impl Fn(usize, &Image) -> Image) {
    for (index, path) in paths(&set.join("low")).iter().enumerate() {
        change(index, &Image::load(path).unwrap()).save_png8(path).unwrap();
    }
}

/// Changes the linear light of the photographs of a set: a function of photograph, column, row and light.
pub(crate) fn relit(set: &Path, change: impl Fn(usize, [u32; 2], f64) -> f64) {
    repaint(set, |index, image| {
        let pixel = |x, y| {
            let light = |value: f32| change(index, [x, y], linear_from_srgb(value).into()) as f32;
            image.pixel(x, y).map(|value| srgb_from_linear(light(value)).clamp(0.0, 1.0))
        };
        Image::from_fn(image.width, image.height, pixel)
    });
}

/// A room, which a lamp that moves with the camera may light.
pub(crate) fn lamp_set(lamp: Option<f64>) -> SyntheticOptions {
    SyntheticOptions { views: 20, width: 96, height: 72, seed: 4, lamp, ..Default::default() }
}

/// Exposures that have nothing to do with where the cameras are.
pub(crate) fn varying() -> Capture {
    Capture { stops: vec![0.0, -1.0, 0.6, -0.4, 0.3, 0.8, -0.7], ..Capture::default() }
}

/// A dark set whose training photographs are changed by a function of photograph, column, row and linear light.
pub(crate) fn changed(change: impl Fn(usize, [u32; 2], f64) -> f64) -> Folder {
    let capture = Capture { darkening: 6.0, ..Capture::default() };
    let folder = captured(&small_set(16, [96, 72], 4), &capture);
    relit(&folder, change);
    folder
}

/// The distance from the middle, 1 at a corner.
pub(crate) fn off([x, y]: [u32; 2]) -> f64 {
    let half = [48.0, 36.0];
    (f64::from(x) + 0.5 - half[0]).hypot(f64::from(y) + 0.5 - half[1]) / half[0].hypot(half[1])
}

pub(crate) fn vignetted() -> Folder {
    changed(|_, at, light| light / (1.0 + off(at).powi(2)).powi(2))
}

/// Two and a half bands with a third more or less light, elsewhere in each photograph; the light of a row.
pub(crate) fn band(index: usize, y: f64) -> f64 {
    1.0 + 0.35 * (std::f64::consts::TAU * y / 28.8 + 2.4 * index as f64).sin()
}

pub(crate) fn banded() -> Folder {
    changed(|index, [_, y], light| light * band(index, f64::from(y) + 0.5))
}
