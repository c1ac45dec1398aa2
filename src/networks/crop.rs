//! Padded crops: the rectangle of a view that the networks run on.
//!
//! The networks' losses are means over pixels, so a random crop estimates them without bias. The output of a crop's
//! pixels depends on a margin around them, the receptive field: a padded crop is the crop with its margin, clipped to
//! the image, at whose borders the zero padding is that of the whole view.

use std::ops::Range;

use glam::UVec2;
use nightsplat_core::random::Stream;

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{crop_gather, crop_scatter};
use crate::{Error, Result};

/// A padded crop of a view, and the crop within it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PaddedCrop {
    /// The padded crop's corner in the view, pixels.
    pub origin: UVec2,
    /// The padded crop's size, pixels.
    pub size: UVec2,
    /// The crop's corner in the padded crop, pixels.
    pub crop_origin: UVec2,
    /// The crop's size, pixels.
    pub crop_size: UVec2,
}

impl PaddedCrop {
    /// The whole view.
    pub fn whole(view: UVec2) -> Self {
        Self { origin: UVec2::ZERO, size: view, crop_origin: UVec2::ZERO, crop_size: view }
    }

    /// A random crop with a margin of `margin` pixels: one of the equal cells, at most `side` pixels wide and high,
    /// into which the view is divided. It is the cell of a uniformly drawn pixel, so that the expectation of means over
    /// crops is the mean over the view: crops at random corners would favour the middle of the view. The draw depends
    /// only on the stream and `draw`.
    pub fn random(view: UVec2, side: u32, margin: u32, stream: &Stream, draw: u64) -> Self {
        let cells = UVec2::new(view.x.div_ceil(side), view.y.div_ceil(side));
        let uniform = |axis: u64, extent: u32| {
            ((stream.uniform(2 * draw + axis) * f64::from(extent)) as u32).min(extent - 1)
        };
        let pixel = UVec2::new(uniform(0, view.x), uniform(1, view.y));
        // Cell i of n begins at floor(i view / n): its pixels x are those with floor(((x + 1) n - 1) / view) = i.
        let cell = ((pixel + 1) * cells - 1) / view;
        let [corner, crop_end] = [cell, cell + 1].map(|cell| cell * view / cells);
        let origin = corner.saturating_sub(UVec2::splat(margin));
        let end = crop_end.saturating_add(UVec2::splat(margin)).min(view);
        Self {
            origin,
            size: end - origin,
            crop_origin: corner - origin,
            crop_size: crop_end - corner,
        }
    }
}

/// Copies padded crops out of images, and adds them back.
#[derive(Debug)]
pub struct CropKernels {
    gather: Pipeline<crop_gather::Kernel>,
    scatter: Pipeline<crop_scatter::Kernel>,
}

impl CropKernels {
    /// Builds the kernels.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self {
            gather: gpu.pipeline(&crop_gather::Constants::default())?,
            scatter: gpu.pipeline(&crop_scatter::Constants::default())?,
        })
    }

    /// Records `content = image[planes, crop]`; `image` is (planes, H, W) of a view of `size`.
    pub fn gather(
        &self,
        pass: &mut Recorder<'_>,
        image: &Buffer<f32>,
        size: UVec2,
        planes: Range<usize>,
        crop: &PaddedCrop,
        content: &mut Buffer<f32>,
    ) -> Result<()> {
        check(image, size, &planes, crop, content)?;
        let plane_count = planes.len() as u32;
        let (origin, first_plane) = (crop.origin, planes.start as u32);
        let crop = crop.size;
        pass.dispatch(
            &self.gather,
            &crop_gather::Params { size, origin, crop, first_plane, plane_count },
            crop_gather::Buffers { image: image.slice(), content: content.slice_mut() },
            Threads::Exactly([plane_count * crop.element_product(), 1, 1]),
        )
    }

    /// Records `image[planes, crop] += content`.
    pub fn scatter(
        &self,
        pass: &mut Recorder<'_>,
        content: &Buffer<f32>,
        crop: &PaddedCrop,
        planes: Range<usize>,
        size: UVec2,
        image: &mut Buffer<f32>,
    ) -> Result<()> {
        check(image, size, &planes, crop, content)?;
        let plane_count = planes.len() as u32;
        let (origin, first_plane) = (crop.origin, planes.start as u32);
        let crop = crop.size;
        pass.dispatch(
            &self.scatter,
            &crop_scatter::Params { size, origin, crop, first_plane, plane_count },
            crop_scatter::Buffers { content: content.slice(), image: image.slice_mut() },
            Threads::Exactly([plane_count * crop.element_product(), 1, 1]),
        )
    }
}

/// A kernel that exceeds a buffer corrupts other data, so lengths are checked before anything is recorded.
fn check(
    image: &Buffer<f32>,
    size: UVec2,
    planes: &Range<usize>,
    crop: &PaddedCrop,
    content: &Buffer<f32>,
) -> Result<()> {
    let pixels = |size: UVec2| size.x as usize * size.y as usize;
    if (crop.origin + crop.size).cmpgt(size).any() {
        return Err(Error::Usage(format!("{crop:?} is not inside a view of {size} pixels")));
    }
    for (buffer, needed) in
        [(image, planes.end * pixels(size)), (content, planes.len() * pixels(crop.size))]
    {
        if buffer.len() < needed {
            let (name, len) = (buffer.name(), buffer.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {len} values, the crop needs {needed}"
            )));
        }
    }
    Ok(())
}
