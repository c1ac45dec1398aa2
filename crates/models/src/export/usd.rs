//! `OpenUSD` with `ParticleField3DGaussianSplat`, at full precision: as text, and packed. Source: `schema.usda` of its
//! module `usdVol`, 26.03.
//!
//! The axes are OpenGL's, y up. Scales and opacities are linear; the coefficients of a Gaussian follow each other, the
//! lowest degree first.

use std::fmt::{self, Write as _};
use std::io::{Cursor, Write as _};

use glam::Vec3;
use nightsplat_core::{Error, Result};
use zip::CompressionMethod;
use zip::write::{SimpleFileOptions, ZipWriter};

use super::glb::clamped;
use super::{GENERATOR, Provenance, half_turn, sigmoid, unit};
use crate::gaussians::Gaussians;

/// The kernel has support up to this many standard deviations.
const SUPPORT: f32 = 3.0;
/// What begins at these multiples of bytes in a package can be mapped into memory.
const ALIGNMENT: u16 = 64;

/// Encodes a model as text. Scales are clamped, with a warning, as in training.
pub fn encode(gaussians: &Gaussians, provenance: &Provenance) -> Result<Vec<u8>> {
    let gaussians = clamped(half_turn(gaussians));
    let mut text = String::new();
    write_stage(&mut text, &gaussians, provenance)
        .map_err(|_| Error::output("the model", "cannot be written as text"))?;
    Ok(text.into_bytes())
}

/// Encodes a model as a package with the text in it.
pub fn pack(gaussians: &Gaussians, provenance: &Provenance) -> Result<Vec<u8>> {
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .with_alignment(ALIGNMENT);
    let failed =
        |error: &dyn fmt::Display| Error::output("the model", format!("cannot be packed: {error}"));
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    zip.start_file("model.usda", options).map_err(|error| failed(&error))?;
    zip.write_all(&encode(gaussians, provenance)?).map_err(|error| failed(&error))?;
    Ok(zip.finish().map_err(|error| failed(&error))?.into_inner())
}

fn write_stage(out: &mut String, model: &Gaussians, provenance: &Provenance) -> fmt::Result {
    let mut lines = provenance.lines();
    lines.extend(provenance.world_line(model, true));
    let color_space = match provenance.facts.linear {
        Some(_) => "lin_rec709_scene",
        None => "srgb_rec709_scene",
    };
    let facts = quoted(&provenance.facts_of(model).json().to_string());
    let lines: Vec<String> = lines.iter().map(|line| quoted(line)).collect();
    writeln!(out, "#usda 1.0")?;
    writeln!(out, "(")?;
    writeln!(out, "    customLayerData = {{")?;
    writeln!(out, "        string creator = {}", quoted(GENERATOR))?;
    writeln!(out, "        string nightsplat = {facts}")?;
    writeln!(out, "        string[] provenance = [{}]", lines.join(", "))?;
    writeln!(out, "    }}")?;
    writeln!(out, "    defaultPrim = \"model\"")?;
    // Photographs show no scale.
    writeln!(out, "    metersPerUnit = 1")?;
    writeln!(out, "    upAxis = \"Y\"")?;
    writeln!(out, ")\n")?;
    writeln!(out, "def ParticleField3DGaussianSplat \"model\" (")?;
    writeln!(out, "    prepend apiSchemas = [\"ColorSpaceAPI\"]")?;
    writeln!(out, ")\n{{")?;
    writeln!(out, "    uniform token colorSpace:name = \"{color_space}\"")?;
    writeln!(out, "    uniform token projectionModeHint = \"perspective\"")?;
    writeln!(out, "    uniform token sortingModeHint = \"zDepth\"")?;
    let degree = model.shape.sh_degree;
    writeln!(out, "    uniform int radiance:sphericalHarmonicsDegree = {degree}")?;
    let scales = || model.log_scales().iter().map(|scale| scale.to_array().map(f32::exp));
    array(out, "float3[] extent", extent(model.means(), scales()))?;
    array(out, "point3f[] positions", model.means().iter().map(|mean| mean.to_array()))?;
    array(out, "quatf[] orientations", model.quats().iter().map(|&quat| unit(quat)))?;
    array(out, "float3[] scales", scales())?;
    array(out, "float[] opacities", model.raw_opacities().iter().map(|&raw| [sigmoid(raw)]))?;
    let rest = model.rest().len() / model.count.max(1);
    let coefficients = model.dc().iter().enumerate().flat_map(|(index, dc)| {
        std::iter::once(dc).chain(&model.rest()[index * rest..][..rest]).map(Vec3::to_array)
    });
    array(out, "float3[] radiance:sphericalHarmonicsCoefficients", coefficients)?;
    writeln!(out, "}}")
}

/// The box around the kernels of the Gaussians, as its corners.
fn extent(means: &[Vec3], scales: impl Iterator<Item = [f32; 3]>) -> [[f32; 3]; 2] {
    let (mut low, mut high) = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
    for (mean, scales) in means.iter().zip(scales) {
        let radius = Vec3::splat(SUPPORT * Vec3::from(scales).max_element());
        (low, high) = (low.min(*mean - radius), high.max(*mean + radius));
    }
    if means.is_empty() { [[0.0; 3]; 2] } else { [low, high].map(|corner| corner.to_array()) }
}

/// An attribute with its values, of which those of several numbers are in parentheses.
fn array<const N: usize>(
    out: &mut String,
    name: &str,
    values: impl IntoIterator<Item = [f32; N]>,
) -> fmt::Result {
    write!(out, "    {name} = [")?;
    for (index, value) in values.into_iter().enumerate() {
        out.push_str(if index == 0 { "" } else { ", " });
        out.push_str(if N == 1 { "" } else { "(" });
        for (at, number) in value.into_iter().enumerate() {
            out.push_str(if at == 0 { "" } else { ", " });
            // Both are read back as the same bits.
            let is_short = number == 0.0 || (1e-4..1e7).contains(&number.abs());
            if is_short { write!(out, "{number}")? } else { write!(out, "{number:e}")? }
        }
        out.push_str(if N == 1 { "" } else { ")" });
    }
    writeln!(out, "]")
}

/// A string with its quotes.
fn quoted(text: &str) -> String {
    let plain = text.replace(char::is_control, " ").replace('\\', "\\\\").replace('"', "\\\"");
    format!("\"{plain}\"")
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::export::tests::drawn;

    /// The numbers of an attribute in a text.
    fn numbers(text: &str, name: &str) -> Vec<f32> {
        let line = text.lines().find(|line| line.contains(&format!("{name} = "))).unwrap();
        let (_, values) = line.split_once(" = ").unwrap();
        let numbers = values.split(['[', ']', '(', ')', ',', ' ']).filter(|part| !part.is_empty());
        numbers.map(|number| number.parse().unwrap()).collect()
    }

    #[test]
    fn every_number_is_read_back_as_the_same_bits() {
        for degree in 0..=3 {
            let mut model = drawn(9, degree);
            model.means_mut()[3] = Vec3::new(1e-9, -2.5e20, 0.0);
            model.origin = DVec3::new(7.0, 0.0, 0.0);
            let provenance = Provenance { dataset: "a \"b\" \\ c".into(), ..Provenance::default() };
            let text = String::from_utf8(encode(&model, &provenance).unwrap()).unwrap();
            assert!(
                text.contains(r#""dataset: a \"b\" \\ c", "world = (x, -y, -z) + (7, "#),
                "{text}"
            );
            let turned = half_turn(&model);
            let flat = |vectors: &[Vec3]| bytemuck::cast_slice::<_, f32>(vectors).to_vec();
            assert_eq!(numbers(&text, "positions"), flat(turned.means()));
            let scales: Vec<f32> = flat(turned.log_scales()).into_iter().map(f32::exp).collect();
            assert_eq!(numbers(&text, "scales"), scales);
            assert_eq!(numbers(&text, "orientations")[..4], unit(turned.quats()[0]));
            let opacities = numbers(&text, "opacities");
            assert!(opacities.len() == 9 && opacities.iter().all(|opacity| *opacity < 1.0));
            let coefficients = numbers(&text, "sphericalHarmonicsCoefficients");
            assert_eq!(coefficients.len(), 27 * (degree as usize + 1).pow(2));
            assert_eq!(coefficients[..3], turned.dc()[0].to_array());
            if degree > 0 {
                assert_eq!(coefficients[3..6], turned.rest()[0].to_array());
            }
            assert_eq!(numbers(&text, "sphericalHarmonicsDegree"), [degree as f32]);
            let extent = numbers(&text, "extent");
            for mean in turned.means() {
                assert!((0..3).all(|i| extent[i] <= mean[i] && mean[i] <= extent[3 + i]));
            }
        }
    }

    #[test]
    fn a_package_has_the_text_uncompressed_at_a_multiple_of_64_bytes() {
        let (model, provenance) = (drawn(5, 1), Provenance::default());
        let text = encode(&model, &provenance).unwrap();
        let file = pack(&model, &provenance).unwrap();
        let begin = file.windows(text.len()).position(|window| window == text).unwrap();
        assert_eq!((&file[..4], begin % 64), (&b"PK\x03\x04"[..], 0));
    }
}
