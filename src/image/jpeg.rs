//! JPEG as libjpeg decodes it: accurate integer DCT, smooth chroma upsampling.
//!
//! Other decoders round otherwise, by fractions of a code value; a tone curve multiplies that by ten.

use std::panic::catch_unwind;
use std::path::Path;

use mozjpeg::{ColorSpace, Decompress};

use super::{Image, from_interleaved};
use crate::{Error, Result};

/// What a JPEG file begins with.
pub(super) const MAGIC: [u8; 2] = [0xFF, 0xD8];

/// The image; none where the file holds a colour space that libjpeg does not turn into RGB.
///
/// # Errors
/// [`Error::Input`] names the file when it is cut short or damaged.
pub(super) fn load(path: &Path, bytes: &[u8]) -> Result<Option<Image>> {
    if !is_whole(bytes) {
        return Err(Error::input(path, "this JPEG is cut short; copy it again"));
    }
    // libjpeg's errors unwind.
    let decoded = catch_unwind(|| decode(bytes)).ok().and_then(std::io::Result::ok);
    decoded.ok_or_else(|| Error::input(path, "this JPEG is damaged; copy it again"))
}

fn decode(bytes: &[u8]) -> std::io::Result<Option<Image>> {
    let file = Decompress::new_mem(bytes)?;
    if matches!(file.color_space(), ColorSpace::JCS_CMYK | ColorSpace::JCS_YCCK) {
        return Ok(None);
    }
    let mut file = file.rgb()?;
    let (width, height) = (file.width() as u32, file.height() as u32);
    let interleaved: Vec<u8> = file.read_scanlines()?;
    file.finish()?;
    let values: Vec<f32> = interleaved.into_iter().map(|value| f32::from(value) / 255.0).collect();
    Ok(Some(from_interleaved(width, height, &values)))
}

/// Whether a JPEG reaches its end-of-image marker: the decoder paints what is missing grey and says nothing.
///
/// Segments are stepped over by their length, so a thumbnail's own marker does not count.
fn is_whole(bytes: &[u8]) -> bool {
    let mut at = 2;
    let mut in_scan = false;
    while let [marker, rest @ ..] = bytes.get(at..).unwrap_or_default() {
        match (marker, rest) {
            (0xFF, [0xD9, ..]) => return true,
            (0xFF, [0x00 | 0xD0..=0xD7, ..]) if in_scan => at += 2,
            (0xFF, [0xFF, ..]) => at += 1,
            (0xFF, [kind, high, low, ..]) => {
                in_scan = *kind == 0xDA;
                at += 2 + usize::from(u16::from_be_bytes([*high, *low]));
            }
            _ => at += 1,
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_jpeg_is_refused_by_name() {
        let path = Path::new("photo.jpg");
        // Start and end of an image with nothing between, and a frame header of no size.
        let empty = [0xFF, 0xD8, 0xFF, 0xD9];
        let no_size = [0xFF, 0xD8, 0xFF, 0xC0, 0, 11, 8, 0, 0, 0, 0, 1, 1, 0x11, 0, 0xFF, 0xD9];
        for bytes in [&empty[..], &no_size] {
            let message = load(path, bytes).unwrap_err().to_string();
            assert!(message.contains("photo.jpg") && message.contains("damaged"), "{message}");
        }
    }
}
