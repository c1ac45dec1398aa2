//! Image files: reads PNG, JPEG, WebP, TIFF and EXR, writes PNG, JPEG and EXR.

#[cfg(test)]
mod tests;

use std::io::{BufReader, Cursor, Read as _};
use std::path::Path;

use ::image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use ::image::{ExtendedColorType, ImageEncoder};
use nightsplat_core::input::unreadable;
use nightsplat_core::output::write_whole;
use nightsplat_core::{Error, Result};

use super::colour::ColourCounts;
use super::decode::{PictureFile, decode};
use super::decoded::{DecodedImage, Meaning};
use super::files::{READS_RAW, is_raw};
use super::levels::Levels;
use super::{Image, Orientation, declared, exr_file, jpeg, linear_from_srgb, png_file, raw};
use crate::tree;

/// The bytes by which a file is told from others.
const START: u64 = 1 << 16;

/// Whether a file that begins so is read.
fn is_of_read_format(start: &[u8]) -> bool {
    let is_webp = start.starts_with(b"RIFF") && start.get(8..12) == Some(b"WEBP");
    let begins: [&[u8]; 5] = [&jpeg::MAGIC, &png_file::MAGIC, &exr_file::MAGIC, b"II*\0", b"MM\0*"];
    is_webp || begins.iter().any(|magic| start.starts_with(magic))
}

/// The bytes of a file. What declares too much is refused by its header; of what is no image only the beginning is
/// read, by which decoders refuse it, however long it is.
fn bytes_of_image(path: &Path) -> Result<Vec<u8>> {
    let Some(Ok(mut header)) = tree::open_header(path, START) else { return tree::bytes(path) };
    let mut start = vec![];
    if header.by_ref().take(START).read_to_end(&mut start).is_err() {
        return tree::bytes(path);
    }
    // Of an entry of an archive, the header may be beyond what is unpacked.
    let is_cut = start.len() as u64 == START && tree::archive_of(path).is_some();
    let is_image = match is_raw(path) {
        true => READS_RAW,
        false if !is_of_read_format(&start) => false,
        false => declared::pixels(path, BufReader::new(header))? > 0 || is_cut,
    };
    if is_image { tree::bytes(path) } else { Ok(start) }
}

impl PictureFile {
    /// Opens a file and reads its header.
    pub fn open(path: &Path) -> Result<Self> {
        #[cfg(debug_assertions)]
        openings::count(path);
        Ok(Self { path: path.to_owned(), bytes: bytes_of_image(path)?, at: None })
    }

    /// The file, reduced while it is decoded to the size that `decoded_size` gives for its own.
    pub fn reduced(mut self, decoded_size: impl Fn((u32, u32)) -> (u32, u32)) -> Self {
        // What has no readable header is named when it is decoded.
        let size = self.size().ok();
        self.at = size.and_then(|size| Some(decoded_size(size)).filter(|at| *at != size));
        self
    }

    /// Width and height as it is decoded.
    pub fn decoded_size(&self) -> Result<(u32, u32)> {
        self.at.map_or_else(|| self.size(), Ok)
    }

    /// Width and height, from its header alone.
    pub fn size(&self) -> Result<(u32, u32)> {
        if is_raw(&self.path) {
            return raw::size_of(&self.path, self.bytes.clone());
        }
        declared::size(&self.path, Cursor::new(self.bytes.as_slice()))
    }

    /// Whether it holds linear light at these levels.
    pub fn is_light(&self, levels: &Levels) -> bool {
        is_raw(&self.path) || self.bytes.starts_with(&exr_file::MAGIC) || levels.are_linear()
    }

    /// Its Exif orientation.
    pub fn orientation(&self) -> Orientation {
        Orientation::read(&mut Cursor::new(self.bytes.as_slice()))
    }

    /// The photograph in sRGB, and its alpha in all three planes: that of a PNG, WebP or TIFF file, or 0 at values of
    /// an EXR file that are not finite; `None` if nothing is transparent.
    pub fn decode(self) -> Result<(Image, Option<Image>)> {
        self.decode_counted(&ColourCounts::default())
    }

    /// [`Self::decode`] that counts colour conversions in `counters` instead of logging them.
    pub fn decode_counted(self, counters: &ColourCounts) -> Result<(Image, Option<Image>)> {
        let path = self.path.clone();
        let decoded = decode(self, Meaning::Colour, &counters.levels())?;
        let DecodedImage { image, alpha, conversion, is_beyond, remark, .. } = decoded;
        counters.add(&path, conversion, remark, is_beyond);
        Ok((image, alpha))
    }
}

/// Counts how often each file is opened, for tests.
#[cfg(debug_assertions)]
pub mod openings {
    use std::collections::HashMap;
    use std::path::{Path, PathBuf};
    use std::sync::{LazyLock, Mutex, PoisonError};

    static COUNTS: LazyLock<Mutex<HashMap<PathBuf, usize>>> = LazyLock::new(Mutex::default);

    pub(super) fn count(path: &Path) {
        *COUNTS
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .entry(path.to_owned())
            .or_default() += 1;
    }

    /// The counts of the files below a folder.
    pub fn below(folder: &Path) -> Vec<(PathBuf, usize)> {
        let counts = COUNTS.lock().unwrap_or_else(PoisonError::into_inner);
        let within = counts.iter().filter(|(path, _)| path.starts_with(folder));
        within.map(|(path, count)| (path.clone(), *count)).collect()
    }
}

/// Images as files.
pub trait ImageFile: Sized {
    /// Reads an 8- or 16-bit PNG or TIFF, a JPEG, a WebP or an EXR file in its stored orientation; the content
    /// determines the format, not the file's name.
    ///
    /// Colours are converted to sRGB by the file's ICC profile, the chunks of a PNG, the chromaticities of an EXR, or
    /// Exif; a profile that cannot be used is named in a warning, and the values count as sRGB. Colours outside sRGB
    /// are clipped. Alpha is dropped, grey is repeated, and camera RAW (feature `raw`) is linear light. The R, G and B
    /// (or Y) of an EXR file's first layer are linear light; values that are not finite become 0, with a warning that
    /// counts them ([`super::Mask::load`] masks them). Light of RAW and EXR keeps its sign: noise at black is negative,
    /// too.
    ///
    /// # Errors
    /// [`Error::Input`] if the file cannot be read, is truncated or has another format.
    fn load(path: impl AsRef<Path>) -> Result<Self>;

    /// [`ImageFile::load`] that counts colour conversions in `counters` instead of logging them.
    #[doc(hidden)]
    fn load_counted(path: &Path, counters: &ColourCounts) -> Result<Self>;

    /// [`ImageFile::load`] for values that are not colours, such as depth: they are read as stored, including negative
    /// ones of EXR.
    #[doc(hidden)]
    fn load_as_stored(path: impl AsRef<Path>) -> Result<Self>;

    /// [`Self::load_as_stored`], reduced while it is decoded to the size that `decoded_size` gives for its own.
    #[doc(hidden)]
    fn load_as_stored_at(
        path: &Path,
        decoded_size: impl Fn((u32, u32)) -> (u32, u32),
    ) -> Result<Self>;

    /// Width and height of an image file, from its header alone.
    ///
    /// # Errors
    /// [`Error::Input`] if the file is not an image.
    fn size_of(path: impl AsRef<Path>) -> Result<(u32, u32)>;

    /// Writes an 8-bit RGB PNG: values clamped to [0, 1], rounded to nearest.
    ///
    /// # Errors
    /// [`Error::Output`] if the file cannot be written; no partial file is left.
    fn save_png8(&self, path: impl AsRef<Path>) -> Result<()>;

    /// The bytes of the file that [`ImageFile::save_png8`] writes.
    #[doc(hidden)]
    fn to_png8(&self) -> Result<Vec<u8>>;

    /// Red, green and blue of every pixel in 8 bits: values clamped to [0, 1], rounded to nearest.
    #[doc(hidden)]
    fn to_rgb8(&self) -> Vec<u8>;

    /// A JPEG file of a quality from 1 to 100, values clamped to [0, 1].
    #[doc(hidden)]
    fn to_jpeg(&self, quality: u8) -> Result<Vec<u8>>;

    /// Writes a JPEG of high quality, values clamped to [0, 1], with the given Exif segment.
    #[doc(hidden)]
    fn save_jpeg(&self, path: impl AsRef<Path>, exif: Option<&[u8]>) -> Result<()>;

    /// Writes a 16-bit RGB PNG: values clamped to [0, 1], rounded to nearest.
    ///
    /// # Errors
    /// [`Error::Output`] if the file cannot be written; no partial file is left.
    fn save_png16(&self, path: impl AsRef<Path>) -> Result<()>;

    /// Writes a 32-bit float EXR in linear light, unclamped; [`ImageFile::load`] restores the values up to rounding.
    ///
    /// # Errors
    /// [`Error::Output`] if the file cannot be written; no partial file is left.
    fn save_exr(&self, path: impl AsRef<Path>) -> Result<()>;

    /// [`ImageFile::save_exr`] with these numbers in the header.
    #[doc(hidden)]
    fn save_exr_with(&self, path: impl AsRef<Path>, header: &[(&str, f32)]) -> Result<()>;

    /// [`ImageFile::save_exr`] for values that are not colours, without conversion.
    #[doc(hidden)]
    fn save_exr_as_stored(&self, path: impl AsRef<Path>) -> Result<()>;
}

impl ImageFile for Image {
    fn load(path: impl AsRef<Path>) -> Result<Self> {
        let file = PictureFile::open(path.as_ref())?;
        let path = file.path.clone();
        let DecodedImage { image, conversion, remark, .. } =
            decode(file, Meaning::Colour, &Levels::default())?;
        if let Some(problem) = conversion.unknown {
            tracing::warn!("{}: {problem} is not used; the colours count as sRGB", path.display());
        }
        if let Some(remark) = remark {
            tracing::warn!("{}: {remark}", path.display());
        }
        Ok(image)
    }

    fn load_counted(path: &Path, counters: &ColourCounts) -> Result<Self> {
        Ok(PictureFile::open(path)?.decode_counted(counters)?.0)
    }

    fn load_as_stored(path: impl AsRef<Path>) -> Result<Self> {
        Self::load_as_stored_at(path.as_ref(), |size| size)
    }

    fn load_as_stored_at(
        path: &Path,
        decoded_size: impl Fn((u32, u32)) -> (u32, u32),
    ) -> Result<Self> {
        let file = PictureFile::open(path)?.reduced(decoded_size);
        let decoded = decode(file, Meaning::Number, &Levels::default())?;
        if let Some(remark) = decoded.remark {
            tracing::warn!("{}: {remark}", path.display());
        }
        Ok(decoded.image)
    }

    fn size_of(path: impl AsRef<Path>) -> Result<(u32, u32)> {
        let path = path.as_ref();
        if is_raw(path) {
            return raw::size_of(path, tree::bytes(path)?);
        }
        #[cfg(debug_assertions)]
        openings::count(path);
        let file = tree::open(path).map_err(|error| unreadable(path, &error))?;
        declared::size(path, BufReader::new(file))
    }

    fn save_png8(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        write_whole(path, &to_png(self, path, &self.to_rgb8(), ExtendedColorType::Rgb8)?)
    }

    fn to_png8(&self) -> Result<Vec<u8>> {
        to_png(self, Path::new("a picture"), &self.to_rgb8(), ExtendedColorType::Rgb8)
    }

    fn to_rgb8(&self) -> Vec<u8> {
        interleaved(self).map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
    }

    fn to_jpeg(&self, quality: u8) -> Result<Vec<u8>> {
        let mut file = Vec::new();
        JpegEncoder::new_with_quality(&mut file, quality)
            .write_image(&self.to_rgb8(), self.width, self.height, ExtendedColorType::Rgb8)
            .map_err(|error| Error::output("a picture", format!("cannot be encoded: {error}")))?;
        Ok(file)
    }

    fn save_jpeg(&self, path: impl AsRef<Path>, exif: Option<&[u8]>) -> Result<()> {
        const QUALITY: u8 = 97;
        let file = self.to_jpeg(QUALITY)?;
        let (start, rest) = file.split_at(jpeg::MAGIC.len());
        write_whole(path.as_ref(), &[start, exif.unwrap_or_default(), rest].concat())
    }

    fn save_png16(&self, path: impl AsRef<Path>) -> Result<()> {
        let samples =
            interleaved(self).map(|value| (value.clamp(0.0, 1.0) * 65_535.0).round() as u16);
        let bytes: Vec<u8> = samples.flat_map(u16::to_ne_bytes).collect();
        let path = path.as_ref();
        write_whole(path, &to_png(self, path, &bytes, ExtendedColorType::Rgb16)?)
    }

    fn save_exr(&self, path: impl AsRef<Path>) -> Result<()> {
        self.save_exr_with(path, &[])
    }

    fn save_exr_with(&self, path: impl AsRef<Path>, header: &[(&str, f32)]) -> Result<()> {
        exr_file::save(self, path.as_ref(), linear_from_srgb, header)
    }

    fn save_exr_as_stored(&self, path: impl AsRef<Path>) -> Result<()> {
        exr_file::save(self, path.as_ref(), |value| value, &[])
    }
}

fn interleaved(image: &Image) -> impl Iterator<Item = f32> + '_ {
    let pixels = image.pixel_count();
    (0..pixels).flat_map(move |index| [0, 1, 2].map(|plane| image.data[plane * pixels + index]))
}

/// The PNG file of these samples; `path` is for errors.
fn to_png(image: &Image, path: &Path, bytes: &[u8], color: ExtendedColorType) -> Result<Vec<u8>> {
    let mut file = Vec::new();
    PngEncoder::new(&mut file)
        .write_image(bytes, image.width, image.height, color)
        .map_err(|error| Error::output(path, format!("cannot be encoded: {error}")))?;
    Ok(file)
}
