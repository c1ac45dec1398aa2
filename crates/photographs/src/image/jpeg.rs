//! JPEG decoded by libjpeg: accurate integer DCT, smooth chroma upsampling.
//!
//! Other decoders round differently, by fractions of a code value, and a tone curve multiplies these by ten.

mod structure;
mod warnings;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use mozjpeg::{ColorSpace, Decompress};
use nightsplat_core::{Error, Result};

use super::levels::SampleFormat;
use super::rows::Rows;

/// The magic number of JPEG files.
pub(super) const MAGIC: [u8; 2] = [0xFF, 0xD8];

/// Decodes the rows of an image; `false` if libjpeg cannot convert its colour space to RGB.
pub(super) fn read(path: &Path, bytes: &[u8], rows: &mut Rows<'_>) -> Result<bool> {
    // Errors of libjpeg unwind. The structure is checked first, so there should be none; this catches the rest.
    let decoded = || catch_unwind(AssertUnwindSafe(|| decode(bytes, rows))).ok()?.ok();
    structure::is_sound(bytes).then(decoded).flatten().ok_or_else(|| {
        let message =
            "this JPEG is truncated, damaged or of a rare kind; copy it again or save it as PNG";
        Error::input(path, message)
    })
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

/// Decodes a file of valid structure. Its coded data must be complete; bytes between it and the end are ignored.
fn decode(bytes: &[u8], rows: &mut Rows<'_>) -> std::io::Result<bool> {
    let file = Decompress::with_err(warnings::counting()).from_mem(bytes)?;
    if matches!(file.color_space(), ColorSpace::JCS_CMYK | ColorSpace::JCS_YCCK) {
        return Ok(false);
    }
    // Warnings about segments before the image do not affect its pixels.
    warnings::take();
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
    use super::super::Image;
    use super::super::rows::Destination;
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
