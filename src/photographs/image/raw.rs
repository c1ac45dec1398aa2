//! Camera RAW: sensor values in linear light, white-balanced as by the camera, in the primaries of sRGB.

use std::panic::catch_unwind;
use std::path::Path;

use rawler::RawImage;
use rawler::decoders::RawDecodeParams;
use rawler::imgop::develop::{Intermediate, ProcessingStep, RawDevelop};
use rawler::rawsource::RawSource;

use super::{Image, from_interleaved, srgb_from_linear};
use crate::{Error, Result};

/// Black and white level, demosaicing, white balance, colour matrix and crop: all steps that keep light linear.
const STEPS: [ProcessingStep; 6] = [
    ProcessingStep::Rescale,
    ProcessingStep::Demosaic,
    ProcessingStep::CropActiveArea,
    ProcessingStep::WhiteBalance,
    ProcessingStep::Calibrate,
    ProcessingStep::CropDefault,
];

/// Reads a RAW file in the sensor's orientation, and encodes it.
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
    // Written so that a NaN is black.
    let encode = |value: f32| if value > 0.0 { srgb_from_linear(value) } else { 0.0 };
    let values: Vec<f32> = values.into_iter().map(encode).collect();
    Ok(from_interleaved(size.w as u32, size.h as u32, &values))
}

/// Width and height of the image that [`load`] reads.
pub(super) fn size_of(path: &Path, bytes: Vec<u8>) -> Result<(u32, u32)> {
    decoded(path, bytes, true, |raw| {
        let area = raw.crop_area.or(raw.active_area).map(|area| area.d);
        let (width, height) = area.map_or((raw.width, raw.height), |size| (size.w, size.h));
        Ok((width as u32, height as u32))
    })
}

/// Decodes a file and applies `of`; a dummy decode omits the sensor values.
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
    // The decoder panics on some unknown input.
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
