//! JPEG decoded by libjpeg: accurate integer DCT, smooth chroma upsampling.
//!
//! Other decoders round differently, by fractions of a code value, and a tone curve multiplies these by ten.

mod structure;
mod warnings;

use std::io::SeekFrom;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use mozjpeg::{ColorSpace, Decompress};
use nightsplat_core::{Error, Result};

use super::levels::SampleFormat;
use super::rows::Rows;
use super::source::BufReadSeek;

/// The magic number of JPEG files.
pub(super) const MAGIC: [u8; 2] = [0xFF, 0xD8];

/// Decodes the rows of an image; `false` if libjpeg cannot convert its colour space to RGB.
pub(super) fn read(path: &Path, bytes: &[u8], rows: &mut Rows<'_>) -> Result<bool> {
    // Errors of libjpeg unwind. The structure is checked first, so there should be none; this catches the rest.
    let decoded = || catch_unwind(AssertUnwindSafe(|| decode(bytes, rows))).ok()?.ok();
    structure::is_sound(bytes).then(decoded).flatten().ok_or_else(|| damaged(path))
}

pub(super) fn damaged(path: &Path) -> Error {
    let message =
        "this JPEG is truncated, damaged or of a rare kind; copy it again or save it as PNG";
    Error::input(path, message)
}

/// Width and height that the frame header declares, wherever it is; `None` where there is none. What precedes it is
/// skipped, not read.
pub(super) fn size(file: &mut impl BufReadSeek) -> Option<(u32, u32)> {
    /// Bytes between segments, which libjpeg skips.
    const MOST_SKIPPED: usize = 1 << 16;
    let mut skipped = 0;
    file.seek(SeekFrom::Start(MAGIC.len() as u64)).ok()?;
    loop {
        let mut marker = [0; 2];
        file.read_exact(&mut marker).ok()?;
        while !matches!(marker, [0xFF, 0x01..=0xFE]) {
            skipped += 1;
            marker[0] = marker[1];
            file.read_exact(&mut marker[1..]).ok()?;
            if skipped > MOST_SKIPPED {
                return None;
            }
        }
        match marker[1] {
            0x01 | 0xD0..=0xD7 => continue,
            // The frame header precedes the coded data and the end.
            0xD9 | 0xDA => return None,
            _ => {}
        }
        let mut length = [0; 2];
        file.read_exact(&mut length).ok()?;
        let rest = u16::from_be_bytes(length).checked_sub(2)?;
        if matches!(marker[1], 0xC0..=0xCF) && !matches!(marker[1], 0xC4 | 0xC8 | 0xCC) {
            let mut frame = [0; 5];
            file.read_exact(&mut frame).ok()?;
            let [_, height @ .., w, x] = frame;
            let size = (u16::from_be_bytes([w, x]).into(), u16::from_be_bytes(height).into());
            return Some(size).filter(|&(width, height): &(u32, u32)| width > 0 && height > 0);
        }
        file.seek_relative(rest.into()).ok()?;
    }
}

/// Bytes of a pixel that libjpeg holds until an image is complete: the coefficients of a progressive one.
pub(super) fn bytes_per_pixel(bytes: &[u8]) -> u64 {
    const PROGRESSIVE: u8 = 0xC2;
    if segments(bytes).any(|(marker, _)| marker == PROGRESSIVE) { 6 } else { 0 }
}

/// The segments of a JPEG file before its coded data: marker, and the bytes after the length.
pub(super) fn segments(bytes: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    let mut rest = bytes.get(MAGIC.len()..).unwrap_or_default();
    std::iter::from_fn(move || {
        // Any number of 0xFF bytes may precede a marker.
        while rest.starts_with(&[0xFF, 0xFF]) {
            rest = &rest[1..];
        }
        let [0xFF, marker @ 0xC0..=0xFE, high, low, ..] = *rest else { return None };
        // Segments before the image have a length; the image has none.
        let length = usize::from(u16::from_be_bytes([high, low]));
        if marker == 0xDA || length < 2 {
            return None;
        }
        let (segment, after) = rest.split_at_checked(2 + length)?;
        rest = after;
        Some((marker, &segment[4..]))
    })
}

/// The Exif segment of a JPEG file, with marker and length, changed to an upright orientation and sRGB; `None` if there
/// is none.
pub fn exif_segment(bytes: &[u8]) -> Option<Vec<u8>> {
    const EXIF: u8 = 0xE1;
    const HEAD: &[u8] = b"Exif\0\0";
    let mut of_exif = segments(bytes).filter(|&(marker, _)| marker == EXIF);
    let (_, found) = of_exif.find(|(_, segment)| segment.starts_with(HEAD))?;
    let mut tiff = found[HEAD.len()..].to_vec();
    set_stored_as_seen(&mut tiff);
    let length = (2 + found.len() as u16).to_be_bytes();
    Some([&[0xFF, EXIF], &length[..], HEAD, &tiff].concat())
}

/// Sets the orientation of Exif data to upright, and its colour space to sRGB: both are 1.
fn set_stored_as_seen(tiff: &mut [u8]) -> Option<()> {
    const ORIENTATION: u16 = 0x0112;
    const EXIF_DIRECTORY: u16 = 0x8769;
    const COLOR_SPACE: u16 = 0xA001;
    let is_little = tiff.starts_with(b"II");
    let short = |tiff: &[u8], at: usize| -> Option<u16> {
        let pair = tiff.get(at..at + 2)?.try_into().ok()?;
        Some(if is_little { u16::from_le_bytes(pair) } else { u16::from_be_bytes(pair) })
    };
    let word = |tiff: &[u8], at: usize| -> Option<usize> {
        let word = tiff.get(at..at + 4)?.try_into().ok()?;
        Some(if is_little { u32::from_le_bytes(word) } else { u32::from_be_bytes(word) } as usize)
    };
    let one = if is_little { [1, 0] } else { [0, 1] };
    let mut directories = vec![word(tiff, 4)?];
    // The second directory is that of the photograph; none is visited twice.
    while let Some(first) = directories.pop() {
        for entry in 0..usize::from(short(tiff, first)?) {
            let at = first + 2 + 12 * entry;
            match short(tiff, at)? {
                ORIENTATION | COLOR_SPACE => tiff.get_mut(at + 8..at + 10)?.copy_from_slice(&one),
                EXIF_DIRECTORY if first == word(tiff, 4)? => directories.extend(word(tiff, at + 8)),
                _ => {}
            }
        }
    }
    Some(())
}

/// The eighths of its size at which an image is decoded that is reduced by this factor: a smaller DCT of the low
/// frequencies of each block. At least a factor of two is left to the mean of the pixels, which keeps what rounding
/// each to 8 bits would lose of the dark; an eighth, the mean of a block, is rounded by .2 of a code on average.
fn scale(factor: u32) -> u8 {
    match factor {
        0..4 => 8,
        4..8 => 4,
        8.. => 2,
    }
}

/// Decodes a file of valid structure. Its coded data must be complete; bytes between it and the end are ignored.
fn decode(bytes: &[u8], rows: &mut Rows<'_>) -> std::io::Result<bool> {
    let mut file = Decompress::with_err(warnings::counting()).from_mem(bytes)?;
    if matches!(file.color_space(), ColorSpace::JCS_CMYK | ColorSpace::JCS_YCCK) {
        return Ok(false);
    }
    // Warnings about segments before the image do not affect its pixels.
    warnings::take();
    file.scale(scale(rows.factor((file.width() as u32, file.height() as u32))));
    let mut file = file.rgb()?;
    let mut row = vec![0_u8; 3 * file.width()];
    rows.begin((file.width() as u32, file.height() as u32), SampleFormat::Eight, 3);
    for _ in 0..file.height() {
        if rows.push8(file.read_scanlines_into(&mut row)?).is_break() {
            return Ok(true);
        }
    }
    if warnings::take() > 0 {
        return Err(std::io::ErrorKind::InvalidData.into());
    }
    file.finish()?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::super::rows::Destination;
    use super::super::{Image, ImageFile as _};
    use super::*;

    /// Files, and the pixels that libjpeg decodes: FNV-1a of the bytes of red, green and blue.
    const PICTURES: [(&str, u64); 10] = [
        ("grey.jpg", 0x3c2f_b2ff_2b1b_2c78),
        ("grey_progressive.jpg", 0xa9ca_851e_396d_a86c),
        ("grey_refined.jpg", 0x3c2f_b2ff_2b1b_2c78),
        ("grey_restarts.jpg", 0x3c2f_b2ff_2b1b_2c78),
        ("444.jpg", 0xa2e1_50f4_e546_fe4f),
        ("422.jpg", 0xfd6f_685b_a383_5820),
        ("440.jpg", 0x415f_ded0_2db0_dd9a),
        ("420.jpg", 0x19b0_b636_a9aa_4c3a),
        ("420_progressive.jpg", 0x2b7c_7a79_de4c_299b),
        ("411_progressive.jpg", 0x9212_8246_36cb_1b2c),
    ];

    fn load(path: &Path, bytes: &[u8]) -> Result<Option<Image>> {
        let mut rows = Rows::new(Destination::Whole);
        Ok(read(path, bytes, &mut rows)?.then(|| rows.finish().0))
    }

    fn fixture(name: &str) -> Vec<u8> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/fixtures/jpeg");
        std::fs::read(Path::new(folder).join(name)).unwrap()
    }

    #[test]
    fn every_kind_of_jpeg_has_the_pixels_that_libjpeg_decodes() {
        for (name, expected) in PICTURES {
            let image = load(Path::new(name), &fixture(name)).unwrap().unwrap();
            assert_eq!((image.width, image.height), (37, 29), "{name}");
            let bytes = image.data.iter().map(|value| (value * 255.0).round() as u8);
            let hash = bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
                (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
            });
            assert_eq!(hash, expected, "{name}: {hash:#x}");
        }
    }

    /// Asserts that libjpeg decodes a file whose structure is valid; returns whether it is.
    fn decodes_if_sound(bytes: &[u8], name: &str, damage: impl std::fmt::Debug) -> bool {
        let is_sound = structure::is_sound(bytes);
        let decoded = || catch_unwind(|| decode(bytes, &mut Rows::new(Destination::Whole)));
        assert!(!is_sound || decoded().is_ok(), "{name}: {damage:x?}");
        is_sound
    }

    #[test]
    fn a_reduced_jpeg_is_the_mean_of_its_pixels_but_for_rounding() {
        let stored = |x: u32, y: u32| {
            let wave = |x: u32, y: u32| 0.06 + 0.05 * f32::sin(x as f32 / 9.0 + y as f32 / 13.0);
            [wave(x, y), wave(y, x), 0.02 + 0.04 * ((x / 16 + y / 16) % 2) as f32]
        };
        let bytes = Image::from_fn(320, 240, stored).to_jpeg(95).unwrap();
        let whole = load(Path::new("a"), &bytes).unwrap().unwrap();
        for factor in [2, 3, 4, 5, 8, 16] {
            let (size, change) = ((320 / factor, 240 / factor), &mut |_: &mut [f32], _| ());
            let mut rows = Rows::new(Destination::Reduced { size, is_light: false, change });
            assert!(read(Path::new("a"), &bytes, &mut rows).unwrap());
            let (reduced, mean) = (rows.finish().0, whole.resized(size.0, size.1));
            let off: Vec<f32> =
                reduced.data.iter().zip(&mean.data).map(|(a, b)| 255.0 * (a - b)).collect();
            let count = off.len() as f32;
            let (bias, spread) = (
                off.iter().sum::<f32>() / count,
                (off.iter().map(|x| x * x).sum::<f32>() / count).sqrt(),
            );
            assert!(bias.abs() < 0.05 && spread < 0.5, "{factor}: {bias} {spread}");
            assert!(factor >= 4 || reduced == mean, "{factor}: as before");
        }
    }

    #[test]
    fn the_size_is_found_after_any_segments_without_reading_them() {
        let whole = fixture("420.jpg");
        let size = |bytes: &[u8]| size(&mut std::io::Cursor::new(bytes));
        assert_eq!(size(&whole), Some((37, 29)));
        let long = [&[0xFF_u8, 0xE1, 0xFF, 0xFF][..], &[0; 65_533]].concat().repeat(20);
        assert_eq!(size(&[&whole[..2], &long, &whole[2..]].concat()), Some((37, 29)));
        assert_eq!(size(&[&whole[..2], &[0; 70_000], &whole[2..]].concat()), None);
        let scan = whole.windows(2).position(|marker| marker == [0xFF, 0xDA]).unwrap();
        let frame = whole.windows(2).position(|marker| marker == [0xFF, 0xC1]).unwrap();
        assert_eq!(size(&[&whole[..frame], &whole[scan..]].concat()), None);
        assert!((0..frame + 9).all(|length| size(&whole[..length]).is_none()));
    }

    #[test]
    fn no_wrong_byte_makes_libjpeg_unwind() {
        for (name, _) in PICTURES {
            let mut bytes = fixture(name);
            let mut refused = 0;
            for at in 0..bytes.len() {
                let right = bytes[at];
                let flipped = (0..8).map(|bit| right ^ 1 << bit);
                for wrong in flipped.chain([0x00, 0xFF]) {
                    bytes[at] = wrong;
                    refused += usize::from(!decodes_if_sound(&bytes, name, (at, wrong)));
                }
                bytes[at] = right;
            }
            assert!(refused > 0, "{name}");
        }
    }

    #[test]
    fn no_damage_of_many_bytes_makes_libjpeg_unwind() {
        let mut state = 0x9E37_79B9_7F4A_7C15_u64;
        let mut below = |limit: usize| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 32) as usize % limit
        };
        for round in 0..400 {
            for (name, _) in PICTURES {
                let mut bytes = fixture(name);
                for _ in 0..2 + below(6) {
                    let at = below(bytes.len());
                    match below(4) {
                        0 => drop(bytes.drain(at..(at + below(20)).min(bytes.len()))),
                        1 => bytes.insert(at, below(256) as u8),
                        _ => bytes[at] = below(256) as u8,
                    }
                }
                decodes_if_sound(&bytes, name, round);
            }
        }
    }

    #[test]
    fn an_image_without_two_thirds_of_its_data_is_refused_though_it_has_an_end() {
        for (name, _) in PICTURES {
            let whole = fixture(name);
            let scan = whole.windows(2).position(|marker| marker == [0xFF, 0xDA]).unwrap();
            for part in [3, 2] {
                let length = scan + (whole.len() - scan) / part;
                let cut = [&whole[..length], &[0xFF, 0xD9]].concat();
                let message = load(Path::new("photo.jpg"), &cut).unwrap_err().to_string();
                assert!(message.contains("photo.jpg: this JPEG is truncated"), "{name}: {message}");
            }
        }
    }

    #[test]
    fn bytes_between_the_image_and_its_end_are_ignored() {
        let whole = fixture("420.jpg");
        let (picture, end) = whole.split_at(whole.len() - 2);
        let padded = [picture, &[0; 8], end].concat();
        let load = |bytes: &[u8]| load(Path::new("420.jpg"), bytes).unwrap().unwrap();
        assert!(load(&padded) == load(&whole));
    }

    #[test]
    fn a_jpeg_truncated_anywhere_is_refused() {
        for (name, _) in PICTURES {
            let whole = fixture(name);
            assert!(
                (0..whole.len()).all(|length| !structure::is_sound(&whole[..length])),
                "{name}"
            );
        }
    }

    #[test]
    fn an_image_that_declares_more_than_its_file_can_contain_is_refused() {
        let mut bytes = fixture("420.jpg");
        let at = bytes.windows(2).position(|marker| marker == [0xFF, 0xC1]).unwrap();
        bytes[at + 5..at + 9].fill(0xFF);
        assert!(load(Path::new("photo.jpg"), &bytes).is_err());
    }

    #[test]
    fn a_damaged_jpeg_is_refused_by_name() {
        let path = Path::new("photo.jpg");
        // An image without content, and a frame header without a size.
        let empty = [0xFF, 0xD8, 0xFF, 0xD9];
        let no_size = [0xFF, 0xD8, 0xFF, 0xC0, 0, 11, 8, 0, 0, 0, 0, 1, 1, 0x11, 0, 0xFF, 0xD9];
        for bytes in [&empty[..], &no_size] {
            let message = load(path, bytes).unwrap_err().to_string();
            assert!(message.contains("photo.jpg") && message.contains("damaged"), "{message}");
        }
    }
}
