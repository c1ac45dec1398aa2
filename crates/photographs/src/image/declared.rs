//! The declared size of an image, checked before memory is allocated.

use std::io::{Read as _, SeekFrom};
use std::path::Path;

use nightsplat_core::input::unreadable;
use nightsplat_core::{Error, Result};

use super::budget::MAX_PIXELS;
use super::decode::undecodable;
use super::exr_file;
use super::source::{BufReadSeek, not_an_image, reader};
use super::{jpeg, png_file};

/// The limit for the samples of all layers of an EXR file, which are decoded at once, bytes.
const MAX_BYTES: u64 = 1 << 33;
/// The limit for the bytes of a file beyond those of its decoded pixels: layers and previews of editors, clips of phones.
const MAX_MORE: u64 = 1 << 30;

/// The declared number of pixels of a file, which is within the limits, as is its length; 0 if its header is not
/// readable: its decoder refuses it.
pub(super) fn pixels(path: &Path, mut file: impl BufReadSeek) -> Result<u64> {
    /// Four channels of 16 bits.
    const BYTES_PER_PIXEL: u64 = 8;
    let check = |excess: Option<String>| match excess {
        Some(excess) => {
            Err(Error::input(path, format!("{excess}; crop or shrink it, or copy it again")))
        }
        None => Ok(()),
    };
    let length = file.seek(SeekFrom::End(0)).unwrap_or_default();
    let (count, bytes) = match layers(&mut file) {
        Some(layers) => {
            for [width, height] in layers.iter().map(exr_file::size) {
                check(excess_of_size(width, height))?;
            }
            let bytes = exr_file::layer_bytes(&layers);
            let is_more = bytes > MAX_BYTES;
            let gigabytes = bytes >> 30;
            check(is_more.then(|| format!("declares layers of {gigabytes} GiB, more than 8")))?;
            (layers.iter().map(exr_file::size).map(|[width, height]| width * height).sum(), bytes)
        }
        None => {
            let (width, height) = size(path, file).unwrap_or_default();
            check(excess_of_size(width.into(), height.into()))?;
            let count = u64::from(width) * u64::from(height);
            (count, BYTES_PER_PIXEL * count)
        }
    };
    let is_longer = count > 0 && length > 2 * bytes + MAX_MORE;
    check(is_longer.then(|| format!("has {} GiB for {count} pixels", length >> 30)))?;
    Ok(count)
}

/// Width and height of a file, from its header alone.
pub(super) fn size(path: &Path, mut file: impl BufReadSeek) -> Result<(u32, u32)> {
    if let Some(layers) = layers(&mut file) {
        let first = layers.first().map(exr_file::size);
        let [width, height] =
            first.ok_or_else(|| Error::input(path, "this EXR file has no layer"))?;
        return Ok((width as u32, height as u32));
    }
    let mut start = vec![];
    // What cannot be read is named by the reader.
    let _ = file.rewind().and_then(|()| file.by_ref().take(32).read_to_end(&mut start));
    if start.starts_with(&jpeg::MAGIC) {
        return jpeg::size(&mut file).ok_or_else(|| jpeg::damaged(path));
    }
    if let Some(size) = png_file::size(&start) {
        return Ok(size);
    }
    if start.starts_with(&exr_file::MAGIC) {
        return Err(not_an_image(path, &std::io::Error::other("its header is damaged")));
    }
    let reader = file.rewind().and_then(|()| reader(file));
    let reader = reader.map_err(|error| unreadable(path, &error))?;
    reader.into_dimensions().map_err(|error| undecodable(path, &error))
}

/// The headers of the layers of an EXR file; `None` for other and damaged ones.
fn layers(file: &mut impl BufReadSeek) -> Option<exr::meta::Headers> {
    /// Attributes are read whole, and may be long.
    const LONGEST: u64 = 1 << 22;
    let mut start = vec![];
    file.rewind().ok()?;
    file.by_ref().take(4).read_to_end(&mut start).ok()?;
    if start != exr_file::MAGIC {
        return None;
    }
    file.by_ref().take(LONGEST).read_to_end(&mut start).ok()?;
    exr_file::headers(&start)
}

fn excess_of_size(width: u64, height: u64) -> Option<String> {
    let is_more = width.saturating_mul(height) > MAX_PIXELS;
    is_more.then(|| format!("declares {width}x{height}, more than 268 megapixels"))
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    fn pixels(path: &Path, bytes: &[u8]) -> Result<u64> {
        super::pixels(path, Cursor::new(bytes))
    }

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
