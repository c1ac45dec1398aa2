//! SPZ: fixed-point positions and 8 bits for everything else, about a tenth of a PLY. Source: the specification of the
//! format.
//!
//! Version 4 has a plain header, a table and a Zstandard stream per attribute; version 3, which more readers support,
//! is one gzip stream of a shorter header and the same bytes. The axes are those of OpenGL. The facts for a renderer,
//! including the origin, are text where readers do not look: in the comment of the gzip header, or at the end of the
//! file.

use std::io::Read;

use flate2::read::GzDecoder;
use glam::Vec3;
use nightsplat_core::{Error, Result};
use ruzstd::decoding::StreamingDecoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::{Provenance, gzip_with, half_turn, raw_opacity, sigmoid, unit};
use crate::gaussians::{Gaussians, MAX_SH_DEGREE, ModelFacts, rest_coefficients};

const MAGIC: u32 = 0x5053_474e;
/// The flag of a model whose opacities are those of a renderer that compensates them for the dilation.
const ANTIALIASED: u8 = 1;
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
    let mut lines: Vec<String> = provenance.world_line(&gaussians, true).into_iter().collect();
    lines.extend(provenance.facts_of(&gaussians).lines());
    let text = lines.join("\n");
    let flags = if provenance.facts.antialiased { ANTIALIASED } else { 0 };
    let mut file = vec![];
    for word in [MAGIC, if version == Version::V4 { 4 } else { 3 }, count] {
        file.extend(word.to_le_bytes());
    }
    match version {
        Version::V3 => {
            file.extend([degree, fraction, flags, 0]);
            streams.iter().for_each(|stream| file.extend(stream));
            gzip_with(&file, Some(text).filter(|text| !text.is_empty()))
        }
        Version::V4 => {
            const HEADER: u32 = 32;
            file.extend([degree, fraction, flags, streams.len() as u8]);
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
            file.extend(text.bytes());
            Ok(file)
        }
    }
}

/// The Gaussians of a file of version 2, 3 or 4, and the facts that it states.
pub fn decode(file: &[u8]) -> Result<(Gaussians, ModelFacts), String> {
    let (header, streams, text) = match file {
        [0x1f, 0x8b, ..] => unzipped(file)?,
        _ => unpacked(file)?,
    };
    let [positions, opacities, colors, scales, rotations, rest] = &streams;
    let mut gaussians = Gaussians::zeros(header.count, header.degree);
    let fixed = |bytes: &[u8]| i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]) >> 8;
    let unit_of_positions = (-f32::from(header.fraction)).exp2();
    for (mean, bytes) in gaussians.means_mut().iter_mut().zip(positions.chunks_exact(9)) {
        *mean =
            Vec3::from_array([0, 3, 6].map(|at| fixed(&bytes[at..]) as f32)) * unit_of_positions;
    }
    for (opacity, &byte) in gaussians.raw_opacities_mut().iter_mut().zip(opacities) {
        *opacity = raw_opacity(byte);
    }
    vectors(gaussians.dc_mut(), colors, |byte| (byte / 255.0 - 0.5) / COLOR_SCALE);
    vectors(gaussians.log_scales_mut(), scales, |byte| byte / 16.0 - 10.0);
    vectors(gaussians.rest_mut(), rest, |byte| byte / 128.0 - 1.0);
    let width = header.rotation_width();
    for (quat, bytes) in gaussians.quats_mut().iter_mut().zip(rotations.chunks_exact(width)) {
        *quat = match *bytes {
            [a, b, c, d] => of_smallest_three(u32::from_le_bytes([a, b, c, d])),
            _ => of_first_three([0, 1, 2].map(|at| f32::from(bytes[at]))),
        };
    }
    let mut gaussians = half_turn(&gaussians);
    let mut facts = ModelFacts { antialiased: header.antialiased, ..ModelFacts::default() };
    String::from_utf8_lossy(&text).lines().try_for_each(|line| facts.set_line(line))?;
    gaussians.origin = facts.origin;
    Ok((gaussians, facts))
}

/// The words at the start of every version.
struct SpzHeader {
    version: u32,
    count: usize,
    degree: u32,
    fraction: u8,
    antialiased: bool,
}

/// Positions, opacities, colours, scales, rotations, higher coefficients.
type Streams = [Vec<u8>; 6];

const TRUNCATED: &str = "is truncated";

impl SpzHeader {
    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let word = |at| word(bytes, at);
        if word(0)? != MAGIC {
            return Err("is not an SPZ".to_owned());
        }
        let [degree, fraction, flags, _] = word(12)?.to_le_bytes();
        if u32::from(degree) > MAX_SH_DEGREE {
            return Err(format!("has SH degree {degree}; {MAX_SH_DEGREE} is the highest"));
        }
        let count = word(8)? as usize;
        let antialiased = flags & ANTIALIASED != 0;
        Ok(Self { version: word(4)?, count, degree: degree.into(), fraction, antialiased })
    }

    fn rotation_width(&self) -> usize {
        if self.version == 2 { 3 } else { 4 }
    }

    /// Refuses a file of this length that packs more than a model does.
    fn check_ratio(&self, packed: usize) -> Result<(), String> {
        /// Bytes for each byte packed, of models that are not small.
        const MOST: usize = 200;
        const SMALL: usize = 1 << 24;
        let bytes: usize = self.lengths().into_iter().fold(0, usize::saturating_add);
        if bytes <= SMALL.max(packed.saturating_mul(MOST)) {
            return Ok(());
        }
        Err(format!("packs {bytes} bytes in {packed}, more than {MOST} in one: it is no model"))
    }

    /// The bytes of each stream.
    fn lengths(&self) -> [usize; 6] {
        let rest = 3 * rest_coefficients(self.degree);
        [9, 1, 3, 3, self.rotation_width(), rest].map(|width| width * self.count)
    }

    fn refused(&self) -> String {
        format!("is SPZ of version {}; versions 2 to 4 are read", self.version)
    }
}

fn word(bytes: &[u8], at: usize) -> Result<u32, String> {
    let word = bytes.get(at..at + 4).and_then(|word| word.try_into().ok());
    word.map(u32::from_le_bytes).ok_or_else(|| TRUNCATED.to_owned())
}

/// Reads exactly `length` bytes from a decoder.
fn exactly(decoder: &mut impl Read, length: usize) -> Result<Vec<u8>, String> {
    let mut bytes = vec![];
    let read = decoder.take(length as u64).read_to_end(&mut bytes);
    read.map_err(|error| format!("cannot be unpacked: {error}"))?;
    if bytes.len() == length { Ok(bytes) } else { Err(TRUNCATED.to_owned()) }
}

/// Header, streams and comment of version 2 or 3.
fn unzipped(file: &[u8]) -> Result<(SpzHeader, Streams, Vec<u8>), String> {
    let mut decoder = GzDecoder::new(file);
    let header = SpzHeader::parse(&exactly(&mut decoder, 16)?)?;
    if !(2..=3).contains(&header.version) {
        return Err(header.refused());
    }
    header.check_ratio(file.len())?;
    let mut streams = Streams::default();
    for (stream, length) in streams.iter_mut().zip(header.lengths()) {
        *stream = exactly(&mut decoder, length)?;
    }
    // Reading to the end verifies the checksum.
    match decoder.read(&mut [0]) {
        Ok(0) => {}
        Ok(_) => return Err(format!("holds more than its {} Gaussians", header.count)),
        Err(error) => return Err(format!("cannot be unpacked: {error}")),
    }
    let comment = decoder.header().and_then(flate2::GzHeader::comment).unwrap_or_default();
    Ok((header, streams, comment.to_vec()))
}

/// Header, streams and what follows them, of version 4.
fn unpacked(file: &[u8]) -> Result<(SpzHeader, Streams, Vec<u8>), String> {
    let header = SpzHeader::parse(file)?;
    if header.version != 4 {
        return Err(header.refused());
    }
    header.check_ratio(file.len())?;
    let stream_count = usize::from(word(file, 12)?.to_le_bytes()[3]);
    let table = word(file, 16)? as usize;
    let mut rest = file.get(table..).and_then(|table| table.get(16 * stream_count..));
    let mut streams = Streams::default();
    let lengths = header.lengths();
    for (index, stream) in streams.iter_mut().enumerate().take(stream_count) {
        let length = word(file, table + 16 * index)? as usize;
        let (packed, after) =
            rest.and_then(|rest| rest.split_at_checked(length)).ok_or(TRUNCATED)?;
        rest = Some(after);
        let mut decoder = StreamingDecoder::new(packed)
            .map_err(|error| format!("cannot be unpacked: {error}"))?;
        *stream = exactly(&mut decoder, lengths[index])?;
    }
    match streams.iter().zip(lengths).all(|(stream, length)| stream.len() == length) {
        true => Ok((header, streams, rest.unwrap_or_default().to_vec())),
        false => Err(format!("has {stream_count} streams of attributes, which are too few")),
    }
}

fn vectors(vectors: &mut [Vec3], bytes: &[u8], value: impl Fn(f32) -> f32) {
    let numbers: &mut [f32] = bytemuck::cast_slice_mut(vectors);
    numbers.iter_mut().zip(bytes).for_each(|(number, &byte)| *number = value(byte.into()));
}

/// The inverse of [`smallest_three`], as (w, x, y, z).
fn of_smallest_three(code: u32) -> [f32; 4] {
    let largest = (code >> 30) as usize;
    let mut parts = [0.0_f32; 4];
    for (part, i) in (0..4).filter(|&i| i != largest).enumerate() {
        let bits = code >> (10 * (2 - part));
        let magnitude = (bits & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
        parts[i] = if bits & 512 == 0 { magnitude } else { -magnitude };
    }
    parts[largest] = (1.0 - parts.iter().map(|part| part * part).sum::<f32>()).max(0.0).sqrt();
    let [x, y, z, w] = parts;
    [w, x, y, z]
}

/// Version 2: x, y and z in a byte each; w is positive.
fn of_first_three(bytes: [f32; 3]) -> [f32; 4] {
    let [x, y, z] = bytes.map(|byte| byte / 127.5 - 1.0);
    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
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

fn floats(vectors: &[Vec3]) -> &[f32] {
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
    use super::*;
    use crate::export::tests::drawn;
    use nightsplat_photographs::tone::SceneLaw;

    fn encode_alone(model: &Gaussians, version: Version) -> Vec<u8> {
        encode(model, &Provenance::default(), version).unwrap()
    }

    /// The decompressed body after the header.
    fn body(file: &[u8]) -> Vec<u8> {
        let word = |at: usize| u64::from_le_bytes(file[at..at + 8].try_into().unwrap()) as usize;
        if file.starts_with(&[0x1f, 0x8b]) {
            let mut all = vec![];
            GzDecoder::new(file).read_to_end(&mut all).unwrap();
            return all[16..].to_vec();
        }
        let streams = usize::from(file[15]);
        let mut begin = 32 + 16 * streams;
        let mut all = vec![];
        for stream in 0..streams {
            let [compressed, whole] = [0, 8].map(|field| word(32 + 16 * stream + field));
            let mut bytes = vec![];
            let mut decoder = StreamingDecoder::new(&file[begin..begin + compressed]).unwrap();
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
        model.means_mut()[0] = Vec3::new(3.0, -1.0, 0.25);
        model.means_mut()[1] = Vec3::ZERO;
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
            let expected = unit(*quat);
            let back = of_smallest_three(smallest_three(*quat));
            let dot: f32 = expected.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!(dot.abs() > 1.0 - 5e-6, "{quat:?}: {dot}");
        }
        let back = of_first_three([127.5, 255.0, 127.5]);
        assert_eq!(back, [0.0, 0.0, 1.0, 0.0]);
    }

    #[test]
    fn a_decoded_model_agrees_within_its_precision_and_has_the_stated_facts() {
        let mut model = drawn(37, 3);
        model.origin = glam::DVec3::new(4_499_999.6, -519_997.7, 10_001.8);
        let facts = ModelFacts {
            near: Some(0.1),
            max_alpha: Some(0.999),
            raw_colors: Some(true),
            antialiased: true,
            linear: None,
            law: SceneLaw::parse("auto 4.25 0.0125 0.075 1 1 0.333"),
            targets: Some(
                r#"{"downscale":4.0,"exclude":["a\u0020b"],"tone.curve":"auto"}"#.to_owned(),
            ),
            origin: model.origin,
        };
        let provenance = Provenance { facts: facts.clone(), ..Provenance::default() };
        for version in [Version::V3, Version::V4] {
            let file = encode(&model, &provenance, version).unwrap();
            if version == Version::V4 {
                assert_eq!(file[14], ANTIALIASED, "the flag that other readers know");
            }
            let (back, stated) = decode(&file).unwrap();
            assert_eq!((&stated, back.origin, back.shape), (&facts, model.origin, model.shape));
            let error = |values: &[f32], back: &[f32]| {
                values.iter().zip(back).fold(0.0_f32, |most, (a, b)| most.max((a - b).abs()))
            };
            let pairs = [
                (error(floats(model.means()), floats(back.means())), 1e-6),
                (error(floats(model.dc()), floats(back.dc())), 0.014),
                (error(floats(model.log_scales()), floats(back.log_scales())), 0.032),
                (error(floats(model.rest()), floats(back.rest())), 0.004),
                (error(model.raw_opacities(), back.raw_opacities()), 0.14),
            ];
            assert!(pairs.iter().all(|(error, most)| error <= most), "{pairs:?}");
            // A second round trip is exact.
            let again = decode(&encode(&back, &provenance, version).unwrap()).unwrap().0;
            assert_eq!((again.means(), again.dc()), (back.means(), back.dc()), "{version:?}");
        }
        let (_, nothing) = decode(&encode_alone(&drawn(3, 0), Version::V4)).unwrap();
        assert_eq!(nothing, ModelFacts::default());
    }

    #[test]
    fn a_truncated_or_edited_file_is_an_error_and_not_a_panic() {
        let facts = ModelFacts { near: Some(0.1), ..ModelFacts::default() };
        let provenance = Provenance { facts: facts.clone(), ..Provenance::default() };
        for version in [Version::V3, Version::V4] {
            let file = encode(&drawn(5, 1), &provenance, version).unwrap();
            // A file of version 4 ends with the text, which is optional.
            let end =
                file.len() - if version == Version::V4 { "nightsplat near 0.1".len() } else { 0 };
            for length in 0..end {
                assert!(decode(&file[..length]).is_err(), "{version:?}: {length} bytes");
            }
            for byte in 0..file.len() {
                let mut edited = file.clone();
                edited[byte] ^= 0x41;
                drop(decode(&edited));
            }
        }
        let mut file = encode(&drawn(5, 1), &provenance, Version::V4).unwrap();
        let byte = file.len() - 3;
        file[byte] = b'x';
        let problem = decode(&file).unwrap_err();
        assert_eq!(problem, "states near `x.1`, which is not a finite number above 0");
        file[4] = 9;
        assert_eq!(decode(&file).unwrap_err(), "is SPZ of version 9; versions 2 to 4 are read");
    }

    #[test]
    fn a_small_file_that_expands_to_millions_of_gaussians_is_refused() {
        let header =
            SpzHeader { version: 3, count: 1 << 21, degree: 0, fraction: 12, antialiased: false };
        let error = header.check_ratio(100_000).unwrap_err();
        assert!(error.contains("more than 200 in one"), "{error}");
        header.check_ratio(1_000_000).unwrap();
    }
}
