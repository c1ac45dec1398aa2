//! Depth maps next to photographs.

use std::path::Path;

use nightsplat_core::{Error, Result};

use super::prepare::{Preparation, check_excess};
use crate::image::Image;
use crate::image::ImageFile as _;

/// The depth map as seen by the view's camera, (H, W); larger is farther.
pub(super) fn depth_map(
    path: &Path,
    preparation: &Preparation<'_>,
    is_disparity: bool,
) -> Result<Vec<f32>> {
    let lens = preparation.lens;
    check_excess(path, Image::size_of(path)?, lens)?;
    let mut map = Image::load_as_stored(path)?;
    if (map.width, map.height) != (lens.width, lens.height) {
        let (w, h) = (lens.width, lens.height);
        let (width, height) = (map.width, map.height);
        tracing::info!("{}: is {width}x{height}; resized to {w}x{h}", path.display());
        map = map.resized(w, h);
    }
    let (width, height) = preparation.size;
    let mut depth = preparation.undistorted(map).resized(width, height).data;
    depth.truncate(width as usize * height as usize);
    if let Some(value) = depth.iter().find(|value| !value.is_finite()) {
        return Err(Error::input(path, format!("holds a depth of {value}")));
    }
    if depth.iter().all(|&value| value == depth[0]) {
        return Err(Error::input(path, "is the same everywhere"));
    }
    // Only ratios matter; the squares of larger values would overflow.
    let largest = depth.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
    if !(1e-12..1e12).contains(&largest) {
        depth.iter_mut().for_each(|value| *value /= largest);
    }
    if is_disparity {
        depth.iter_mut().for_each(|value| *value = -*value);
    }
    Ok(depth)
}
