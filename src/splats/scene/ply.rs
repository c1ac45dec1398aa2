//! Gaussians as a PLY file in the INRIA layout, which splat viewers open.
//!
//! Binary little-endian, one vertex per Gaussian: `x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3`.
//! Positions far from the world's origin are relative to another origin, given in a comment: `world = position + X Y
//! Z`. Other comments state the settings of a renderer, such as `nightsplat near 0.1`: [`Facts`]. Features, if any, are
//! between `f_rest_*` and `opacity`: `f_depth_0 f_prior_0 f_noise_0..2 f_illu_0..2`, which viewers skip. Normals are
//! zero; `f_rest_*` is channel-major (all of red, then green, then blue); opacity is before the sigmoid, scales are
//! logarithms, `rot_0` is w. Source: `save_ply` of the 3DGS code.

use std::fs;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use super::{FEATURES, Facts, Feature, Features, Gaussians, MAX_SH_DEGREE, Shape, width};
use crate::base::input;
use crate::base::output::write_whole_with;
use crate::base::ply::{Encoding, Header, Kind};
use crate::splats::attributes::{
    ATTRIBUTES, Attribute, AttributeSpec, Ply, planes, rest_coefficients,
};
use crate::{Error, Result};

/// The prefix of the comment with the origin of the positions.
const ORIGIN: &str = "world = position + ";

/// A property of the file: its name, and its attribute and component.
struct Property {
    name: String,
    attribute: Attribute,
    component: usize,
}

impl Property {
    /// The property's value is at `begin + stride * gaussian` in [`Gaussians::parameters`].
    fn address(&self, gaussians: &Gaussians) -> (usize, usize) {
        let (column, width) = gaussians.columns(self.attribute);
        (column * gaussians.count + self.component, width)
    }
}

/// All properties except the normals, which follow the means, in file order.
fn properties(shape: Shape) -> Vec<Property> {
    let mut specs: Vec<&AttributeSpec> = ATTRIBUTES.iter().collect();
    specs.sort_by_key(|spec| spec.ply_place);
    let planes = planes(shape.features.width(), width(shape));
    let of_attribute = |spec: &'static AttributeSpec| {
        (0..planes[spec.attribute as usize].1).map(move |position| {
            // The file is channel-major, the scene coefficient-major.
            let component = match spec.attribute {
                Attribute::Rest => {
                    let coefficients = rest_coefficients(shape.sh_degree);
                    3 * (position % coefficients) + position / coefficients
                }
                _ => position,
            };
            let name = match spec.ply {
                Ply::Named(names) => names[position].to_owned(),
                Ply::Numbered(prefix) => format!("{prefix}{position}"),
                Ply::Features => shape.features.ply_property(position),
            };
            Property { name, attribute: spec.attribute, component }
        })
    };
    specs.into_iter().flat_map(of_attribute).collect()
}

impl Gaussians {
    /// Reads a model: a PLY in the INRIA layout, of any trainer, recognised by its content, not by its name.
    ///
    /// # Errors
    /// [`Error::Input`] if the file is missing, of another format, truncated or longer than its header states, or if a
    /// required property is missing or not finite.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        load(path)
    }
}

/// Writes `gaussians` to `path` atomically.
///
/// # Errors
/// [`Error::Output`] if the file cannot be written.
#[cfg(any(test, feature = "testing"))]
pub fn save(gaussians: &Gaussians, path: impl AsRef<Path>) -> Result<()> {
    save_with_comments(gaussians, path, &[""; 0])
}

/// [`save`] with comments in the header.
///
/// # Errors
/// Those of [`save`].
pub fn save_with_comments(
    gaussians: &Gaussians,
    path: impl AsRef<Path>,
    comments: &[impl AsRef<str>],
) -> Result<()> {
    write_whole_with(path.as_ref(), |partial| write(gaussians, partial, comments))
}

fn write(gaussians: &Gaussians, path: &Path, comments: &[impl AsRef<str>]) -> std::io::Result<()> {
    const NORMALS: [&str; 3] = ["nx", "ny", "nz"];
    let properties = properties(gaussians.shape);
    let (means, others) = properties.split_at(3);
    let mut file = BufWriter::new(fs::File::create(path)?);
    writeln!(file, "ply\nformat binary_little_endian 1.0")?;
    if gaussians.origin != glam::DVec3::ZERO {
        let [x, y, z] = gaussians.origin.to_array();
        writeln!(file, "comment {ORIGIN}{x} {y} {z}")?;
    }
    for comment in comments {
        writeln!(file, "comment {}", comment.as_ref())?;
    }
    writeln!(file, "element vertex {}", gaussians.count)?;
    let names = means.iter().map(|property| property.name.as_str());
    let names = names.chain(NORMALS).chain(others.iter().map(|property| property.name.as_str()));
    for name in names {
        writeln!(file, "property float {name}")?;
    }
    writeln!(file, "end_header")?;

    let value = |(begin, stride): (usize, usize), gaussian: usize| {
        gaussians.parameters[begin + stride * gaussian]
    };
    let means: Vec<_> = means.iter().map(|property| property.address(gaussians)).collect();
    let others: Vec<_> = others.iter().map(|property| property.address(gaussians)).collect();
    let mut row = Vec::with_capacity(properties.len() + NORMALS.len());
    for gaussian in 0..gaussians.count {
        row.clear();
        row.extend(means.iter().map(|&address| value(address, gaussian)));
        row.extend([0.0; NORMALS.len()]);
        row.extend(others.iter().map(|&address| value(address, gaussian)));
        for number in &row {
            file.write_all(&number.to_le_bytes())?;
        }
    }
    let file = file.into_inner().map_err(std::io::IntoInnerError::into_error)?;
    // A pipe cannot be synchronised.
    if file.metadata()?.is_file() { file.sync_all() } else { Ok(()) }
}

/// Reads Gaussians from a binary little-endian PLY; unknown properties are skipped.
///
/// # Errors
/// [`Error::Input`] if the file is missing, of another format, truncated or longer than its header states, or if a
/// required property is missing or not finite.
pub fn load(path: impl AsRef<Path>) -> Result<Gaussians> {
    let path = path.as_ref();
    let bytes = input::bytes(path)?;
    let (gaussians, _) = parse(&bytes).map_err(|problem| Error::input(path, problem))?;
    Ok(gaussians)
}

/// The Gaussians of a file, and the facts that it states.
///
/// # Errors
/// The problem, as in [`load`].
pub(crate) fn parse(bytes: &[u8]) -> Result<(Gaussians, Facts), String> {
    let header = Header::parse(bytes)?;
    if header.encoding != Encoding::Little {
        let format = header.encoding.name();
        return Err(format!("is a PLY of format {format}; save it as binary_little_endian"));
    }
    let body = &bytes[header.length..];
    let expected = header.count.checked_mul(header.stride).ok_or("the vertex count is absurd")?;
    if body.len() < expected {
        return Err(format!(
            "is truncated: {} vertices of {} bytes need {expected} bytes, the file has {}",
            header.count,
            header.stride,
            body.len()
        ));
    }
    if body.len() > expected && !header.has_more {
        return Err(format!(
            "has {} bytes more than its {} vertices need",
            body.len() - expected,
            header.count
        ));
    }

    let facts = facts(&header)?;
    // Before allocation: vertices without properties take no bytes of the file, however many there are.
    let shape = shape(&header)?;
    let offset_of = |property: Property| Ok((offset(&header, &property.name)?, property));
    let properties =
        properties(shape).into_iter().map(offset_of).collect::<Result<Vec<_>, String>>()?;
    let mut gaussians = Gaussians::zeros(header.count, shape);
    gaussians.origin = facts.origin;
    for (offset, property) in properties {
        let (begin, stride) = property.address(&gaussians);
        for (gaussian, vertex) in body[..expected].chunks_exact(header.stride).enumerate() {
            let [a, b, c, d] = [0, 1, 2, 3].map(|byte| vertex[offset + byte]);
            let value = f32::from_le_bytes([a, b, c, d]);
            if !value.is_finite() {
                return Err(format!(
                    "vertex {gaussian}: `{}` is {value}, not a finite number",
                    property.name
                ));
            }
            gaussians.parameters[begin + stride * gaussian] = value;
        }
    }
    Ok((gaussians, facts))
}

/// What the comments state.
fn facts(header: &Header) -> Result<Facts, String> {
    let mut facts = Facts::default();
    for (line, comment) in &header.comments {
        let stated = match comment.strip_prefix(ORIGIN) {
            Some(numbers) => facts.set("origin", numbers),
            None => facts.set_line(comment),
        };
        stated.map_err(|problem| format!("line {line} {problem}"))?;
    }
    Ok(facts)
}

fn shape(header: &Header) -> Result<Shape, String> {
    Ok(Shape { sh_degree: sh_degree(header)?, features: features(header) })
}

/// The features whose first property is present.
fn features(header: &Header) -> Features {
    let has = |feature: Feature| {
        let name = FEATURES[feature as usize].ply_name;
        header.property(&format!("f_{name}_0")).is_some()
    };
    Features {
        depth: has(Feature::Depth),
        structure: has(Feature::Structure),
        noise: has(Feature::Noise),
        illumination: has(Feature::Illumination),
    }
}

/// The degree whose `f_rest_*` properties are all present.
fn sh_degree(header: &Header) -> Result<u32, String> {
    let found = header.properties.iter().filter(|own| own.name.starts_with("f_rest_")).count();
    let degree = (0..=MAX_SH_DEGREE).find(|&degree| 3 * rest_coefficients(degree) == found);
    degree.ok_or_else(|| {
        format!("has {found} f_rest_* properties; 0, 9, 24 or 45 make an SH degree of 0 to 3")
    })
}

/// The byte offset of a float property in the vertex.
fn offset(header: &Header, name: &str) -> Result<usize, String> {
    match header.property(name) {
        Some((_, own)) if own.kind == Kind::Float(4) => Ok(own.at),
        Some((_, own)) => Err(format!("property `{name}` is of type {}, not float", own.type_name)),
        None => Err(format!("has no property `{name}`; is it a point cloud without Gaussians?")),
    }
}
