//! Camera RAW: sensor values in linear light, white-balanced as by the camera, in the primaries of sRGB.
//!
//! Light stays linear: noise keeps its sign below black, where a cut would raise the mean of what is dark, and white
//! balance would colour it. So rawler, whose purpose is a picture, decodes and demosaics only; levels, white balance
//! and matrix are here. A highlight is clipped where a channel is at the sensor's white: its channels are limited to
//! the smallest white of a channel after white balance, so that it is white, not magenta. Others keep their light.

use std::panic::catch_unwind;
use std::path::Path;

use nightsplat_core::{Error, Result};
use rawler::RawImage;
use rawler::decoders::RawDecodeParams;
use rawler::imgop::chromatic_adaption::adapt_bradford;
use rawler::imgop::develop::{Intermediate, ProcessingStep, RawDevelop};
use rawler::imgop::matrix::{IDENTITY_MATRIX_3, multiply, normalize, pseudo_inverse, transform_1d};
use rawler::imgop::xyz::{Illuminant, SRGB_TO_XYZ_D65};
use rawler::rawimage::{RawImageData, RawPhotometricInterpretation};
use rawler::rawsource::RawSource;
use rayon::prelude::*;

use super::{Image, srgb_from_linear};

/// What rawler does: demosaicing and crops. Its other steps clip.
const STEPS: [ProcessingStep; 3] =
    [ProcessingStep::Demosaic, ProcessingStep::CropActiveArea, ProcessingStep::CropDefault];

/// A channel at this part of the sensor's white is clipped: demosaicing and sensors leave it a little below.
const CLIPPED: f32 = 0.99;

/// The light in which a camera's matrix is wanted, best first.
const ILLUMINANTS: [Illuminant; 9] = [
    Illuminant::D65,
    Illuminant::A,
    Illuminant::B,
    Illuminant::C,
    Illuminant::D50,
    Illuminant::D55,
    Illuminant::D75,
    Illuminant::Daylight,
    Illuminant::Flash,
];

/// Reads a RAW file in the sensor's orientation, and encodes it.
pub(super) fn load(path: &Path, bytes: Vec<u8>) -> Result<Image> {
    let (size, mut values) = decoded(path, bytes, false, |mut raw| {
        raw.data = RawImageData::Float(above_black(&raw));
        let developed = RawDevelop::new_with(&STEPS).develop_intermediate(&raw);
        let developed = developed.map_err(|error| error.to_string())?;
        let size = developed.dim();
        let values: Vec<f32> = match developed {
            Intermediate::ThreeColor(pixels) => in_srgb(&pixels.data, &raw),
            Intermediate::FourColor(pixels) => in_srgb(&pixels.data, &raw),
            Intermediate::Monochrome(pixels) => {
                pixels.data.into_iter().flat_map(|value| [value; 3]).collect()
            }
        };
        Ok((size, values))
    })?;
    let encode = |value: &mut f32| {
        *value = if value.is_finite() { srgb_from_linear(*value) } else { 0.0 };
    };
    values.par_iter_mut().for_each(encode);
    Ok(from_interleaved(size.w as u32, size.h as u32, &values))
}

/// Sensor values in units of white above black, signed. Black levels are a pattern of samples that repeats; there is a
/// white level for each colour of a pixel, or for each of the four samples of a mosaic.
fn above_black(raw: &RawImage) -> Vec<f32> {
    let (black, white) = (raw.blacklevel.as_vec(), raw.whitelevel.as_vec());
    let (columns, rows) = (raw.blacklevel.width, raw.blacklevel.height);
    let has_four =
        white.len() == 4 && matches!(raw.photometric, RawPhotometricInterpretation::Cfa(_));
    let level = |at: usize| {
        let (pixel, color) = (at / raw.cpp, at % raw.cpp);
        let (x, y) = (pixel % raw.width, pixel / raw.width);
        let sample = (y % rows * columns + x % columns) * raw.blacklevel.cpp + color;
        let white = if has_four { white[y % 2 * 2 + x % 2] } else { white[color % white.len()] };
        (black[sample % black.len()], white)
    };
    let scaled = |(at, value): (usize, &f32)| {
        let (black, white) = level(at);
        (value - black) / (white - black)
    };
    raw.data.as_f32().par_iter().enumerate().map(scaled).collect()
}

/// Linear red, green and blue of sRGB from the channels of a sensor.
fn in_srgb<const N: usize>(pixels: &[[f32; N]], raw: &RawImage) -> Vec<f32> {
    let matrix = srgb_from_camera::<N>(raw);
    // A file without white balance is in the light of its matrix.
    let gains: [f32; N] = std::array::from_fn(|channel| match raw.wb_coeffs[channel] {
        gain if gain.is_finite() => gain,
        _ => 1.0,
    });
    let white = gains.into_iter().fold(f32::INFINITY, f32::min);
    let converted = |pixel: &[f32; N]| {
        let is_clipped = pixel.iter().any(|&value| value >= CLIPPED);
        let most = if is_clipped { white } else { f32::INFINITY };
        let balanced: [f32; N] = std::array::from_fn(|c| (pixel[c] * gains[c]).min(most));
        matrix.map(|row| row.iter().zip(balanced).map(|(weight, value)| weight * value).sum())
    };
    pixels.par_iter().flat_map_iter(converted).collect()
}

/// The matrix from balanced channels to sRGB, which keeps grey.
fn srgb_from_camera<const N: usize>(raw: &RawImage) -> [[f32; N]; 3] {
    let found = raw.color_matrix_find_first(ILLUMINANTS);
    let (light, mut camera_from_xyz) =
        found.unwrap_or_else(|| (Illuminant::D65, IDENTITY_MATRIX_3.as_flattened().to_vec()));
    let of_other_light =
        transform_1d::<3, 3>(&camera_from_xyz).filter(|_| light != Illuminant::D65);
    if let Some(matrix) = of_other_light {
        camera_from_xyz = adapt_bradford(&light, &Illuminant::D65, &matrix).as_flattened().to_vec();
    }
    let (rows, _) = camera_from_xyz.as_chunks::<3>();
    let rows: [[f32; 3]; N] =
        std::array::from_fn(|channel| rows.get(channel).copied().unwrap_or_default());
    pseudo_inverse(normalize(multiply(&rows, &SRGB_TO_XYZ_D65)))
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
    of: impl FnOnce(RawImage) -> Result<T, String> + std::panic::UnwindSafe,
) -> Result<T> {
    let decode = move || {
        let source = RawSource::new_from_shared_vec(bytes.into());
        let raw = if is_dummy {
            rawler::decode_dummy(&source)
        } else {
            rawler::decode(&source, &RawDecodeParams::default())
        };
        of(raw.map_err(|error| error.to_string())?)
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

/// Planes from pixels of red, green and blue.
fn from_interleaved(width: u32, height: u32, values: &[f32]) -> Image {
    let data = (0..3).flat_map(|plane| values.iter().skip(plane).step_by(3).copied()).collect();
    Image { width, height, data }
}
