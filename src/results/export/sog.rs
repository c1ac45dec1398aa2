//! SOG, spatially ordered Gaussians: lossless WebP images of quantised attributes in a ZIP, a fifteenth of a PLY.
//! Source: the specification of the format, version 2.
//!
//! The axes are those of a PLY. Positions are 16 bits of their signed logarithm, scales and colours 8-bit indices of
//! codebooks, rotations three bytes, and the higher coefficients an index of at most 65 536 vectors.

use std::io::{Cursor, Write as _};

use image::{ExtendedColorType, codecs::webp::WebPEncoder};
use serde_json::json;
use zip::write::{SimpleFileOptions, ZipWriter};

use super::palette::{codebook, nearest, vectors};
use super::{GENERATOR, Provenance, sigmoid, unit};
use crate::splats::scene::{Gaussians, rest_coefficients};
use crate::{Error, Result};

/// Vectors of coefficients per row of their image.
const SETS_PER_ROW: usize = 64;

/// Encodes a model.
///
/// # Errors
/// [`Error::Output`] if an image or the archive cannot be encoded.
pub fn encode(gaussians: &Gaussians, provenance: &Provenance) -> Result<Vec<u8>> {
    let (bounds, positions) = positions(gaussians);
    // Neighbours in space are neighbours in the images, which compresses better.
    let mut order: Vec<usize> = (0..gaussians.count).collect();
    order.sort_by_key(|&i| morton(positions[i]));
    let size = image_size(gaussians.count);
    let pixels = |pixel: &dyn Fn(usize) -> [u8; 4]| {
        let mut bytes: Vec<u8> = order.iter().flat_map(|&i| pixel(i)).collect();
        bytes.resize(4 * size[0] * size[1], 255);
        bytes
    };

    let scales = codebook(gaussians.log_scales().iter().flat_map(|scale| scale.to_array()));
    let colors = codebook(gaussians.dc().iter().flat_map(|dc| dc.to_array()));
    let coded = |codes: &[f32], value: glam::Vec3| value.to_array().map(|v| nearest(codes, v));
    let byte = |i: usize, shift: u32| positions[i].map(|value| (value >> shift) as u8);
    let opaque = |[r, g, b]: [u8; 3], a: u8| [r, g, b, a];
    let opacity = |i: usize| (255.0 * sigmoid(gaussians.raw_opacities()[i])).round() as u8;
    let mut files = vec![
        ("means_l.webp", size, pixels(&|i| opaque(byte(i, 0), 255))),
        ("means_u.webp", size, pixels(&|i| opaque(byte(i, 8), 255))),
        ("scales.webp", size, pixels(&|i| opaque(coded(&scales, gaussians.log_scales()[i]), 255))),
        ("quats.webp", size, pixels(&|i| rotation(gaussians.quats()[i]))),
        ("sh0.webp", size, pixels(&|i| opaque(coded(&colors, gaussians.dc()[i]), opacity(i)))),
    ];
    let mut lines = provenance.lines();
    lines.extend(provenance.world_line(gaussians, false));
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": GENERATOR, "provenance": lines },
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
        let mut image: Vec<u8> = sets
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
        image.resize(4 * sets_size[0] * sets_size[1], 255);
        files.push(("shN_centroids.webp", sets_size, image));
        files.push((
            "shN_labels.webp",
            size,
            pixels(&|i| [labels[i] as u8, (labels[i] >> 8) as u8, 0, 255]),
        ));
        meta["shN"] = json!({
            "count": count, "bands": gaussians.shape.sh_degree, "codebook": codes,
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    archive(&meta.to_string(), &files)
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

fn archive(meta: &str, files: &[(&str, [usize; 2], Vec<u8>)]) -> Result<Vec<u8>> {
    let failed = |error: &dyn std::fmt::Display| {
        Error::output("an export", format!("cannot be assembled: {error}"))
    };
    // Stored, since the images are compressed.
    let stored = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    let mut add = |name: &str, bytes: &[u8]| {
        zip.start_file(name, stored).map_err(|error| failed(&error))?;
        zip.write_all(bytes).map_err(|error| failed(&error))
    };
    add("meta.json", meta.as_bytes())?;
    for (name, [width, height], pixels) in files {
        let mut bytes = vec![];
        WebPEncoder::new_lossless(&mut bytes)
            .encode(pixels, *width as u32, *height as u32, ExtendedColorType::Rgba8)
            .map_err(|error| failed(&error))?;
        add(name, &bytes)?;
    }
    Ok(zip.finish().map_err(|error| failed(&error))?.into_inner())
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;

    use super::*;
    use crate::results::export::tests::drawn;

    #[test]
    fn the_images_hold_the_model_within_their_precision() {
        let model = drawn(300, 2);
        let file = encode(&model, &Provenance::default()).unwrap();
        let mut zip = zip::ZipArchive::new(Cursor::new(file)).unwrap();
        let mut read = |name: &str| {
            let mut bytes = vec![];
            zip.by_name(name).unwrap().read_to_end(&mut bytes).unwrap();
            bytes
        };
        let meta: serde_json::Value = serde_json::from_slice(&read("meta.json")).unwrap();
        assert_eq!([&meta["version"], &meta["count"], &meta["shN"]["bands"]], [2, 300, 2]);
        let mut image = |name: &str| {
            let image = image::load_from_memory(&read(name)).unwrap().to_rgba8();
            image.pixels().map(|pixel| pixel.0).collect::<Vec<_>>()
        };
        let [low, high] = ["means_l.webp", "means_u.webp"].map(&mut image);
        let (scales, colors) = (image("scales.webp"), image("sh0.webp"));
        let number = |value: &serde_json::Value| value.as_f64().unwrap();
        let mut errors = [0.0_f64; 3];
        for i in 0..model.count {
            let position = [0, 1, 2].map(|axis| {
                let [least, most] = ["mins", "maxs"].map(|key| number(&meta["means"][key][axis]));
                let share = f64::from(u16::from_le_bytes([low[i][axis], high[i][axis]])) / 65_535.0;
                let log = least + (most - least) * share;
                (log.abs().exp_m1()).copysign(log)
            });
            let distance = |mean: &glam::Vec3| mean.as_dvec3().distance(position.into());
            let near = |a: &glam::Vec3, b: &glam::Vec3| distance(a).total_cmp(&distance(b));
            let own = model.means().iter().min_by(|a, b| near(a, b)).unwrap();
            let index = model.means().iter().position(|mean| mean == own).unwrap();
            let code = |key: &str, place: u8| number(&meta[key]["codebook"][usize::from(place)]);
            let error = [
                distance(own),
                (code("scales", scales[i][0]) - f64::from(model.log_scales()[index].x)).abs(),
                (code("sh0", colors[i][1]) - f64::from(model.dc()[index].y)).abs(),
            ];
            errors = [0, 1, 2].map(|e| errors[e].max(error[e]));
        }
        assert!(errors[0] < 3e-4 && errors[1] < 0.03 && errors[2] < 0.02, "{errors:?}");
    }

    #[test]
    fn models_of_no_gaussian_and_of_one_are_encoded() {
        for count in [0, 1] {
            assert!(!encode(&drawn(count, 1), &Provenance::default()).unwrap().is_empty());
        }
    }
}
