//! Gaussians as a PLY file in the INRIA layout, which splat viewers open.
//!
//! Binary little-endian, as written, or text, with one vertex per Gaussian: `x y z nx ny nz f_dc_0..2 f_rest_* opacity
//! scale_0..2 rot_0..3`.
//! Positions far from the world's origin are relative to another origin, given in a comment: `world = position + X Y
//! Z`. Other comments state the settings of a renderer, such as `nightsplat near 0.1`: [`ModelFacts`]. Features, if
//! any, are between `f_rest_*` and `opacity`: `f_depth_0 f_prior_0 f_noise_0..2 f_illu_0..2`, which viewers skip.
//! Normals are zero; `f_rest_*` is channel-major (all of red, then green, then blue); opacity is before the sigmoid,
//! scales are logarithms, `rot_0` is w. Source: `save_ply` of the 3DGS code.

pub mod parts;
mod text;

use std::borrow::Cow;
use std::fs;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use nightsplat_core::input;
use nightsplat_core::output::write_whole_with;
use nightsplat_core::ply::{PlyEncoding, PlyHeader, PlyScalar};
use nightsplat_core::{Error, Result};

use super::{FEATURES, Feature, Features, Gaussians, MAX_SH_DEGREE, ModelFacts, Shape, width};
use crate::attributes::{
    ATTRIBUTES, Attribute, AttributePlane, AttributeSpec, Ply, planes, rest_coefficients,
};

/// The prefix of the comment with the origin of the positions.
const ORIGIN: &str = "world = position + ";
/// The first of the properties, which the normals follow.
const MEANS: usize = 3;
const NORMALS: [&str; 3] = ["nx", "ny", "nz"];

/// A property of the file: its name, and its attribute and component.
#[derive(Debug)]
struct GaussianProperty {
    name: String,
    attribute: Attribute,
    component: usize,
}

impl GaussianProperty {
    /// The property's value is at `begin + stride * gaussian` in [`Gaussians::parameters`].
    fn address(&self, gaussians: &Gaussians) -> (usize, usize) {
        let AttributePlane { column, width, .. } = gaussians.columns(self.attribute);
        (column * gaussians.count + self.component, width)
    }
}

/// All properties except the normals, which follow the means, in file order.
fn properties(shape: Shape) -> Vec<GaussianProperty> {
    let mut specs: Vec<&AttributeSpec> = ATTRIBUTES.iter().collect();
    specs.sort_by_key(|spec| spec.ply_place);
    let planes = planes(shape.features.width(), width(shape));
    let of_attribute = |spec: &'static AttributeSpec| {
        (0..planes[spec.attribute as usize].width).map(move |position| {
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
            GaussianProperty { name, attribute: spec.attribute, component }
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
pub fn save(gaussians: &Gaussians, path: impl AsRef<Path>) -> Result<()> {
    save_with_comments(gaussians, path, &[""; 0])
}

/// [`save`] with comments in the header.
pub fn save_with_comments(
    gaussians: &Gaussians,
    path: impl AsRef<Path>,
    comments: &[impl AsRef<str>],
) -> Result<()> {
    write_whole_with(path.as_ref(), |partial| write(gaussians, partial, comments))
}

fn write(gaussians: &Gaussians, path: &Path, comments: &[impl AsRef<str>]) -> std::io::Result<()> {
    let lines = comment_lines(gaussians.origin, comments);
    let Gaussians { shape, count, .. } = *gaussians;
    let mut writer = Writer::new(fs::File::create(path)?, &lines, shape, count)?;
    writer.add(gaussians)?;
    writer.finish()
}

/// The comments of a file, with the origin of its positions.
fn comment_lines(origin: glam::DVec3, comments: &[impl AsRef<str>]) -> Vec<String> {
    let [x, y, z] = origin.to_array();
    let origin = (origin != glam::DVec3::ZERO).then(|| format!("{ORIGIN}{x} {y} {z}"));
    let comments = comments.iter().map(|comment| comment.as_ref().to_owned());
    origin.into_iter().chain(comments).collect()
}

/// A file to which Gaussians are added.
struct Writer {
    file: BufWriter<fs::File>,
    properties: Vec<GaussianProperty>,
}

impl Writer {
    /// Writes the header of a file of `count` Gaussians.
    fn new(
        file: fs::File,
        comments: &[String],
        shape: Shape,
        count: usize,
    ) -> std::io::Result<Self> {
        let mut file = BufWriter::new(file);
        writeln!(file, "ply\nformat binary_little_endian 1.0")?;
        for comment in comments {
            writeln!(file, "comment {comment}")?;
        }
        writeln!(file, "element vertex {count}")?;
        let properties = properties(shape);
        let (means, others) = properties.split_at(MEANS);
        let all = means.iter().map(|property| property.name.as_str()).chain(NORMALS);
        for name in all.chain(others.iter().map(|property| property.name.as_str())) {
            writeln!(file, "property float {name}")?;
        }
        writeln!(file, "end_header")?;
        Ok(Self { file, properties })
    }

    fn add(&mut self, gaussians: &Gaussians) -> std::io::Result<()> {
        let Self { file, properties } = self;
        let addresses: Vec<_> =
            properties.iter().map(|property| property.address(gaussians)).collect();
        let (means, others) = addresses.split_at(MEANS);
        let value = |(begin, stride): (usize, usize), gaussian: usize| {
            gaussians.parameters[begin + stride * gaussian]
        };
        let mut row = Vec::with_capacity(addresses.len() + NORMALS.len());
        for gaussian in 0..gaussians.count {
            row.clear();
            row.extend(means.iter().map(|&address| value(address, gaussian)));
            row.extend([0.0; NORMALS.len()]);
            row.extend(others.iter().map(|&address| value(address, gaussian)));
            for number in &row {
                file.write_all(&number.to_le_bytes())?;
            }
        }
        Ok(())
    }

    fn finish(self) -> std::io::Result<()> {
        let file = self.file.into_inner().map_err(std::io::IntoInnerError::into_error)?;
        // A pipe cannot be synchronised.
        if file.metadata()?.is_file() { file.sync_all() } else { Ok(()) }
    }
}

/// Reads Gaussians from a PLY, binary little-endian or text; unknown properties are skipped.
pub fn load(path: impl AsRef<Path>) -> Result<Gaussians> {
    let path = path.as_ref();
    if let Some(file) = parts::PartFile::open(path, 1)? {
        let gaussians = file.whole()?;
        check_finite(&gaussians).map_err(|problem| unusable(path, &problem))?;
        return Ok(gaussians);
    }
    let bytes = input::bytes(path)?;
    let (gaussians, _) = parse(&bytes).map_err(|problem| unusable(path, &problem))?;
    Ok(gaussians)
}

/// The error for a file of a model, with what mends most of them.
pub fn unusable(path: &Path, problem: &str) -> Error {
    let remedy = if problem.contains(';') { "" } else { "; export the model again" };
    Error::input(path, format!("{problem}{remedy}"))
}

/// The Gaussians of a file, all finite, and the facts that it states.
pub fn parse(bytes: &[u8]) -> Result<(Gaussians, ModelFacts), String> {
    let (gaussians, facts) = parse_any(bytes)?;
    check_finite(&gaussians)?;
    Ok((gaussians, facts))
}

/// Names the first number that is not finite.
fn check_finite(gaussians: &Gaussians) -> Result<(), String> {
    for property in properties(gaussians.shape) {
        let (begin, stride) = property.address(gaussians);
        let values = gaussians.parameters.iter().skip(begin).step_by(stride);
        let mut values = values.take(gaussians.count);
        if let Some(vertex) = values.position(|value| !value.is_finite()) {
            let (name, value) = (property.name, gaussians.parameters[begin + stride * vertex]);
            return Err(format!("vertex {vertex}: `{name}` is {value}, not a finite number"));
        }
    }
    Ok(())
}

/// As [`parse`]; numbers may be infinite or NaN.
pub fn parse_any(bytes: &[u8]) -> Result<(Gaussians, ModelFacts), String> {
    let mut header = PlyHeader::parse(bytes)?;
    let mut body = Cow::Borrowed(&bytes[header.length..]);
    if header.encoding == PlyEncoding::Text {
        body = text::vertices(&header, &body)?.into();
        (header.encoding, header.has_more) = (PlyEncoding::Little, false);
    }
    let layout = PlyLayout::new(&header, body.len() as u64)?;
    Ok((layout.gaussians(&body[..layout.count * layout.stride]), layout.facts))
}

/// Where the numbers of Gaussians are in the vertices of a file.
#[derive(Debug)]
struct PlyLayout {
    count: usize,
    shape: Shape,
    facts: ModelFacts,
    /// Bytes before the first vertex.
    length: usize,
    /// Bytes of a vertex.
    stride: usize,
    /// With the place of each in a vertex.
    properties: Vec<(usize, GaussianProperty)>,
}

impl PlyLayout {
    /// Of a file with `length` bytes after its header.
    fn new(header: &PlyHeader, length: u64) -> Result<Self, String> {
        let &PlyHeader { count, stride, .. } = header;
        if header.encoding != PlyEncoding::Little {
            let format = header.encoding.name();
            return Err(format!("is a PLY of format {format}; save it as binary_little_endian"));
        }
        let expected = count.checked_mul(stride).ok_or("the vertex count is absurd")?;
        if length < expected as u64 {
            return Err(format!(
                "is truncated: {count} vertices of {stride} bytes need {expected} bytes, the file has {length}"
            ));
        }
        if length > expected as u64 && !header.has_more {
            let more = length - expected as u64;
            return Err(format!("has {more} bytes more than its {count} vertices need"));
        }
        let (facts, shape) = (facts(header)?, shape(header)?);
        let offset_of =
            |property: GaussianProperty| Ok((offset(header, &property.name)?, property));
        let properties = properties(shape).into_iter().map(offset_of);
        let properties = properties.collect::<Result<_, String>>()?;
        Ok(Self { count, shape, facts, length: header.length, stride, properties })
    }

    /// The Gaussians of some vertices.
    fn gaussians(&self, vertices: &[u8]) -> Gaussians {
        // Every vertex has bytes, since `of` requires properties.
        let mut gaussians = Gaussians::zeros(vertices.len() / self.stride, self.shape);
        gaussians.origin = self.facts.origin;
        for (offset, property) in &self.properties {
            let (begin, stride) = property.address(&gaussians);
            for (gaussian, vertex) in vertices.chunks_exact(self.stride).enumerate() {
                let [a, b, c, d] = [0, 1, 2, 3].map(|byte| vertex[offset + byte]);
                gaussians.parameters[begin + stride * gaussian] = f32::from_le_bytes([a, b, c, d]);
            }
        }
        gaussians
    }
}

/// What the comments state.
fn facts(header: &PlyHeader) -> Result<ModelFacts, String> {
    let mut facts = ModelFacts::default();
    for (line, comment) in &header.comments {
        let stated = match comment.strip_prefix(ORIGIN) {
            Some(numbers) => facts.set("origin", numbers),
            None => facts.set_line(comment),
        };
        stated.map_err(|problem| format!("line {line} {problem}"))?;
    }
    Ok(facts)
}

fn shape(header: &PlyHeader) -> Result<Shape, String> {
    Ok(Shape { sh_degree: sh_degree(header)?, features: features(header) })
}

/// The features whose first property is present.
fn features(header: &PlyHeader) -> Features {
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
fn sh_degree(header: &PlyHeader) -> Result<u32, String> {
    let found =
        header.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    let degree = (0..=MAX_SH_DEGREE).find(|&degree| 3 * rest_coefficients(degree) == found);
    degree.ok_or_else(|| {
        format!("has {found} f_rest_* properties; 0, 9, 24 or 45 make an SH degree of 0 to 3")
    })
}

/// The byte offset of a float property in the vertex.
fn offset(header: &PlyHeader, name: &str) -> Result<usize, String> {
    match header.property(name) {
        Some((_, property)) if property.kind == PlyScalar::Float(4) => Ok(property.at),
        Some((_, property)) => {
            Err(format!("property `{name}` is of type {}, not float", property.type_name))
        }
        None => Err(format!("has no property `{name}`; is it a point cloud without Gaussians?")),
    }
}
