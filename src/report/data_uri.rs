//! Images inside a page: PNG in base64 (RFC 4648) in a data URI.

use image::{ExtendedColorType, ImageEncoder as _, codecs::png::PngEncoder};

use crate::image::Image;

/// The image as an 8-bit PNG; an empty URI for an image without pixels.
pub(super) fn png(image: &Image) -> String {
    let pixels = image.pixel_count();
    let byte = |index: usize| (image.data[index].clamp(0.0, 1.0) * 255.0).round() as u8;
    let bytes: Vec<u8> =
        (0..3 * pixels).map(|index| byte(index % 3 * pixels + index / 3)).collect();
    let mut file = Vec::new();
    match PngEncoder::new(&mut file).write_image(
        &bytes,
        image.width,
        image.height,
        ExtendedColorType::Rgb8,
    ) {
        Ok(()) => format!("data:image/png;base64,{}", base64(&file)),
        Err(_) => String::from("data:,"),
    }
}

fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let byte = |index: usize| u32::from(group.get(index).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for digit in 0..4 {
            // A group of n bytes fills n + 1 digits.
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
    fn base64_gives_the_vectors_of_rfc_4648() {
        let vectors = ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "Zm9vYmE=", "Zm9vYmFy"];
        for (length, expected) in vectors.into_iter().enumerate() {
            assert_eq!(base64(&b"foobar"[..length]), expected);
        }
        assert_eq!(base64(&[0xfb, 0xff, 0xfe]), "+//+");
    }
}
