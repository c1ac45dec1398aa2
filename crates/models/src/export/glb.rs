//! Binary glTF with `KHR_gaussian_splatting`, at full precision. Source: the text of the extension.
//!
//! The axes are OpenGL's, and the coefficients are rotated with them: not every reader rotates coefficients with a
//! node.

use glam::Vec3;
use nightsplat_core::{Error, Result};
use nightsplat_photographs::image::linear_from_srgb;
use serde_json::{Map, Value, json};

use super::{GENERATOR, Provenance, half_turn, sigmoid, unit};
use crate::gaussians::{Gaussians, LOG_SCALE_MAX, LOG_SCALE_MIN, SH_C0, rest_coefficients};

const FLOAT: u32 = 5126;
const EXTENSION: &str = "KHR_gaussian_splatting";

/// One attribute: name, type and values.
struct GlbAttribute {
    name: String,
    kind: &'static str,
    values: Vec<f32>,
}

/// Encodes a model. Scales are clamped, with a warning, as in training: glTF has no infinities.
pub fn encode(gaussians: &Gaussians, provenance: &Provenance) -> Result<Vec<u8>> {
    let gaussians = clamped(half_turn(gaussians));
    let planes = planes(&gaussians, provenance.facts.linear.is_some());
    let json = description(&gaussians, &planes, provenance).to_string();
    let body: usize = planes.iter().map(|plane| 4 * plane.values.len()).sum();
    let text = json.len().next_multiple_of(4);
    let length = u32::try_from(12 + 8 + text + 8 + body)
        .map_err(|_| Error::Usage("the model does not fit into a GLB; export to PLY".to_owned()))?;

    let mut file = Vec::with_capacity(length as usize);
    for word in [0x4654_6c67, 2, length, text as u32, 0x4e4f_534a] {
        file.extend(u32::to_le_bytes(word));
    }
    file.extend(json.bytes());
    file.resize(20 + text, b' ');
    for word in [body as u32, 0x004e_4942] {
        file.extend(u32::to_le_bytes(word));
    }
    for plane in &planes {
        plane.values.iter().for_each(|value| file.extend(value.to_le_bytes()));
    }
    Ok(file)
}

/// The Gaussians with scales as training clamps them; warns where that changes one.
pub(super) fn clamped(mut gaussians: Gaussians) -> Gaussians {
    let mut count = 0;
    let [least, most] = [LOG_SCALE_MIN, LOG_SCALE_MAX].map(|bound| bound as f32);
    for scale in gaussians.log_scales_mut() {
        let within = scale.clamp(Vec3::splat(least), Vec3::splat(most));
        count += usize::from(within != *scale);
        *scale = within;
    }
    if count > 0 {
        tracing::warn!(
            "{count} Gaussians have scales beyond exp({least}) to exp({most}), which are clamped"
        );
    }
    gaussians
}

fn planes(gaussians: &Gaussians, are_linear: bool) -> Vec<GlbAttribute> {
    let plane = |name: &str, kind, values| GlbAttribute {
        name: format!("{EXTENSION}:{name}"),
        kind,
        values,
    };
    let floats = |vectors: &[Vec3]| bytemuck::cast_slice::<_, f32>(vectors).to_vec();
    let opacity: Vec<f32> = gaussians.raw_opacities().iter().map(|&raw| sigmoid(raw)).collect();
    let rotation =
        gaussians.quats().iter().map(|&quat| unit(quat)).flat_map(|[w, x, y, z]| [x, y, z, w]);
    // Point colours for readers without the extension, in the linear light of glTF.
    let light = |value: f32| if are_linear { value } else { linear_from_srgb(value) };
    let seen = |dc: f32| light((0.5 + SH_C0 * dc).clamp(0.0, 1.0));
    let colors = gaussians.dc().iter().zip(&opacity);
    let colors = colors.flat_map(|(dc, &opacity)| [seen(dc.x), seen(dc.y), seen(dc.z), opacity]);

    let mut planes = vec![
        GlbAttribute { name: "POSITION".into(), kind: "VEC3", values: floats(gaussians.means()) },
        GlbAttribute { name: "COLOR_0".into(), kind: "VEC4", values: colors.collect() },
        plane("ROTATION", "VEC4", rotation.collect()),
        plane("SCALE", "VEC3", floats(gaussians.log_scales()).into_iter().map(f32::exp).collect()),
        plane("OPACITY", "SCALAR", opacity),
        plane("SH_DEGREE_0_COEF_0", "VEC3", floats(gaussians.dc())),
    ];
    let coefficients = rest_coefficients(gaussians.shape.sh_degree);
    for degree in 1..=gaussians.shape.sh_degree {
        let first = rest_coefficients(degree - 1);
        for coefficient in first..rest_coefficients(degree) {
            let values = gaussians
                .rest()
                .chunks_exact(coefficients)
                .flat_map(|rest| rest[coefficient].to_array());
            let name = format!("SH_DEGREE_{degree}_COEF_{}", coefficient - first);
            planes.push(plane(&name, "VEC3", values.collect()));
        }
    }
    planes
}

fn description(gaussians: &Gaussians, planes: &[GlbAttribute], provenance: &Provenance) -> Value {
    let mut offset = 0;
    let (mut views, mut accessors, mut attributes) = (vec![], vec![], Map::new());
    for (index, GlbAttribute { name, kind, values }) in planes.iter().enumerate() {
        let bytes = 4 * values.len();
        views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes }));
        accessors.push(json!({
            "bufferView": index, "componentType": FLOAT, "count": gaussians.count, "type": kind,
        }));
        attributes.insert(name.clone(), index.into());
        offset += bytes;
    }
    // glTF requires the bounds of positions.
    let bound = |start: f32, pick: fn(f32, f32) -> f32| {
        let all = gaussians.means().iter().map(|mean| mean.to_array());
        let bound = all.fold([start; 3], |a, b| [0, 1, 2].map(|axis| pick(a[axis], b[axis])));
        bound.map(|value| if value.is_finite() { value } else { 0.0 })
    };
    accessors[0]["min"] = json!(bound(f32::INFINITY, f32::min));
    accessors[0]["max"] = json!(bound(f32::NEG_INFINITY, f32::max));
    let mut lines = provenance.lines();
    lines.extend(provenance.world_line(gaussians, true));
    let color_space = match provenance.facts.linear {
        Some(_) => "lin_rec709_display",
        None => "srgb_rec709_display",
    };
    let facts = provenance.facts_of(gaussians).json();
    json!({
        "asset": {
            "version": "2.0", "generator": GENERATOR,
            "extras": { "provenance": lines, "nightsplat": facts },
        },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "buffers": [{ "byteLength": offset }],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{ "primitives": [{
            "attributes": attributes,
            "mode": 0,
            "extensions": { EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": color_space,
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
            } },
        }] }],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::tests::drawn;

    #[test]
    fn scales_are_finite() {
        let mut model = drawn(2, 0);
        model.log_scales_mut()[1] = Vec3::new(1e30, -1e30, 0.5);
        let scales = &planes(&clamped(model), false)[3].values;
        assert_eq!(
            scales[3..],
            [LOG_SCALE_MAX, LOG_SCALE_MIN, 0.5].map(|scale| (scale as f32).exp())
        );
    }

    #[test]
    fn every_attribute_is_at_the_stated_place() {
        for degree in 0..=3 {
            let model = drawn(9, degree);
            let provenance = Provenance { dataset: "chair".into(), ..Provenance::default() };
            let file = encode(&model, &provenance).unwrap();
            let word =
                |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
            assert_eq!((&file[..4], word(4), word(8)), (&b"glTF"[..], 2, file.len()));
            let text = word(12);
            let json: Value = serde_json::from_slice(&file[20..20 + text]).unwrap();
            let body = &file[28 + text..];
            assert_eq!(
                [word(20 + text), json["buffers"][0]["byteLength"].as_u64().unwrap() as usize],
                [body.len(); 2]
            );
            let attributes = json["meshes"][0]["primitives"][0]["attributes"].as_object().unwrap();
            assert_eq!(attributes.len(), 6 + rest_coefficients(degree));
            let values = |name: &str| {
                let accessor = &json["accessors"][attributes[name].as_u64().unwrap() as usize];
                assert_eq!(accessor["count"], 9);
                let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
                let [begin, length] =
                    ["byteOffset", "byteLength"].map(|key| view[key].as_u64().unwrap() as usize);
                bytemuck::pod_collect_to_vec::<u8, f32>(&body[begin..begin + length])
            };
            let turned = half_turn(&model);
            assert_eq!(values("POSITION")[3..6], turned.means()[1].to_array());
            let scale = turned.log_scales()[8].x.exp();
            assert_eq!(values("KHR_gaussian_splatting:SCALE")[24], scale);
            if degree > 1 {
                let coefficient = 9 * rest_coefficients(degree) - rest_coefficients(degree) + 3;
                let expected = turned.rest()[coefficient].to_array();
                assert_eq!(values("KHR_gaussian_splatting:SH_DEGREE_2_COEF_0")[24..], expected);
            }
        }
    }
}
