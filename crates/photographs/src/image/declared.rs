//! The declared size of an image, checked before memory is allocated.

use std::io::Cursor;
use std::path::Path;

use nightsplat_core::{Error, Result};

use super::budget::MAX_PIXELS;
use super::exr_file::{self, headers, layer_bytes, size};
use super::png_file;
use super::source::reader;

/// The limit for the samples of all layers of an EXR file, which are decoded at once, bytes.
const MAX_BYTES: u64 = 1 << 33;

/// The declared number of pixels of a file, which is within the limits; 0 if its header is not readable.
pub(super) fn pixels(path: &Path, bytes: &[u8]) -> Result<u64> {
    // A file without a readable header is refused by its decoder.
    let mut count = 0;
    let excess = if bytes.starts_with(&exr_file::MAGIC) {
        excess_of_exr(bytes)
    } else {
        let of_header =
            || reader(Cursor::new(bytes)).ok().and_then(|reader| reader.into_dimensions().ok());
        png_file::size(bytes).or_else(of_header).and_then(|(width, height)| {
            count = u64::from(width) * u64::from(height);
            excess_of_size(width.into(), height.into())
        })
    };
    match excess {
        Some(excess) => {
            Err(Error::input(path, format!("{excess}; crop or shrink it, or copy it again")))
        }
        None => Ok(count),
    }
}

fn excess_of_size(width: u64, height: u64) -> Option<String> {
    let is_more = width.saturating_mul(height) > MAX_PIXELS;
    is_more.then(|| format!("declares {width}x{height}, more than 268 megapixels"))
}

fn excess_of_exr(bytes: &[u8]) -> Option<String> {
    let headers = headers(bytes)?;
    let too_large = headers.iter().find_map(|header| {
        let [width, height] = size(header);
        excess_of_size(width, height)
    });
    let (total, gigabytes) = (layer_bytes(bytes), layer_bytes(bytes) >> 30);
    let is_more = total > MAX_BYTES;
    too_large.or(is_more.then(|| format!("declares layers of {gigabytes} GiB, more than 8")))
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
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/fixtures/jpeg/420.jpg");
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
            let message = pixels(path, bytes).unwrap_err().to_string();
            assert!(message.contains("bomb: declares") && message.contains(part), "{message}");
        };
        refused(&png(20_000, 20_000), "20000x20000");
        pixels(path, &png(16_384, 16_384)).unwrap();
        refused(&jpeg(20_000), "20000x20000");
        pixels(path, &jpeg(16_000)).unwrap();
        pixels(path, b"no picture").unwrap();
    }

    #[test]
    fn an_exr_of_many_pixels_is_refused_by_its_header() {
        use exr::prelude::{SpecificChannels, Vec2, WritableImage};
        let channels = SpecificChannels::rgb(|Vec2(..): Vec2<usize>| (0.0_f32, 0.0_f32, 0.0_f32));
        let mut file = Cursor::new(Vec::new());
        exr::image::Image::from_channels((3, 2), channels).write().to_buffered(&mut file).unwrap();
        let mut bytes = file.into_inner();
        pixels(Path::new("small"), &bytes).unwrap();
        // Both windows end at the last column and row.
        for name in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
            let at =
                bytes.windows(name.len()).position(|found| found == name).unwrap() + name.len() + 4;
            for side in [at + 8, at + 12] {
                bytes[side..side + 4].copy_from_slice(&29_999_i32.to_le_bytes());
            }
        }
        let message = pixels(Path::new("bomb"), &bytes).unwrap_err().to_string();
        assert!(message.contains("30000x30000"), "{message}");
    }
}
