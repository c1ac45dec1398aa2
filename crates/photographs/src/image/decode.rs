//! Decodes image files: row by row where their format allows it, else whole.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use ::image::{DynamicImage, ImageError};
use nightsplat_core::{Error, Result};

use super::budget::{self, Permit};
use super::colour::{self, Conversion, Converter};
use super::decoded::{DecodedImage, Meaning};
use super::files::{CONVERTIBLE, is_raw};
use super::levels::{Levels, SampleFormat};
use super::rows::{Destination, RowObserver, Rows};
use super::source::{reader, undecodable};
use super::{Image, declared, exr_file, jpeg, png_file, raw};

/// An image file, read whole.
#[derive(Clone, Debug)]
pub struct PictureFile {
    pub(super) path: PathBuf,
    pub(super) bytes: Vec<u8>,
    /// The size that it is reduced to while it is decoded.
    pub(super) at: Option<(u32, u32)>,
}

/// Shows the rows of an image of floats.
pub(super) fn show(image: &Image, observer: RowObserver<'_>) {
    let (width, size) = (image.width as usize, (image.width, image.height));
    for y in 0..image.height {
        let plane =
            |plane: usize| &image.data[plane * image.pixel_count() + y as usize * width..][..width];
        let row = [plane(0), plane(1), plane(2)].concat();
        if observer(&row, SampleFormat::Float, y, size).is_break() {
            return;
        }
    }
}

pub(super) fn decode(file: PictureFile, meaning: Meaning, levels: &Levels) -> Result<DecodedImage> {
    let PictureFile { path, bytes, at } = file;
    let path = path.as_path();
    let pixels = declared::pixels(path, Cursor::new(bytes.as_slice()))?;
    if bytes.starts_with(&exr_file::MAGIC) {
        return Ok(exr_file::load(path, bytes, meaning, levels)?.resized_to(at));
    }
    let format = rows_format(path, &bytes)?;
    if format == RowsFormat::Raw {
        return Ok(DecodedImage::as_stored(raw::load(path, bytes)?, None).resized_to(at));
    }
    let is_colour = meaning == Meaning::Colour;
    let converts = is_colour && !levels.are_linear();
    let converter = (converts && at.is_some()).then(|| Converter::of_file(&bytes));
    let (mut is_beyond, mut outside, mut converted) = (false, 0, 0);
    let mut change = |row: &mut [f32], format| {
        is_beyond |= is_colour && levels.apply_to(row, format);
        let (red, rest) = row.split_at_mut(row.len() / 3);
        let (green, blue) = rest.split_at_mut(rest.len() / 2);
        converted += red.len();
        outside += converter.as_ref().map_or(0, |one| one.apply([red, green, blue]));
    };
    let is_light = is_colour && levels.are_linear();
    let mut rows = Rows::new(match at {
        Some(size) => Destination::Reduced { size, is_light, change: &mut change },
        None => Destination::Whole,
    });
    read_rows(path, &bytes, format, pixels, &mut rows)?;
    let extremes = rows.extremes;
    let (mut image, alpha, format) = rows.finish();
    if !is_colour {
        return Ok(DecodedImage::as_stored(image, alpha));
    }
    let remark = if format == SampleFormat::Sixteen { one_value(extremes) } else { None };
    let conversion = match converter {
        Some(converter) => converter.conversion(outside, converted),
        None if at.is_some() => Conversion::default(),
        None => {
            is_beyond = levels.apply(&mut image, format);
            if converts { colour::convert(&mut image, &bytes) } else { Conversion::default() }
        }
    };
    Ok(DecodedImage { image, alpha, conversion, is_beyond, remark })
}

/// Which decoder gives the rows of a file.
#[derive(Clone, Copy, PartialEq, Eq)]
enum RowsFormat {
    Jpeg,
    Png,
    Other,
    Raw,
}

/// Refuses what is not read.
fn rows_format(path: &Path, bytes: &[u8]) -> Result<RowsFormat> {
    if bytes.starts_with(&jpeg::MAGIC) {
        return Ok(RowsFormat::Jpeg);
    }
    refuse_convertible(path, bytes)?;
    Ok(match bytes {
        _ if is_raw(path) => RowsFormat::Raw,
        _ if bytes.starts_with(&png_file::MAGIC) => RowsFormat::Png,
        _ => RowsFormat::Other,
    })
}

/// Decodes a file row by row, or whole if its format requires that.
fn read_rows(
    path: &Path,
    bytes: &[u8],
    format: RowsFormat,
    pixels: u64,
    rows: &mut Rows<'_>,
) -> Result<()> {
    /// Of whole images: four channels of 16 bits.
    const BYTES_PER_PIXEL: u64 = 8;
    let is_read = match format {
        RowsFormat::Jpeg => {
            let _permit = Permit::wait(pixels * jpeg::bytes_per_pixel(bytes));
            jpeg::read(path, bytes, rows)?
        }
        RowsFormat::Png => {
            png_file::read(bytes, rows).map_err(|error| undecodable(path, &error))?
        }
        RowsFormat::Other | RowsFormat::Raw => false,
    };
    if is_read {
        return Ok(());
    }
    let _permit = Permit::wait(pixels * BYTES_PER_PIXEL);
    let decoded = reader(Cursor::new(bytes)).map_err(ImageError::from).and_then(|mut reader| {
        reader.limits(budget::limits());
        reader.decode()
    });
    push_rows(decoded.map_err(|error| undecodable(path, &error))?, rows);
    Ok(())
}

/// The rows of a decoded image.
fn push_rows(decoded: DynamicImage, rows: &mut Rows<'_>) {
    let size = (decoded.width(), decoded.height());
    let has_alpha = decoded.color().has_alpha();
    let channels = if has_alpha { 4 } else { 3 };
    let stride = (channels * size.0 as usize).max(1);
    if decoded.color().bytes_per_pixel() > decoded.color().channel_count() {
        let samples = match has_alpha {
            true => decoded.into_rgba16().into_raw(),
            false => decoded.into_rgb16().into_raw(),
        };
        rows.begin(size, SampleFormat::Sixteen, channels);
        let _ = samples.chunks_exact(stride).try_for_each(|row| rows.push16(|at| row[at]));
    } else {
        let samples = match has_alpha {
            true => decoded.into_rgba8().into_raw(),
            false => decoded.into_rgb8().into_raw(),
        };
        rows.begin(size, SampleFormat::Eight, channels);
        let _ = samples.chunks_exact(stride).try_for_each(|row| rows.push8(row));
    }
}

/// A line where all values of a file of 16 bits are the same.
fn one_value([least, most]: [f32; 2]) -> Option<String> {
    let code = (65_535.0 * most).round();
    (least == most).then(|| {
        format!("every value is {code} of 65535: it shows nothing; leave it out or export it again")
    })
}

/// Refuses images of kinds that other programs convert.
fn refuse_convertible(path: &Path, bytes: &[u8]) -> Result<()> {
    let brand = bytes.get(8..12).filter(|_| bytes.get(4..8) == Some(b"ftyp"));
    let kind = match brand {
        Some(b"heic" | b"heix" | b"hevc" | b"heim" | b"mif1" | b"msf1") => "HEIC",
        Some(b"avif" | b"avis") => "AVIF",
        _ if bytes.starts_with(b"\xFF\x0A") => "JPEG XL",
        _ if bytes.starts_with(b"\0\0\0\x0CJXL ") => "JPEG XL",
        _ if bytes.starts_with(b"#?RADIANCE") || bytes.starts_with(b"#?RGBE") => "Radiance HDR",
        _ => return Ok(()),
    };
    let remedy = CONVERTIBLE.iter().find(|(name, ..)| *name == kind).map(|(.., remedy)| remedy);
    Err(Error::input(path, format!("is {kind}; {}", remedy.unwrap_or(&"convert it first"))))
}

impl PictureFile {
    /// Shows the values as parts of the scale of their format, row by row until the observer breaks; none of camera
    /// RAW, which has no scale.
    pub(super) fn show_as_stored(&self, observer: RowObserver<'_>) -> Result<()> {
        let Self { path, bytes, .. } = self;
        let pixels = declared::pixels(path, Cursor::new(bytes.as_slice()))?;
        if bytes.starts_with(&exr_file::MAGIC) {
            let decoded = decode(self.clone(), Meaning::Number, &Levels::default())?;
            show(&decoded.image, observer);
            return Ok(());
        }
        let format = rows_format(path, bytes)?;
        let mut rows = Rows::new(Destination::Shown(observer));
        if format == RowsFormat::Raw {
            Ok(())
        } else {
            read_rows(path, bytes, format, pixels, &mut rows)
        }
    }
}
