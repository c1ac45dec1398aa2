//! Images within a page: base64 (RFC 4648) in a data URI.

use nightsplat_core::Result;
use nightsplat_photographs::image::{Image, ImageFile};

/// The image as an 8-bit PNG; an empty URI for an image without pixels.
pub(super) fn png(image: &Image) -> String {
    uri("png", image.to_png8())
}

/// The image as a JPEG of high quality; an empty URI for an image without pixels.
pub fn jpeg(image: &Image) -> String {
    const QUALITY: u8 = 90;
    jpeg_of_quality(image, QUALITY)
}

/// The image as a JPEG; an empty URI for an image without pixels.
pub fn jpeg_of_quality(image: &Image, quality: u8) -> String {
    uri("jpeg", image.to_jpeg(quality))
}

fn uri(kind: &str, file: Result<Vec<u8>>) -> String {
    file.map_or_else(
        |_| "data:,".to_owned(),
        |file| format!("data:image/{kind};base64,{}", base64(&file)),
    )
}

/// The bytes as text of 64 characters, padded.
pub fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let byte = |index: usize| u32::from(group.get(index).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for digit in 0..4 {
            // A group of n bytes gives n + 1 digits.
            let symbol = ALPHABET[(bits >> (18 - 6 * digit) & 63) as usize];
            text.push(if digit <= group.len() { char::from(symbol) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::base64;

    #[test]
    fn base64_matches_the_vectors_of_rfc_4648() {
        let vectors = ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "Zm9vYmE=", "Zm9vYmFy"];
        for (length, expected) in vectors.into_iter().enumerate() {
            assert_eq!(base64(&b"foobar"[..length]), expected);
        }
        assert_eq!(base64(&[0xfb, 0xff, 0xfe]), "+//+");
    }
}
