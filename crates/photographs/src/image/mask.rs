//! Masks of photographs, from alpha channels and mask files.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use nightsplat_core::{Error, Result};

use super::Image;
use super::{Orientation, decode::PictureFile, reduced_size};
use crate::image::ImageFile as _;

/// A weight for every pixel of an image: 1 if it counts, 0 if it is masked. A pixel that is masked in part is masked.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `(height, width)`, not all 1.
    pub weights: Vec<f32>,
}

/// The file of a mask, and its polarity.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskFile {
    /// The file.
    pub path: PathBuf,
    /// White pixels are masked, instead of black ones.
    pub is_inverted: bool,
    /// It has labels: what is not 0 is white.
    pub is_of_labels: bool,
}

impl MaskFile {
    /// A mask whose white pixels count.
    pub fn shown(path: PathBuf) -> Self {
        Self { path, is_inverted: false, is_of_labels: false }
    }

    /// Marks masks whose largest value, of all of them, is 1 as labels, with a remark on it. Reads masks up to the
    /// first with a larger value; those that cannot be read are reported when they are used.
    pub fn find_labels<'a>(masks: impl Iterator<Item = &'a mut Self>) -> Option<String> {
        let mut masks: Vec<&mut Self> = masks.collect();
        let mut has_label = false;
        for mask in &masks {
            let Ok(image) = Image::load_as_stored(&mask.path) else { continue };
            let most = image.data[..image.pixel_count()].iter().copied().fold(0.0, f32::max);
            // 1 of 8 bits, or of 16.
            match (65_535.0 * most).round() as u32 {
                0 => {}
                1 | 257 => has_label = true,
                _ => return None,
            }
        }
        let first = masks.first().filter(|_| has_label)?.path.display();
        let remark = format!(
            "{first} and all other masks have no value above 1: they are labels, of which 1 shows"
        );
        masks.iter_mut().for_each(|mask| mask.is_of_labels = true);
        Some(remark)
    }
}

impl Mask {
    /// The weights of an image's first plane; `None` if every pixel counts.
    #[doc(hidden)]
    pub fn of_plane(image: &Image) -> Option<Self> {
        let weights: Vec<f32> = image.data[..image.pixel_count()].iter().map(whole).collect();
        let Image { width, height, .. } = *image;
        weights.iter().any(|&weight| weight < 1.0).then_some(Self { width, height, weights })
    }

    /// The mask as an image of three equal planes.
    #[doc(hidden)]
    pub fn to_image(&self) -> Image {
        Image { width: self.width, height: self.height, data: self.weights.repeat(3) }
    }

    /// The mask of a photograph as stored: transparent pixels, EXR values that are not finite, and the black pixels of
    /// a mask file, or its white ones if inverted. `None` if nothing is masked.
    ///
    /// # Errors
    /// [`Error::Input`] for a file that cannot be read, or a mask with another aspect ratio than its photograph.
    pub fn load(photograph: &Path, file: Option<&Path>, inverted: bool) -> Result<Option<Self>> {
        let (image, alpha) = PictureFile::open(photograph)?.decode()?;
        let file = file.map(|path| MaskFile::shown(path.to_owned()));
        Self::over(photograph, (&image, alpha.as_ref()), file.as_ref(), inverted)
    }

    /// [`Mask::load`] for a decoded photograph with its alpha.
    #[doc(hidden)]
    pub fn over(
        photograph: &Path,
        (image, alpha): (&Image, Option<&Image>),
        file: Option<&MaskFile>,
        inverted: bool,
    ) -> Result<Option<Self>> {
        let Some(MaskFile { path: file, is_inverted, is_of_labels }) = file else {
            return Ok(alpha.and_then(Self::of_plane));
        };
        let inverted = inverted != *is_inverted;
        let size = (image.width, image.height);
        let mut mask = Image::load_as_stored_at(file, |stored| reduced_size(stored, size))?;
        let (shape, upright) =
            ((mask.width, mask.height), Orientation::from_file(photograph).size(size));
        let is_of_shape = |(width, height): (u32, u32)| {
            let [a, b] = [shape.0 * height, shape.1 * width].map(f64::from);
            (a - b).abs() <= f64::from(width.max(height).max(shape.0).max(shape.1))
        };
        if !is_of_shape(size) {
            let ((w, h), (width, height)) = (shape, size);
            let problem = if upright != size && is_of_shape(upright) {
                format!(
                    "is {w}x{h}, its photograph {width}x{height} as stored; save the mask in the stored orientation"
                )
            } else {
                format!(
                    "is {w}x{h}, its photograph {width}x{height}; a mask has the aspect ratio of its photograph"
                )
            };
            return Err(Error::input(file, problem));
        }
        if *is_of_labels {
            mask.data.iter_mut().for_each(|value| *value = f32::from(*value > 0.0));
        }
        mask = mask.resized(size.0, size.1);
        let pixels = mask.pixel_count();
        for pixel in 0..pixels {
            let shown = (mask.data[pixel] >= 0.5) != inverted;
            let alpha = alpha.map_or(1.0, |alpha| alpha.data[pixel]);
            mask.data[pixel] = if shown { alpha } else { 0.0 };
        }
        Ok(Self::of_plane(&mask))
    }

    /// The mask that masks some pixels of an image; `None` if there are none.
    #[doc(hidden)]
    pub fn hiding(image: &Image, pixels: &[usize]) -> Option<Self> {
        Self::masked_at(None, (image.width, image.height), pixels)
    }

    /// `mask`, of this size, that also masks these pixels; `None` if nothing is masked.
    #[doc(hidden)]
    pub fn masked_at(
        mask: Option<Self>,
        (width, height): (u32, u32),
        pixels: &[usize],
    ) -> Option<Self> {
        if pixels.is_empty() {
            return mask;
        }
        let all = || Self { width, height, weights: vec![1.0; width as usize * height as usize] };
        let mut mask = mask.unwrap_or_else(all);
        pixels.iter().for_each(|&pixel| mask.weights[pixel] = 0.0);
        Some(mask)
    }

    /// The mask resized for an image of another size.
    #[doc(hidden)]
    pub fn resized(&self, width: u32, height: u32) -> Cow<'_, Self> {
        if (width, height) == (self.width, self.height) {
            return Cow::Borrowed(self);
        }
        let Image { width, height, mut data } = self.to_image().resized(width, height);
        data.truncate(width as usize * height as usize);
        Cow::Owned(Self { width, height, weights: data.iter().map(whole).collect() })
    }

    /// Whether every pixel is masked.
    #[doc(hidden)]
    pub fn hides_all(&self) -> bool {
        self.hidden().len() == self.weights.len()
    }

    /// The masked pixels: indices into a plane, ascending.
    #[doc(hidden)]
    pub fn hidden(&self) -> Vec<usize> {
        let hides = |&(_, &weight): &(usize, &f32)| weight < 0.5;
        self.weights.iter().enumerate().filter(hides).map(|(pixel, _)| pixel).collect()
    }

    /// Sets the masked pixels of an image to black, so that nothing of them remains, even within windows of other
    /// pixels.
    #[doc(hidden)]
    pub fn blacked_out(&self, mut image: Image) -> Image {
        let pixels = image.pixel_count();
        for pixel in self.resized(image.width, image.height).hidden() {
            (0..3).for_each(|plane| image.data[plane * pixels + pixel] = 0.0);
        }
        image
    }

    /// Whether one of the four pixels around a position, in pixels, is masked in part.
    #[doc(hidden)]
    pub fn hides_around(&self, position: glam::DVec2) -> bool {
        let [column, row] = (position - 0.5).floor().to_array();
        let at = |value: f64, side: u32| (value.max(0.0) as u32).min(side - 1) as usize;
        [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].into_iter().any(|(x, y)| {
            let (x, y) = (at(column + x, self.width), at(row + y, self.height));
            self.weights[y * self.width as usize + x] < 1.0
        })
    }

    /// The planes of an image without the masked pixels.
    #[doc(hidden)]
    pub fn counted(&self, image: &Image) -> Vec<f32> {
        let mask = self.resized(image.width, image.height);
        let pixels = image.pixel_count().max(1);
        let values = image.data.iter().enumerate();
        values.filter(|(at, _)| mask.weights[at % pixels] >= 0.5).map(|(_, &value)| value).collect()
    }
}

/// The weight of a pixel that counts in part: 1 up to rounding of the interpolation, else 0.
fn whole(part: &f32) -> f32 {
    f32::from(*part > 0.999)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn half() -> Mask {
        let weights = (0..12).map(|pixel| f32::from(pixel % 4 < 2)).collect();
        Mask { width: 4, height: 3, weights }
    }

    #[test]
    fn hidden_pixels_are_not_counted_at_any_size() {
        let image = Image::from_fn(4, 3, |x, y| [x as f32, y as f32, 9.0]);
        let counted = half().counted(&image);
        assert_eq!(counted[..6], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]);
        assert_eq!(counted.len(), 18);
        assert_eq!(half().hidden(), [2, 3, 6, 7, 10, 11]);
        let large = Image::from_fn(8, 6, |x, _| [x as f32; 3]);
        assert!(half().counted(&large).iter().all(|&value| value < 4.0));
        assert_eq!(half().resized(2, 3).weights, [1.0, 0.0, 1.0, 0.0, 1.0, 0.0]);
        assert!(!half().hides_all());
        let hides = |x: f64| half().hides_around(glam::DVec2::new(x, 1.5));
        assert_eq!([0.0, 1.4, 1.6, 3.9].map(hides), [false, false, true, true]);
    }

    #[test]
    fn masks_without_a_value_above_1_are_labels() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, value: f32| {
            let path = folder.path().join(name);
            let image = Image::from_fn(4, 2, |x, _| [if x < 2 { value / 255.0 } else { 0.0 }; 3]);
            image.save_png8(&path).unwrap();
            MaskFile::shown(path)
        };
        let photograph = folder.path().join("photograph.png");
        Image::filled(8, 4, [0.1; 3]).save_png8(&photograph).unwrap();
        let picture = Image::load_as_stored(&photograph).unwrap();
        let shown = |masks: &mut [MaskFile]| {
            MaskFile::find_labels(masks.iter_mut());
            let mask = Mask::over(&photograph, (&picture, None), Some(&masks[1]), false);
            8 * 4 - mask.unwrap().unwrap().hidden().len()
        };
        assert_eq!(shown(&mut [file("0.png", 0.0), file("1.png", 1.0)]), 16);
        assert_eq!(shown(&mut [file("0.png", 255.0), file("1.png", 1.0)]), 0);
        assert_eq!(shown(&mut [file("0.png", 2.0), file("1.png", 1.0)]), 0);
    }

    #[test]
    fn an_image_that_hides_nothing_has_no_mask() {
        assert_eq!(Mask::of_plane(&Image::filled(3, 2, [1.0; 3])), None);
        assert_eq!(Mask::of_plane(&half().to_image()), Some(half()));
    }
}
