//! Camera RAW: what the sensor counted, in linear light, its white as the camera balanced it, as sRGB has its colours.

use std::panic::catch_unwind;
use std::path::Path;

use rawler::RawImage;
use rawler::decoders::RawDecodeParams;
use rawler::imgop::develop::{Intermediate, ProcessingStep, RawDevelop};
use rawler::rawsource::RawSource;

use super::{Image, from_interleaved, srgb_from_linear};
use crate::{Error, Result};

/// Black and white level, mosaic, white balance, colour matrix, borders: all that leaves light linear.
const STEPS: [ProcessingStep; 6] = [
    ProcessingStep::Rescale,
    ProcessingStep::Demosaic,
    ProcessingStep::CropActiveArea,
    ProcessingStep::WhiteBalance,
    ProcessingStep::Calibrate,
    ProcessingStep::CropDefault,
];

/// The photograph of a RAW file as the sensor lies, encoded.
///
/// # Errors
/// [`Error::Input`] names a file that is damaged, or of a camera that is not known.
pub(super) fn load(path: &Path, bytes: Vec<u8>) -> Result<Image> {
    let developed = decoded(path, bytes, false, |raw| {
        RawDevelop::new_with(&STEPS).develop_intermediate(raw).map_err(|error| error.to_string())
    })?;
    let size = developed.dim();
    let values: Vec<f32> = match developed {
        Intermediate::ThreeColor(pixels) => pixels.data.into_iter().flatten().collect(),
        Intermediate::Monochrome(pixels) => pixels.data.into_iter().flat_map(|v| [v; 3]).collect(),
        Intermediate::FourColor(_) => {
            return Err(unreadable(path, "four colours without a matrix"));
        }
    };
    // Positive phrasing: a NaN is black.
    let encode = |value: f32| if value > 0.0 { srgb_from_linear(value) } else { 0.0 };
    let values: Vec<f32> = values.into_iter().map(encode).collect();
    Ok(from_interleaved(size.w as u32, size.h as u32, &values))
}

/// Width and height of what [`load`] makes of a file.
///
/// # Errors
/// As there.
pub(super) fn size_of(path: &Path) -> Result<(u32, u32)> {
    let bytes = std::fs::read(path)
        .map_err(|error| Error::input(path, format!("cannot be read: {error}")))?;
    decoded(path, bytes, true, |raw| {
        let area = raw.crop_area.or(raw.active_area).map(|area| area.d);
        let (width, height) = area.map_or((raw.width, raw.height), |size| (size.w, size.h));
        Ok((width as u32, height as u32))
    })
}

/// What `of` makes of the sensor's numbers, which are left out of a dummy.
fn decoded<T>(
    path: &Path,
    bytes: Vec<u8>,
    is_dummy: bool,
    of: impl FnOnce(&RawImage) -> Result<T, String> + std::panic::UnwindSafe,
) -> Result<T> {
    let decode = move || {
        let source = RawSource::new_from_shared_vec(bytes.into());
        let raw = if is_dummy {
            rawler::decode_dummy(&source)
        } else {
            rawler::decode(&source, &RawDecodeParams::default())
        };
        of(&raw.map_err(|error| error.to_string())?)
    };
    // Of what it does not know, the decoder panics here and there.
    let decoded = catch_unwind(decode).unwrap_or_else(|_| Err("its decoder gave up".to_owned()));
    decoded.map_err(|problem| unreadable(path, &problem))
}

fn unreadable(path: &Path, problem: &str) -> Error {
    let problem = problem.lines().next().unwrap_or_default();
    Error::input(
        path,
        format!("is not a readable RAW photograph ({problem}); convert it to 16-bit TIFF or EXR"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The smallest linear DNG: 16-bit pixels of three colours in one strip, a neutral of the camera, black and white.
    fn dng(width: u16, height: u16, pixel: impl Fn(u16, u16) -> [u16; 3]) -> Vec<u8> {
        let short = |values: &[u16]| {
            (
                3_u16,
                values.len() as u32,
                values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
            )
        };
        let rational = |type_: u16, values: &[[i32; 2]]| {
            (
                type_,
                values.len() as u32,
                values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
            )
        };
        let text = |text: &str| (2_u16, text.len() as u32 + 1, [text.as_bytes(), &[0]].concat());
        let bytes = |values: &[u8]| (1_u16, values.len() as u32, values.to_vec());
        let long = |value: u32| (4_u16, 1_u32, value.to_le_bytes().to_vec());
        let pixels: Vec<u8> = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .flat_map(|(x, y)| pixel(x, y))
            .flat_map(u16::to_le_bytes)
            .collect();
        // XYZ to the camera's colours: the camera is one of sRGB's.
        let matrix =
            [32405, -15371, -4985, -9693, 18760, 416, 556, -2040, 10572].map(|v| [v, 10_000]);
        let mut entries = vec![
            (254, long(0)),
            (256, long(width.into())),
            (257, long(height.into())),
            (258, short(&[16; 3])),
            (259, short(&[1])),
            (262, short(&[34892])),
            (271, text("Test")),
            (272, text("Linear")),
            (273, long(8)),
            (274, short(&[1])),
            (277, short(&[3])),
            (278, long(height.into())),
            (279, long(pixels.len() as u32)),
            (284, short(&[1])),
            (50706, bytes(&[1, 4, 0, 0])),
            (50707, bytes(&[1, 1, 0, 0])),
            (50708, text("Test Linear")),
            (50714, short(&[256; 3])),
            (50717, short(&[4352; 3])),
            (50721, rational(10, &matrix)),
            (50728, rational(5, &[[1, 2], [1, 1], [2, 3]])),
            (50778, short(&[21])),
        ];
        entries.sort_by_key(|(tag, _)| *tag);
        let directory = 8 + pixels.len();
        let mut behind = directory + 2 + 12 * entries.len() + 4;
        let mut file = [b"II*\0".as_slice(), &(directory as u32).to_le_bytes(), &pixels].concat();
        file.extend((entries.len() as u16).to_le_bytes());
        let mut values = vec![];
        for (tag, (type_, count, mut value)) in entries {
            file.extend((tag as u16).to_le_bytes());
            file.extend(type_.to_le_bytes());
            file.extend(count.to_le_bytes());
            if value.len() <= 4 {
                value.resize(4, 0);
                file.extend(value);
            } else {
                file.extend((behind as u32).to_le_bytes());
                value.resize(value.len().next_multiple_of(2), 0);
                behind += value.len();
                values.extend(value);
            }
        }
        file.extend([0; 4]);
        file.extend(values);
        file
    }

    #[test]
    fn a_linear_dng_is_linear_light_with_the_cameras_white() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.dng");
        // Grey of known light, 1/16 to 1/2, as a camera sees it whose red and blue are weaker.
        let light = |x: u16| 1.0 / f32::from(16_u16 >> (x / 4));
        let counted = |light: f32| {
            [0.5, 1.0, 2.0 / 3.0].map(|neutral| (256.0 + 4096.0 * neutral * light).round() as u16)
        };
        std::fs::write(&path, dng(16, 8, |x, _| counted(light(x)))).unwrap();
        let image = Image::load(&path).unwrap();
        assert_eq!((image.width, image.height), (16, 8));
        assert_eq!(Image::size_of(&path).unwrap(), (16, 8));
        for x in [1, 5, 9, 13] {
            let expected = srgb_from_linear(light(x));
            for value in image.pixel(x.into(), 4) {
                assert!((value - expected).abs() < 2e-3, "{x}: {value}, not {expected}");
            }
        }
        // Linear light goes the way of EXR: the same photograph, whichever file it is in.
        let exr = folder.path().join("a.exr");
        image.save_exr(&exr).unwrap();
        let other = Image::load(&exr).unwrap();
        let off = image.data.iter().zip(&other.data).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 1e-5);
    }

    #[test]
    fn a_damaged_raw_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.dng");
        let whole = dng(16, 8, |_, _| [1000; 3]);
        for bytes in [&b"no photograph"[..], &whole[..whole.len() / 2], &whole[..100]] {
            std::fs::write(&path, bytes).unwrap();
            let message = Image::load(&path).unwrap_err().to_string();
            assert!(message.contains("a.dng") && !message.contains('\n'), "{message}");
        }
    }
}
