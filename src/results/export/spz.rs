//! SPZ: fixed-point positions and 8 bits for everything else, about a tenth of a PLY. Source: the specification of the
//! format.
//!
//! Version 4 has a plain header, a table and a Zstandard stream per attribute; version 3, which more readers support,
//! is one gzip stream of a shorter header and the same bytes. The axes are those of OpenGL.

use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::{Provenance, gzip_with, half_turn, sigmoid, unit};
use crate::splats::scene::{Gaussians, rest_coefficients};
use crate::{Error, Result};

const MAGIC: u32 = 0x5053_474e;
/// Bits of a position, a signed integer.
const POSITION_BITS: u32 = 24;
/// A colour coefficient c of degree 0 is the byte 127.5 + 0.15 * 255 c.
const COLOR_SCALE: f32 = 0.15;

/// The supported versions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Version {
    /// Gzip, which most readers support.
    V3,
    /// Zstandard.
    #[default]
    V4,
}

/// Encodes a model.
///
/// # Errors
/// [`Error::Usage`] if a position is beyond the range of 24 bits in whole units.
pub fn encode(gaussians: &Gaussians, provenance: &Provenance, version: Version) -> Result<Vec<u8>> {
    let gaussians = half_turn(gaussians);
    let fraction = fractional_bits(&gaussians)?;
    let degree = gaussians.shape.sh_degree as u8;
    let count = u32::try_from(gaussians.count)
        .map_err(|_| Error::Usage("SPZ counts Gaussians in 32 bits".to_owned()))?;
    let streams = [
        positions(&gaussians, fraction),
        bytes(gaussians.raw_opacities(), |&opacity| 255.0 * sigmoid(opacity)),
        bytes(floats(gaussians.dc()), |&value| 255.0 * (COLOR_SCALE * value + 0.5)),
        bytes(floats(gaussians.log_scales()), |&value| 16.0 * (value + 10.0)),
        gaussians.quats().iter().flat_map(|&quat| smallest_three(quat).to_le_bytes()).collect(),
        bytes(floats(gaussians.rest()), |&value| 128.0 * (value + 1.0)),
    ];
    let streams = &streams[..if rest_coefficients(degree.into()) > 0 { 6 } else { 5 }];
    let mut file = vec![];
    for word in [MAGIC, if version == Version::V4 { 4 } else { 3 }, count] {
        file.extend(word.to_le_bytes());
    }
    match version {
        Version::V3 => {
            file.extend([degree, fraction, 0, 0]);
            streams.iter().for_each(|stream| file.extend(stream));
            gzip_with(&file, provenance.world_line(&gaussians, true))
        }
        Version::V4 => {
            const HEADER: u32 = 32;
            file.extend([degree, fraction, 0, streams.len() as u8]);
            file.extend(HEADER.to_le_bytes());
            file.resize(HEADER as usize, 0);
            let compressed = streams
                .iter()
                .map(|stream| compress_to_vec(&stream[..], CompressionLevel::Fastest));
            let compressed: Vec<Vec<u8>> = compressed.collect();
            for (stream, compressed) in streams.iter().zip(&compressed) {
                file.extend((compressed.len() as u64).to_le_bytes());
                file.extend((stream.len() as u64).to_le_bytes());
            }
            compressed.iter().for_each(|stream| file.extend(stream));
            // After everything that the table lists, where readers do not look.
            file.extend(provenance.world_line(&gaussians, true).unwrap_or_default().bytes());
            Ok(file)
        }
    }
}

/// The most fractional bits that represent the farthest position.
fn fractional_bits(gaussians: &Gaussians) -> Result<u8> {
    let farthest =
        floats(gaussians.means()).iter().fold(0.0_f32, |most, value| most.max(value.abs()));
    let most = (1 << (POSITION_BITS - 1)) - 1;
    let fits = |bits: &u32| (farthest * (1_u32 << bits) as f32).round() <= most as f32;
    let bits = (0..POSITION_BITS - 1).rev().find(fits).ok_or_else(|| {
        Error::Usage(format!(
            "a Gaussian is {farthest:e} units from the origin, and SPZ reaches {most}; export to PLY or GLB"
        ))
    })?;
    Ok(bits as u8)
}

fn positions(gaussians: &Gaussians, fraction: u8) -> Vec<u8> {
    let scale = (1_u32 << fraction) as f32;
    let fixed = floats(gaussians.means()).iter().map(|value| (value * scale).round() as i32);
    fixed.flat_map(|fixed| fixed.to_le_bytes().into_iter().take(3)).collect()
}

fn floats(vectors: &[glam::Vec3]) -> &[f32] {
    bytemuck::cast_slice(vectors)
}

fn bytes<T>(values: &[T], code: impl Fn(&T) -> f32) -> Vec<u8> {
    values.iter().map(|value| code(value).round().clamp(0.0, 255.0) as u8).collect()
}

/// The index of the largest component among x, y, z, w in two bits, then the others in order: a sign and nine bits of
/// sqrt(2) times the component. The largest is positive and follows from the others.
fn smallest_three([w, x, y, z]: [f32; 4]) -> u32 {
    let [w, x, y, z] = unit([w, x, y, z]);
    let parts = [x, y, z, w];
    let largest =
        (1..4).fold(0, |best, i| if parts[i].abs() > parts[best].abs() { i } else { best });
    let others = (0..4).filter(|&i| i != largest).map(|i| parts[i]);
    others.fold(largest as u32, |code, part| {
        let is_negative = (part < 0.0) != (parts[largest] < 0.0);
        let magnitude = (511.0 * std::f32::consts::SQRT_2 * part.abs()).round().min(511.0) as u32;
        code << 10 | u32::from(is_negative) << 9 | magnitude
    })
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;

    use super::*;
    use crate::results::export::tests::drawn;

    fn encode_alone(model: &Gaussians, version: Version) -> Vec<u8> {
        encode(model, &Provenance::default(), version).unwrap()
    }

    /// The decompressed body after the header.
    fn body(file: &[u8]) -> Vec<u8> {
        let word = |at: usize| u64::from_le_bytes(file[at..at + 8].try_into().unwrap()) as usize;
        if file.starts_with(&[0x1f, 0x8b]) {
            let mut all = vec![];
            flate2::read::GzDecoder::new(file).read_to_end(&mut all).unwrap();
            return all[16..].to_vec();
        }
        let streams = usize::from(file[15]);
        let mut begin = 32 + 16 * streams;
        let mut all = vec![];
        for stream in 0..streams {
            let [compressed, whole] = [0, 8].map(|field| word(32 + 16 * stream + field));
            let mut bytes = vec![];
            let mut decoder =
                ruzstd::decoding::StreamingDecoder::new(&file[begin..begin + compressed]).unwrap();
            decoder.read_to_end(&mut bytes).unwrap();
            assert_eq!(bytes.len(), whole);
            all.extend(bytes);
            begin += compressed;
        }
        assert_eq!(begin, file.len());
        all
    }

    #[test]
    fn both_versions_have_the_same_bytes_at_the_stated_places() {
        for degree in 0..=3 {
            let model = drawn(37, degree);
            let [v3, v4] = [Version::V3, Version::V4].map(|version| encode_alone(&model, version));
            assert_eq!(&v4[..12], &[b'N', b'G', b'S', b'P', 4, 0, 0, 0, 37, 0, 0, 0]);
            assert_eq!([v4[12], v4[14]], [degree as u8, 0]);
            let body = body(&v4);
            assert_eq!(body, self::body(&v3));
            assert_eq!(body.len(), 37 * (9 + 1 + 3 + 3 + 4 + 3 * rest_coefficients(degree)));
        }
    }

    #[test]
    fn positions_use_all_24_bits_and_a_farther_one_is_refused() {
        let mut model = drawn(2, 0);
        model.means_mut()[0] = glam::Vec3::new(3.0, -1.0, 0.25);
        model.means_mut()[1] = glam::Vec3::ZERO;
        assert_eq!(fractional_bits(&model).unwrap(), 21);
        let body = body(&encode_alone(&model, Version::V4));
        let fixed = |at: usize| i32::from_le_bytes([0, body[at], body[at + 1], body[at + 2]]) >> 8;
        // The half turn negates y and z.
        let position = [0, 3, 6].map(|at| fixed(at) as f32 / (1 << 21) as f32);
        assert_eq!(position, [3.0, 1.0, -0.25]);
        model.means_mut()[0].x = 1e7;
        let error = encode(&model, &Provenance::default(), Version::V4).unwrap_err().to_string();
        assert!(error.contains("1e7 units from the origin"), "{error}");
    }

    #[test]
    fn a_rotation_is_decoded_within_the_precision_of_ten_bits() {
        for quat in drawn(200, 0).quats() {
            let code = smallest_three(*quat);
            let largest = (code >> 30) as usize;
            let mut parts = [0.0_f32; 4];
            let others: Vec<usize> = (0..4).filter(|&i| i != largest).collect();
            for (place, &i) in others.iter().enumerate() {
                let bits = code >> (10 * (2 - place));
                let magnitude = (bits & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
                parts[i] = if bits & 512 == 0 { magnitude } else { -magnitude };
            }
            parts[largest] = (1.0 - parts.iter().map(|part| part * part).sum::<f32>()).sqrt();
            let [w, x, y, z] = unit(*quat);
            let dot: f32 = [x, y, z, w].iter().zip(parts).map(|(a, b)| a * b).sum();
            assert!(dot.abs() > 1.0 - 5e-6, "{quat:?}: {dot}");
        }
    }
}
