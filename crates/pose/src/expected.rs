//! How long COLMAP takes, coarsely, before it begins: within a factor of two or three.

use std::path::{Path, PathBuf};

use nightsplat_photographs::image::{Image, ImageFile};

use super::pictures::PosePhotographs;
use super::reconstruction::Matcher;

/// Neighbours by name that the sequential matcher pairs a photograph with.
const NEIGHBOURS: f64 = 10.0;
/// Processor seconds of a megapixel's features, of a pair of photographs, and of a camera, measured with COLMAP 3.8 on
/// processors. Photographs above the size to which COLMAP shrinks them take no longer.
const FEATURES: f64 = 2.0;
const PAIR: f64 = 0.3;
const CAMERA: f64 = 0.6;
const LARGEST: f64 = 3200.0 * 2400.0;

/// Seconds of features, matching and cameras of these photographs on this machine.
pub(super) fn seconds(pictures: &PosePhotographs, matcher: Matcher) -> [f64; 3] {
    let count = pictures.dark.len() + pictures.bright.len();
    seconds_of(count, pictures.dark.first().map(PathBuf::as_path), matcher)
}

/// [`seconds`] of as many photographs as the first.
pub(super) fn seconds_of(count: usize, first: Option<&Path>, matcher: Matcher) -> [f64; 3] {
    let pixels = first.and_then(|first| Image::size_of(first).ok());
    let pixels = pixels.map_or(12e6, |(width, height)| f64::from(width) * f64::from(height));
    let (count, megapixels) = (count as f64, pixels.min(LARGEST) / 1e6);
    let pairs = match matcher {
        Matcher::Exhaustive => 0.5 * count * (count - 1.0).max(0.0),
        Matcher::Sequential => NEIGHBOURS * count,
    };
    // More pixels have more features, of which COLMAP keeps 8192.
    let features = (megapixels / 0.5).sqrt().clamp(0.5, 3.0);
    let cores = std::thread::available_parallelism().map_or(1.0, |cores| cores.get() as f64);
    [FEATURES * count * megapixels, PAIR * pairs * features, CAMERA * count * features]
        .map(|seconds| seconds / cores)
}
