//! Exposure and lens in Exif.

use std::io::BufReader;
use std::path::Path;

use ::exif::{Exif, In, Reader, Tag, Value};

use crate::tree;

/// The exposure of a photograph in stops, log2(t S / N^2) with the exposure time t in seconds, ISO speed S and f-number
/// N: one more stop doubles the linear light. `None` unless the file has all three.
pub fn exposure_value(path: &Path) -> Option<f64> {
    let file = tree::open(path).ok()?;
    let exif = Reader::new().read_from_container(&mut BufReader::new(file)).ok()?;
    let number = |tag| positive(&exif, tag);
    let (time, aperture) = (number(Tag::ExposureTime)?, number(Tag::FNumber)?);
    Some((time * number(Tag::PhotographicSensitivity)? / aperture.powi(2)).log2())
}

/// Camera, lens and focal length from Exif, if there are any; the lenses of a phone may differ in the numbers only.
pub fn lens_name(path: &Path) -> Option<String> {
    let file = tree::open(path).ok()?;
    let exif = Reader::new().read_from_container(&mut BufReader::new(file)).ok()?;
    let tags =
        [Tag::Make, Tag::Model, Tag::LensModel, Tag::FocalLength, Tag::FocalLengthIn35mmFilm];
    let shown = tags.map(|tag| {
        let field = exif.get_field(tag, In::PRIMARY)?;
        Some(field.display_value().to_string())
    });
    let named: Vec<String> = shown.into_iter().flatten().collect();
    (!named.is_empty()).then(|| named.join(", "))
}

/// The first value of a tag, if it is positive and finite.
fn positive(exif: &Exif, tag: Tag) -> Option<f64> {
    let field = exif.get_field(tag, In::PRIMARY)?;
    let number = match &field.value {
        Value::Rational(numbers) => numbers.first()?.to_f64(),
        other => f64::from(other.get_uint(0)?),
    };
    Some(number).filter(|number| number.is_finite() && *number > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first bytes of a JPEG with an Exif segment of these tags: id, then numerator and denominator, or a short.
    fn with_exif(path: &Path, tags: &[(u16, [u32; 2])]) {
        let mut tiff = b"II*\0\x08\0\0\0".to_vec();
        // IFD 0 points to the Exif IFD right after it.
        tiff.extend(1u16.to_le_bytes());
        tiff.extend(0x8769u16.to_le_bytes());
        tiff.extend([4, 0, 1, 0, 0, 0]);
        tiff.extend(26u32.to_le_bytes());
        tiff.extend(0u32.to_le_bytes());
        tiff.extend((tags.len() as u16).to_le_bytes());
        let after = tiff.len() + 12 * tags.len() + 4;
        let mut values = vec![];
        for &(tag, [numerator, denominator]) in tags {
            tiff.extend(tag.to_le_bytes());
            if denominator == 0 {
                tiff.extend([3, 0, 1, 0, 0, 0]);
                tiff.extend(numerator.to_le_bytes());
            } else {
                tiff.extend([5, 0, 1, 0, 0, 0]);
                tiff.extend(((after + values.len()) as u32).to_le_bytes());
                values.extend([numerator, denominator].map(u32::to_le_bytes).concat());
            }
        }
        tiff.extend(0u32.to_le_bytes());
        tiff.extend(values);
        let mut file = vec![0xff, 0xd8, 0xff, 0xe1];
        file.extend((tiff.len() as u16 + 8).to_be_bytes());
        file.extend(b"Exif\0\0");
        file.extend(tiff);
        file.extend([0xff, 0xd9]);
        std::fs::write(path, file).unwrap();
    }

    #[test]
    fn stops_follow_from_time_aperture_and_speed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        let (time, aperture, speed) = ((0x829a, [1, 50]), (0x829d, [28, 10]), (0x8827, [400, 0]));
        with_exif(&path, &[time, aperture, speed]);
        let expected = (400.0_f64 / 50.0 / 2.8 / 2.8).log2();
        assert!((exposure_value(&path).unwrap() - expected).abs() < 1e-9);
        with_exif(&path, &[time, aperture]);
        assert_eq!(exposure_value(&path), None);
        with_exif(&path, &[(0x829a, [0, 50]), aperture, speed]);
        assert_eq!(exposure_value(&path), None);
        std::fs::write(&path, "no photograph").unwrap();
        assert_eq!(exposure_value(&path), None);
        assert_eq!(exposure_value(&folder.path().join("absent.jpg")), None);
    }
}
