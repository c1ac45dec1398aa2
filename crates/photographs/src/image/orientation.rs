//! Exif orientation: cameras store the sensor's image, and its rotation in Exif.

use std::io::{BufRead, BufReader, Seek};
use std::path::Path;

use ::exif::{In, Reader, Tag};
use rayon::prelude::*;

use super::Image;
use crate::tree;

/// An Exif orientation, 1 to 8: the rotation of an image, and whether it is mirrored, for display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Orientation(u8);

impl Default for Orientation {
    fn default() -> Self {
        Self::UPRIGHT
    }
}

impl Orientation {
    /// As stored.
    pub const UPRIGHT: Self = Self(1);

    /// The orientation of a file; upright if it has none.
    pub fn from_file(path: &Path) -> Self {
        tree::open(path).map_or(Self::UPRIGHT, |file| Self::read(&mut BufReader::new(file)))
    }

    /// The orientation in the bytes of a file; upright if there is none.
    pub(super) fn read(file: &mut (impl BufRead + Seek)) -> Self {
        let mut tagged = || {
            let exif = Reader::new().read_from_container(file).ok()?;
            let value = exif.get_field(Tag::Orientation, In::PRIMARY)?.value.get_uint(0)?;
            u8::try_from(value).ok().filter(|value| (1..=8).contains(value))
        };
        tagged().map_or(Self::UPRIGHT, Self)
    }

    /// Width and height for display.
    pub fn size(self, (width, height): (u32, u32)) -> (u32, u32) {
        if self.0 >= 5 { (height, width) } else { (width, height) }
    }

    /// That which undoes it.
    #[must_use]
    pub fn inverse(self) -> Self {
        Self(match self.0 {
            6 => 8,
            8 => 6,
            other => other,
        })
    }

    /// An image as displayed.
    #[doc(hidden)]
    pub fn upright(self, image: Image) -> Image {
        if self == Self::UPRIGHT {
            return image;
        }
        let (width, height) = self.size((image.width, image.height));
        let size = (image.width as usize, image.height as usize);
        let pixels = image.pixel_count();
        let value = |index: usize| {
            let (plane, pixel) = (index / pixels, index % pixels);
            let at = (pixel % width as usize, pixel / width as usize);
            let (column, row) = self.stored(at, size);
            image.data[plane * pixels + row * size.0 + column]
        };
        let data = (0..3 * pixels).into_par_iter().map(value).collect();
        Image { width, height, data }
    }

    /// Clockwise quarter turns, to be followed by a horizontal flip if the image is mirrored.
    #[doc(hidden)]
    pub fn quarters(self) -> u32 {
        match self.0 {
            5 | 6 => 1,
            3 | 4 => 2,
            7 | 8 => 3,
            _ => 0,
        }
    }

    /// The orientation without its rotation: mirrored horizontally, or upright.
    #[doc(hidden)]
    pub fn mirror(self) -> Self {
        if matches!(self.0, 2 | 4 | 5 | 7) { Self(2) } else { Self::UPRIGHT }
    }

    /// The orientation without its mirroring: a rotation alone.
    #[doc(hidden)]
    pub fn turn(self) -> Self {
        Self([1, 6, 3, 8][self.quarters() as usize])
    }

    /// Maps display to storage coordinates, column and row; `width` and `height` are those of the stored image.
    fn stored(self, (x, y): (usize, usize), (width, height): (usize, usize)) -> (usize, usize) {
        match self.0 {
            2 => (width - 1 - x, y),
            3 => (width - 1 - x, height - 1 - y),
            4 => (x, height - 1 - y),
            5 => (y, x),
            6 => (y, height - 1 - x),
            7 => (width - 1 - y, height - 1 - x),
            8 => (width - 1 - y, x),
            _ => (x, y),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A letter F, upright; `#` is bright.
    const UPRIGHT: [&str; 4] = ["###", "#..", "##.", "#.."];
    /// The same as stored by a camera held in each of the eight ways (Exif 2.32, 4.6.4, Orientation).
    const STORED: [&[&str]; 8] = [
        &["###", "#..", "##.", "#.."],
        &["###", "..#", ".##", "..#"],
        &["..#", ".##", "..#", "###"],
        &["#..", "##.", "#..", "###"],
        &["####", "#.#.", "#..."],
        &["#...", "#.#.", "####"],
        &["...#", ".#.#", "####"],
        &["####", ".#.#", "...#"],
    ];

    fn drawn(rows: &[&str]) -> Image {
        let ink = |x: u32, y: u32| f32::from(rows[y as usize].as_bytes()[x as usize] == b'#');
        Image::from_fn(rows[0].len() as u32, rows.len() as u32, |x, y| {
            [ink(x, y), 0.5 * ink(x, y), x as f32]
        })
    }

    #[test]
    fn every_orientation_is_rotated_upright() {
        let upright = drawn(&UPRIGHT);
        for (index, rows) in STORED.iter().enumerate() {
            let orientation = Orientation(index as u8 + 1);
            let stored = drawn(rows);
            assert_eq!(orientation.size((stored.width, stored.height)), (3, 4));
            let turned = orientation.upright(stored);
            assert_eq!((turned.width, turned.height), (3, 4), "{orientation:?}");
            assert_eq!(turned.data[..24], upright.data[..24], "{orientation:?}");
            let in_two = orientation.mirror().upright(orientation.turn().upright(drawn(rows)));
            assert_eq!(in_two, turned, "{orientation:?}");
        }
    }
}
