//! SOG, spatially ordered Gaussians: lossless WebP images of quantised attributes in a ZIP, a fifteenth of a PLY.
//! Source: the specification of the format, version 2.
//!
//! The axes are those of a PLY. Positions are 16 bits of their signed logarithm, scales and colours 8-bit indices of
//! codebooks, rotations three bytes, and the higher coefficients an index of at most 65 536 vectors.

use std::io::{Cursor, Read as _, Write as _};
use std::path::Path;

use glam::Vec3;
use image::codecs::webp::{WebPDecoder, WebPEncoder};
use image::{ExtendedColorType, ImageDecoder, ImageError};
use nightsplat_core::output::{create_folder, write_whole};
use nightsplat_core::{Error, Result};
use serde::Deserialize;
use serde_json::{Value, json};
use zip::ZipArchive;
use zip::write::{SimpleFileOptions, ZipWriter};

use super::palette::{codebook, nearest, vectors};
use super::{GENERATOR, Provenance, raw_opacity, sigmoid, unit};
use crate::gaussians::{Gaussians, MAX_SH_DEGREE, ModelFacts, rest_coefficients};

/// Vectors of coefficients per row of their image.
const SETS_PER_ROW: usize = 64;

/// Encodes a model.
pub fn encode(gaussians: &Gaussians, provenance: &Provenance) -> Result<Vec<u8>> {
    archive(&encoded(gaussians, provenance, &[gaussians.count]))
}

/// Writes a model as files in a folder, which is created. The Gaussians of a cell stay together, and cells keep their
/// order; `counts` are their Gaussians.
pub(super) fn write_folder(
    folder: &Path,
    gaussians: &Gaussians,
    provenance: &Provenance,
    counts: &[usize],
) -> Result<()> {
    create_folder(folder)?;
    let SogFiles { meta, images } = encoded(gaussians, provenance, counts);
    for image in &images {
        write_whole(&folder.join(image.name), &image.webp()?)?;
    }
    write_whole(&folder.join(META), meta.as_bytes())
}

/// The name of the description.
pub(super) const META: &str = "meta.json";

/// A model as a description and images.
struct SogFiles {
    meta: String,
    images: Vec<Pixmap>,
}

/// An image of four bytes a pixel.
struct Pixmap {
    name: &'static str,
    size: [usize; 2],
    bytes: Vec<u8>,
}

impl Pixmap {
    fn webp(&self) -> Result<Vec<u8>> {
        let ([width, height], mut bytes) = (self.size.map(|side| side as u32), vec![]);
        WebPEncoder::new_lossless(&mut bytes)
            .encode(&self.bytes, width, height, ExtendedColorType::Rgba8)
            .map_err(|error| failed(&error))?;
        Ok(bytes)
    }
}

fn failed(error: &dyn std::fmt::Display) -> Error {
    Error::output("an export", format!("cannot be assembled: {error}"))
}

/// The Gaussians of each cell in the order of a Z-order curve.
fn encoded(gaussians: &Gaussians, provenance: &Provenance, counts: &[usize]) -> SogFiles {
    let (bounds, positions) = positions(gaussians);
    // Neighbours in space are neighbours in the images, which compresses better.
    let mut order: Vec<usize> = (0..gaussians.count).collect();
    let mut begin = 0;
    for &count in counts {
        order[begin..begin + count].sort_by_key(|&i| morton(positions[i]));
        begin += count;
    }
    let size = image_size(gaussians.count);
    let pixels = |pixel: &dyn Fn(usize) -> [u8; 4]| {
        let mut bytes: Vec<u8> = order.iter().flat_map(|&i| pixel(i)).collect();
        bytes.resize(4 * size[0] * size[1], 255);
        bytes
    };

    let scales = codebook(gaussians.log_scales().iter().flat_map(|scale| scale.to_array()));
    let colors = codebook(gaussians.dc().iter().flat_map(|dc| dc.to_array()));
    let coded = |codes: &[f32], value: Vec3| value.to_array().map(|v| nearest(codes, v));
    let byte = |i: usize, shift: u32| positions[i].map(|value| (value >> shift) as u8);
    let opaque = |[r, g, b]: [u8; 3], a: u8| [r, g, b, a];
    let opacity = |i: usize| (255.0 * sigmoid(gaussians.raw_opacities()[i])).round() as u8;
    let image = |name, size, bytes| Pixmap { name, size, bytes };
    let mut images = vec![
        image("means_l.webp", size, pixels(&|i| opaque(byte(i, 0), 255))),
        image("means_u.webp", size, pixels(&|i| opaque(byte(i, 8), 255))),
        image(
            "scales.webp",
            size,
            pixels(&|i| opaque(coded(&scales, gaussians.log_scales()[i]), 255)),
        ),
        image("quats.webp", size, pixels(&|i| rotation(gaussians.quats()[i]))),
        image("sh0.webp", size, pixels(&|i| opaque(coded(&colors, gaussians.dc()[i]), opacity(i)))),
    ];
    let mut lines = provenance.lines();
    lines.extend(provenance.world_line(gaussians, false));
    let mut meta = json!({
        "version": 2,
        "asset": {
            "generator": GENERATOR, "provenance": lines,
            "nightsplat": provenance.facts_of(gaussians).json(),
        },
        "count": gaussians.count,
        "antialias": false,
        "means": { "mins": bounds[0], "maxs": bounds[1], "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": scales, "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": colors, "files": ["sh0.webp"] },
    });
    let coefficients = rest_coefficients(gaussians.shape.sh_degree);
    if coefficients > 0 {
        let rest = bytemuck::cast_slice(gaussians.rest());
        let (sets, labels) = vectors(rest, 3 * coefficients, sets_of(gaussians.count));
        let codes = codebook(sets.iter().copied());
        let count = sets.len() / (3 * coefficients);
        let rows = count.div_ceil(SETS_PER_ROW).max(1);
        let mut codes_of_sets: Vec<u8> = sets
            .chunks_exact(3)
            .flat_map(|value| {
                [
                    nearest(&codes, value[0]),
                    nearest(&codes, value[1]),
                    nearest(&codes, value[2]),
                    255,
                ]
            })
            .collect();
        let sets_size = [SETS_PER_ROW * coefficients, rows];
        codes_of_sets.resize(4 * sets_size[0] * sets_size[1], 255);
        images.push(image("shN_centroids.webp", sets_size, codes_of_sets));
        images.push(image(
            "shN_labels.webp",
            size,
            pixels(&|i| [labels[i] as u8, (labels[i] >> 8) as u8, 0, 255]),
        ));
        meta["shN"] = json!({
            "count": count, "bands": gaussians.shape.sh_degree, "codebook": codes,
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    SogFiles { meta: meta.to_string(), images }
}

/// Minimum and maximum of the signed logarithm per axis, and each position between them in 16 bits.
fn positions(gaussians: &Gaussians) -> ([[f32; 3]; 2], Vec<[u16; 3]>) {
    let logarithm = |x: f32| (x.abs() + 1.0).ln().copysign(x);
    let logarithms = || gaussians.means().iter().map(|mean| mean.to_array().map(logarithm));
    let bound = |start: f32, pick: fn(f32, f32) -> f32| {
        let bound =
            logarithms().fold([start; 3], |a, b| [0, 1, 2].map(|axis| pick(a[axis], b[axis])));
        bound.map(|value| if value.is_finite() { value } else { 0.0 })
    };
    let [low, high] = [bound(f32::INFINITY, f32::min), bound(f32::NEG_INFINITY, f32::max)];
    let fixed = |value: [f32; 3]| {
        [0, 1, 2].map(|axis| {
            let width = high[axis] - low[axis];
            let share = if width > 0.0 { (value[axis] - low[axis]) / width } else { 0.0 };
            (share * 65_535.0).round() as u16
        })
    };
    ([low, high], logarithms().map(fixed).collect())
}

/// The index along a Z-order curve.
fn morton(position: [u16; 3]) -> u64 {
    let spread =
        |value: u16| (0..16).fold(0, |bits, bit| bits | u64::from(value >> bit & 1) << (3 * bit));
    let [x, y, z] = position.map(spread);
    x | y << 1 | z << 2
}

/// The three smaller components of (w, x, y, z) in a byte each, in order, then the index of the largest.
fn rotation(quat: [f32; 4]) -> [u8; 4] {
    let parts = unit(quat);
    let largest =
        (1..4).fold(0, |best, i| if parts[i].abs() > parts[best].abs() { i } else { best });
    let sign = 1_f32.copysign(parts[largest]);
    let byte = |part: f32| {
        (255.0 * (0.5 + sign * part * std::f32::consts::FRAC_1_SQRT_2)).round().clamp(0.0, 255.0)
            as u8
    };
    let mut others = (0..4).filter(|&i| i != largest).map(|i| byte(parts[i]));
    let mut next = || others.next().unwrap_or_default();
    [next(), next(), next(), 252 + largest as u8]
}

/// The size of the palette: a quarter of the Gaussians, at most 65 536.
fn sets_of(count: usize) -> usize {
    (count / 4).clamp(1024, 1 << 16)
}

/// Width and height, nearly square.
fn image_size(count: usize) -> [usize; 2] {
    let width = ((count as f64).sqrt().ceil() as usize).next_multiple_of(4).max(4);
    [width, count.div_ceil(width).max(1)]
}

fn archive(SogFiles { meta, images }: &SogFiles) -> Result<Vec<u8>> {
    // Stored, since the images are compressed.
    let stored = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    let mut add = |name: &str, bytes: &[u8]| {
        zip.start_file(name, stored).map_err(|error| failed(&error))?;
        zip.write_all(bytes).map_err(|error| failed(&error))
    };
    add(META, meta.as_bytes())?;
    for image in images {
        add(image.name, &image.webp()?)?;
    }
    Ok(zip.finish().map_err(|error| failed(&error))?.into_inner())
}

/// The parts of `meta.json` that are read.
#[derive(Deserialize)]
struct Meta {
    count: usize,
    #[serde(default)]
    asset: Value,
    means: Means,
    scales: Coded,
    quats: Coded,
    sh0: Coded,
    #[serde(rename = "shN")]
    rest: Option<Rest>,
}

#[derive(Deserialize)]
struct Means {
    mins: [f32; 3],
    maxs: [f32; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct Coded {
    #[serde(default)]
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct Rest {
    bands: u32,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// The most rows of the palette: it has at most 65 536 sets.
const MOST_ROWS: usize = 1024;
/// Maximum size of a file in the archive, bytes.
const MOST: u64 = 1 << 30;

/// The Gaussians of a file of version 2, and the facts that it states.
pub fn decode(file: &[u8]) -> Result<(Gaussians, ModelFacts), String> {
    let mut zip =
        ZipArchive::new(Cursor::new(file)).map_err(|error| format!("is not a SOG: {error}"))?;
    let meta = bytes_of(&mut zip, META)?;
    let meta: Value =
        serde_json::from_slice(&meta).map_err(|error| format!("meta.json: {error}"))?;
    if meta["version"] != 2 {
        return Err(format!("is SOG of version {}; version 2 is read", meta["version"]));
    }
    let meta: Meta = serde_json::from_value(meta).map_err(|error| format!("meta.json: {error}"))?;
    let Meta { count, means, scales, quats, sh0, .. } = &meta;
    let [low, high] = [&means.files[0], &means.files[1]];
    let [low, high] = [image_of(&mut zip, low, *count)?, image_of(&mut zip, high, *count)?];
    let [scale_codes, quat_bytes, color_codes] = [
        image_of(&mut zip, &scales.files[0], *count)?,
        image_of(&mut zip, &quats.files[0], *count)?,
        image_of(&mut zip, &sh0.files[0], *count)?,
    ];
    let degree = meta.rest.as_ref().map_or(0, |rest| rest.bands);
    if degree > MAX_SH_DEGREE {
        return Err(format!("has SH degree {degree}; {MAX_SH_DEGREE} is the highest"));
    }
    let mut gaussians = Gaussians::zeros(*count, degree);
    for (i, mean) in gaussians.means_mut().iter_mut().enumerate() {
        *mean = Vec3::from_array([0, 1, 2].map(|axis| {
            let share = f32::from(u16::from_le_bytes([low[i][axis], high[i][axis]])) / 65_535.0;
            let log = means.mins[axis] + (means.maxs[axis] - means.mins[axis]) * share;
            log.abs().exp_m1().copysign(log)
        }));
    }
    for (scale, codes) in gaussians.log_scales_mut().iter_mut().zip(&scale_codes.0) {
        *scale = decoded(&scales.codebook, *codes)?;
    }
    for (quat, bytes) in gaussians.quats_mut().iter_mut().zip(&quat_bytes.0) {
        *quat = of_rotation(*bytes);
    }
    for (dc, codes) in gaussians.dc_mut().iter_mut().zip(&color_codes.0) {
        *dc = decoded(&sh0.codebook, *codes)?;
    }
    for (opacity, [.., byte]) in gaussians.raw_opacities_mut().iter_mut().zip(&color_codes.0) {
        *opacity = raw_opacity(*byte);
    }
    if let Some(rest) = &meta.rest {
        decode_rest(&mut zip, rest, &mut gaussians)?;
    }
    if let Some(index) = gaussians.parameters.iter().position(|value| !value.is_finite()) {
        return Err(format!("number {index} is not finite"));
    }
    let facts = ModelFacts::of_json(&meta.asset["nightsplat"])?;
    gaussians.origin = facts.origin;
    Ok((gaussians, facts))
}

/// The higher coefficients.
fn decode_rest(
    zip: &mut Archive<'_>,
    rest: &Rest,
    gaussians: &mut Gaussians,
) -> Result<(), String> {
    let coefficients = rest_coefficients(rest.bands);
    let [sets, labels] = &rest.files;
    let labels = image_of(zip, labels, gaussians.count)?;
    let per_row = SETS_PER_ROW * coefficients;
    let sets = image_within(zip, sets, |width, height| {
        if coefficients > 0 && width != per_row {
            return Err(format!("is {width} pixels wide, not {per_row}"));
        }
        let is_more = height > MOST_ROWS;
        if is_more { Err(format!("has {height} rows, more than {MOST_ROWS}")) } else { Ok(()) }
    })?;
    let rows = gaussians.rest_mut().chunks_exact_mut(coefficients.max(1));
    for (values, [a, b, ..]) in rows.zip(&labels.0) {
        let first = coefficients * usize::from(u16::from_le_bytes([*a, *b]));
        for (value, coefficient) in values.iter_mut().zip(first..) {
            let codes = sets.0.get(coefficient).ok_or("has a label beyond its coefficients")?;
            *value = decoded(&rest.codebook, *codes)?;
        }
    }
    Ok(())
}

type Archive<'a> = ZipArchive<Cursor<&'a [u8]>>;

fn bytes_of(zip: &mut Archive<'_>, name: &str) -> Result<Vec<u8>, String> {
    let file = zip.by_name(name).map_err(|error| format!("is not a SOG: {name}: {error}"))?;
    let mut bytes = vec![];
    file.take(MOST).read_to_end(&mut bytes).map_err(|error| format!("{name}: {error}"))?;
    Ok(bytes)
}

/// The pixels of an image.
struct SogPixels(Vec<[u8; 4]>);

impl std::ops::Index<usize> for SogPixels {
    type Output = [u8; 4];

    fn index(&self, pixel: usize) -> &[u8; 4] {
        &self.0[pixel]
    }
}

/// An image of at least `count` pixels, and of few more: encoders fill up to a multiple of four rows.
fn image_of(zip: &mut Archive<'_>, name: &str, count: usize) -> Result<SogPixels, String> {
    image_within(zip, name, |width, height| {
        let pixels = width.saturating_mul(height);
        let is_enough = pixels >= count;
        let is_more = height > count.div_ceil(width.max(1)).next_multiple_of(4).max(4);
        match is_enough && !is_more {
            true => Ok(()),
            false => Err(format!("has {pixels} pixels for {count} Gaussians")),
        }
    })
}

/// An image whose header has a size, width and height, that `check` accepts.
fn image_within(
    zip: &mut Archive<'_>,
    name: &str,
    check: impl FnOnce(usize, usize) -> Result<(), String>,
) -> Result<SogPixels, String> {
    let bytes = bytes_of(zip, name)?;
    let unreadable = |error: ImageError| format!("{name}: {error}");
    let decoder = WebPDecoder::new(Cursor::new(bytes.as_slice())).map_err(unreadable)?;
    let (width, height) = decoder.dimensions();
    check(width as usize, height as usize).map_err(|problem| format!("{name} {problem}"))?;
    let image = image::DynamicImage::from_decoder(decoder).map_err(unreadable)?.to_rgba8();
    let (pixels, _) = image.as_raw().as_chunks();
    Ok(SogPixels(pixels.to_vec()))
}

/// The three numbers that a pixel encodes.
fn decoded(codebook: &[f32], [a, b, c, _]: [u8; 4]) -> Result<Vec3, String> {
    let number = |code: u8| codebook.get(usize::from(code)).copied();
    let numbers = number(a).zip(number(b)).zip(number(c));
    let numbers = numbers.ok_or("has a code beyond its codebook")?;
    Ok(Vec3::new(numbers.0.0, numbers.0.1, numbers.1))
}

/// The inverse of [`rotation`].
fn of_rotation([a, b, c, largest]: [u8; 4]) -> [f32; 4] {
    let part = |byte: u8| (f32::from(byte) / 255.0 - 0.5) * std::f32::consts::SQRT_2;
    let largest = usize::from(largest.saturating_sub(252)).min(3);
    let mut parts = [0.0_f32; 4];
    for (i, byte) in (0..4).filter(|&i| i != largest).zip([a, b, c]) {
        parts[i] = part(byte);
    }
    parts[largest] = (1.0 - parts.iter().map(|part| part * part).sum::<f32>()).max(0.0).sqrt();
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::tests::drawn;
    use nightsplat_photographs::tone::SceneLaw;

    #[test]
    fn a_decoded_model_agrees_within_its_precision_and_has_the_stated_facts() {
        for degree in [0, 2] {
            let mut model = drawn(300, degree);
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
            let (back, stated) = decode(&encode(&model, &provenance).unwrap()).unwrap();
            assert_eq!(
                (stated, back.origin, back.shape),
                (facts.clone(), model.origin, model.shape)
            );
            let mut errors = [0.0_f32; 5];
            for i in 0..model.count {
                let distance = |j: &usize| back.means()[*j].distance(model.means()[i]);
                let nearest = (0..back.count).min_by(|a, b| distance(a).total_cmp(&distance(b)));
                let j = nearest.unwrap();
                let [quat, other] = [unit(model.quats()[i]), back.quats()[j]];
                let dot: f32 = quat.iter().zip(other).map(|(a, b)| a * b).sum();
                let error = [
                    distance(&j),
                    (back.log_scales()[j] - model.log_scales()[i]).abs().max_element(),
                    (back.dc()[j] - model.dc()[i]).abs().max_element(),
                    1.0 - dot.abs(),
                    (back.raw_opacities()[j] - model.raw_opacities()[i]).abs(),
                ];
                errors = [0, 1, 2, 3, 4].map(|e| errors[e].max(error[e]));
            }
            let most = [3e-4, 0.03, 0.02, 1e-4, 0.14];
            assert!(errors.iter().zip(most).all(|(error, most)| *error < most), "{errors:?}");
            // As many vectors in the palette as Gaussians: each has its own.
            let sum = |model: &Gaussians| model.rest().iter().sum::<Vec3>();
            assert!((sum(&back) - sum(&model)).abs().max_element() < 0.5, "{degree}");
        }
        let (_, nothing) = decode(&encode(&drawn(3, 0), &Provenance::default()).unwrap()).unwrap();
        assert_eq!(nothing, ModelFacts::default());
    }

    #[test]
    fn a_truncated_or_edited_file_is_an_error_and_not_a_panic() {
        let file = encode(&drawn(40, 1), &Provenance::default()).unwrap();
        for length in (0..file.len()).step_by(7) {
            assert!(decode(&file[..length]).is_err(), "{length} bytes");
        }
        for byte in (0..file.len()).step_by(3) {
            let mut edited = file.clone();
            edited[byte] ^= 0x41;
            drop(decode(&edited));
        }
        let of_meta = |meta: &str| SogFiles { meta: meta.to_owned(), images: vec![] };
        let problem = |meta: &str| decode(&archive(&of_meta(meta)).unwrap()).unwrap_err();
        assert_eq!(problem(r#"{"version":1}"#), "is SOG of version 1; version 2 is read");
        assert!(problem(r#"{"version":2,"count":1}"#).contains("missing field `means`"));
        assert!(problem("{").starts_with("meta.json: "));
    }

    #[test]
    fn models_of_no_gaussian_and_of_one_are_encoded() {
        for count in [0, 1] {
            let file = encode(&drawn(count, 1), &Provenance::default()).unwrap();
            assert_eq!(decode(&file).unwrap().0.count, count);
        }
    }

    #[test]
    fn an_image_with_far_more_pixels_than_gaussians_is_refused_by_its_header() {
        let name = "means_l.webp";
        let found = |(width, height): (u32, u32), count| {
            let mut image = Vec::new();
            let pixels = vec![0; 4 * (width * height) as usize];
            WebPEncoder::new_lossless(&mut image)
                .encode(&pixels, width, height, ExtendedColorType::Rgba8)
                .unwrap();
            let mut zip = ZipWriter::new(Cursor::new(vec![]));
            zip.start_file(
                name,
                SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored),
            )
            .unwrap();
            std::io::Write::write_all(&mut zip, &image).unwrap();
            let file = zip.finish().unwrap().into_inner();
            let mut zip = ZipArchive::new(Cursor::new(file.as_slice())).unwrap();
            image_of(&mut zip, name, count).map(|pixels| pixels.0.len())
        };
        assert_eq!(found((4, 4), 1), Ok(16));
        assert_eq!(found((8, 8), 40), Ok(64));
        for (size, count) in [((8, 8), 1), ((8, 8), 65)] {
            let error = found(size, count).unwrap_err();
            assert!(error.contains("64 pixels"), "{error}");
        }
    }
}
