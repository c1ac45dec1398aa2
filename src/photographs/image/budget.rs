//! Limits on the declared size of an image, checked before memory is allocated.

use std::io::Cursor;
use std::path::Path;

use super::exr_file;
use super::source::{BufReadSeek, reader};
use crate::{Error, Result};

/// More than any camera: 16 384 x 16 384.
const MAX_PIXELS: u64 = 1 << 28;

/// The limit for the samples of all layers of an EXR file, which are decoded at once, bytes.
const MAX_BYTES: u64 = 1 << 33;

/// Checks the declared size of a file.
pub(super) fn check(path: &Path, bytes: &[u8]) -> Result<()> {
    // A file without a readable header is refused by its decoder.
    let excess = if bytes.starts_with(&exr_file::MAGIC) {
        excess_of_exr(bytes)
    } else {
        let size = reader(Cursor::new(bytes)).ok().and_then(|reader| reader.into_dimensions().ok());
        size.and_then(|(width, height)| excess_of_size(width.into(), height.into()))
    };
    match excess {
        Some(excess) => {
            Err(Error::input(path, format!("{excess}; crop or shrink it, or copy it again")))
        }
        None => Ok(()),
    }
}

fn excess_of_size(width: u64, height: u64) -> Option<String> {
    let is_more = width.saturating_mul(height) > MAX_PIXELS;
    is_more.then(|| format!("declares {width}x{height}, more than 268 megapixels"))
}

fn excess_of_exr(bytes: &[u8]) -> Option<String> {
    let bytes: Box<dyn BufReadSeek> = Box::new(Cursor::new(bytes));
    let meta = exr::meta::MetaData::read_from_buffered(bytes, false).ok()?;
    let size = |header: &exr::meta::header::Header| {
        [header.layer_size.width(), header.layer_size.height()].map(|side| side as u64)
    };
    let samples = |header: &exr::meta::header::Header| {
        let [width, height] = size(header);
        width.saturating_mul(height).saturating_mul(header.channels.bytes_per_pixel as u64)
    };
    let total = meta.headers.iter().map(samples).fold(0, u64::saturating_add);
    let pixels = meta.headers.iter().find_map(|header| {
        let [width, height] = size(header);
        excess_of_size(width, height)
    });
    let gigabytes = total >> 30;
    let is_more = total > MAX_BYTES;
    pixels.or(is_more.then(|| format!("declares layers of {gigabytes} GiB, more than 8")))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The header of a PNG of this size, with its checksum.
    fn png(width: u32, height: u32) -> Vec<u8> {
        let mut bytes = Vec::new();
        let encoder = ::image::codecs::png::PngEncoder::new(&mut bytes);
        let color = ::image::ExtendedColorType::L8;
        ::image::ImageEncoder::write_image(encoder, &[0], 1, 1, color).unwrap();
        bytes[16..20].copy_from_slice(&width.to_be_bytes());
        bytes[20..24].copy_from_slice(&height.to_be_bytes());
        let crc = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&crc.to_be_bytes());
        bytes
    }

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(u32::MAX, |crc, &byte| {
            (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xEDB8_8320 * (crc & 1)))
        })
    }

    /// The fixture with another size in its frame header.
    fn jpeg(side: u16) -> Vec<u8> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/jpeg/420.jpg");
        let mut bytes = std::fs::read(path).unwrap();
        let at = bytes.windows(2).position(|marker| marker == [0xFF, 0xC1]).unwrap();
        for side_at in [at + 5, at + 7] {
            bytes[side_at..side_at + 2].copy_from_slice(&side.to_be_bytes());
        }
        bytes
    }

    #[test]
    fn a_size_beyond_any_camera_is_refused_before_it_is_decoded() {
        let path = Path::new("bomb");
        let refused = |bytes: &[u8], part: &str| {
            let message = check(path, bytes).unwrap_err().to_string();
            assert!(message.contains("bomb: declares") && message.contains(part), "{message}");
        };
        refused(&png(20_000, 20_000), "20000x20000");
        check(path, &png(16_384, 16_384)).unwrap();
        refused(&jpeg(20_000), "20000x20000");
        check(path, &jpeg(16_000)).unwrap();
        check(path, b"no picture").unwrap();
    }

    #[test]
    fn an_exr_of_many_pixels_is_refused_by_its_header() {
        use exr::prelude::{SpecificChannels, Vec2, WritableImage};
        let channels = SpecificChannels::rgb(|Vec2(..): Vec2<usize>| (0.0_f32, 0.0_f32, 0.0_f32));
        let mut file = Cursor::new(Vec::new());
        exr::image::Image::from_channels((3, 2), channels).write().to_buffered(&mut file).unwrap();
        let mut bytes = file.into_inner();
        check(Path::new("small"), &bytes).unwrap();
        // Both windows end at the last column and row.
        for name in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
            let at =
                bytes.windows(name.len()).position(|found| found == name).unwrap() + name.len() + 4;
            for side in [at + 8, at + 12] {
                bytes[side..side + 4].copy_from_slice(&29_999_i32.to_le_bytes());
            }
        }
        let message = check(Path::new("bomb"), &bytes).unwrap_err().to_string();
        assert!(message.contains("30000x30000"), "{message}");
    }
}
