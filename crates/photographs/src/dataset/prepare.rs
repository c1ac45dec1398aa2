//! From a decoded image to that of its view.

use std::path::Path;

use glam::DAffine3;
use nightsplat_core::camera::{Camera, CameraModel, Lens};
use nightsplat_core::{Error, Result};
use rayon::prelude::*;

use super::shading::Shading;
use super::turns::Turns;
use super::undistort::Undistortion;
use crate::image::{Image, Mask, Orientation, PictureFile, linear_from_srgb, srgb_from_linear};

/// The conversion of the photographs of one lens to the images of their views.
#[derive(Debug)]
pub(super) struct Preparation<'a> {
    /// The lens at the photographs' size.
    pub(super) lens: &'a Lens,
    /// `None` if the lens is rendered natively.
    pub(super) undistortion: Option<Undistortion>,
    /// Width and height that the views are loaded at.
    pub(super) size: (u32, u32),
}

impl<'a> Preparation<'a> {
    /// With `undistort`, a fisheye is undistorted as a polynomial lens always is.
    pub(super) fn new(
        lens: &'a Lens,
        undistort: bool,
        size: (u32, u32),
        name: &str,
    ) -> Result<Self> {
        let native = lens.model().filter(|&model| model == CameraModel::Pinhole || !undistort);
        let undistortion = match native {
            Some(_) => None,
            None => Some(Undistortion::new(lens).ok_or_else(|| no_lens(name))?),
        };
        Ok(Self { lens, undistortion, size })
    }

    /// The image as its view shows it, at the lens's size: undistorted if requested.
    pub(super) fn whole(&self, image: Image, path: &Path) -> Result<Image> {
        let &Lens { width, height, .. } = self.lens;
        let size = (image.width, image.height);
        if self.lens.fitted(size.0, size.1).is_none() {
            return Err(disagreement(path, size, self.lens));
        }
        // A reference image may have another resolution than the photograph.
        let image = if size == (width, height) { image } else { image.resized(width, height) };
        Ok(self.undistorted(image))
    }

    /// As [`Self::whole`], for a photograph with this shading.
    pub(super) fn photograph(&self, image: Image, path: &Path, shading: Shading) -> Result<Image> {
        let mut image = self.whole(image, path)?;
        let camera = self.camera().resized(self.lens.width, self.lens.height);
        shading.even_out(&mut image, &camera);
        Ok(image)
    }

    /// As [`Self::whole`], at the size of the loaded view.
    pub(super) fn loaded(&self, image: Image, path: &Path) -> Result<Image> {
        self.whole(image, path).map(|image| self.shrunk(image))
    }

    pub(super) fn shrunk(&self, image: Image) -> Image {
        let (width, height) = self.size;
        if (image.width, image.height) == self.size { image } else { image.resized(width, height) }
    }

    /// As [`Self::shrunk`], by the mean of linear light: encoding and tone curves bend within the noise of a sensor, so
    /// that what is averaged after them is too dark.
    pub(super) fn shrunk_in_light(&self, mut image: Image) -> Image {
        if (image.width, image.height) == self.size {
            return image;
        }
        image.data.par_iter_mut().for_each(|x| *x = linear_from_srgb(*x));
        let mut image = self.shrunk(image);
        image.data.par_iter_mut().for_each(|x| *x = srgb_from_linear(*x));
        image
    }

    pub(super) fn undistorted(&self, image: Image) -> Image {
        match &self.undistortion {
            Some(undistortion) => undistortion.apply(&image),
            None => image,
        }
    }

    /// The usable pixels of a view, for a mask of the photograph as stored; `None` if all are usable.
    pub(super) fn mask(
        &self,
        stored: &Mask,
        path: &Path,
        orientation: Orientation,
    ) -> Result<Option<Mask>> {
        let plane = orientation.upright(stored.to_image());
        Ok(Mask::of_plane(&self.loaded(plane, path)?))
    }

    /// The camera of its views at the world's origin, at the size of the loaded views.
    pub(super) fn camera(&self) -> Camera {
        let camera = native_camera(self.lens);
        let camera = match self.undistortion {
            Some(Undistortion { focal, .. }) => {
                Camera { focal, model: CameraModel::Pinhole, ..camera }
            }
            None => camera,
        };
        camera.resized(self.size.0, self.size.1)
    }

    /// Refuses a natively rendered lens that sees nothing at three quarters of its pixels: the circle of a fisheye in a
    /// wide image covers more than a quarter.
    pub(super) fn check_coverage(&self, name: &str) -> Result<()> {
        const MOST_UNSEEN: f64 = 0.75;
        let &Lens { width, height, .. } = self.lens;
        let unseen = match self.undistortion {
            Some(_) => 0,
            None => native_camera(self.lens).unseen().len(),
        };
        let is_covered = unseen as f64 <= MOST_UNSEEN * pixel_count((width, height)) as f64;
        if is_covered { Ok(()) } else { Err(no_lens(name)) }
    }
}

fn no_lens(name: &str) -> Error {
    Error::input(
        name,
        "its distortion coefficients describe no lens; calibrate again or undistort with COLMAP",
    )
}

/// A lens at the world's origin, as rendered without undistortion.
fn native_camera(lens: &Lens) -> Camera {
    Camera {
        width: lens.width,
        height: lens.height,
        focal: lens.focal,
        principal_point: lens.principal_point,
        model: lens.model().unwrap_or_default(),
        view_from_world: DAffine3::IDENTITY,
    }
}

/// Refuses a file by its declared size, before memory is allocated.
pub(super) fn check_size(path: &Path, file: &PictureFile, turns: Turns, lens: &Lens) -> Result<()> {
    // A file without a readable header is reported when it is decoded.
    let Ok(size) = file.decoded_size() else { return Ok(()) };
    let (width, height) = turns.loading.size(size);
    if lens.fitted(width, height).is_none() {
        return Err(disagreement(path, size, lens));
    }
    check_excess(path, (width, height), lens)
}

pub(super) fn check_excess(path: &Path, size: (u32, u32), lens: &Lens) -> Result<()> {
    const MAX_TIMES: u64 = 64;
    if pixel_count(size) > MAX_TIMES * pixel_count((lens.width, lens.height)) {
        let (width, height) = size;
        let (w, h) = (lens.width, lens.height);
        let problem = format!(
            "is {width}x{height}, over {MAX_TIMES} times the pixels of its view's {w}x{h}; shrink it"
        );
        return Err(Error::input(path, problem));
    }
    Ok(())
}

pub(super) fn pixel_count((width, height): (u32, u32)) -> u64 {
    u64::from(width) * u64::from(height)
}

/// The error for an image whose aspect ratio, upright or not, is not its camera's.
pub(super) fn disagreement(path: &Path, (width, height): (u32, u32), lens: &Lens) -> Error {
    let (w, h) = (lens.width, lens.height);
    let (seen_width, seen_height) = Orientation::from_file(path).size((width, height));
    let seen = if seen_width == width {
        String::new()
    } else {
        format!(" (upright {seen_width}x{seen_height})")
    };
    let padded = if lens.is_of_patches() {
        ", or take back in the cameras how a network (VGGT) padded or cropped them"
    } else {
        ""
    };
    let problem = format!(
        "is {width}x{height}{seen} but its camera is {w}x{h}; use the photographs that the cameras were made \
         with{padded}"
    );
    Error::input(path, problem)
}
