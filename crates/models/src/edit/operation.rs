//! The operations of an edit, and their lists in JSON.

use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use nightsplat_core::{Error, Result, hash, input};
use serde::{Deserialize, Serialize};

use crate::gaussians::{Gaussians, MAX_SH_DEGREE, Shape};

/// A change of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Operation {
    /// Keeps the Gaussians whose means are in a region.
    Crop(Region),
    /// Removes Gaussians by index, in the order that the model has then.
    Delete(Vec<Span>),
    /// Removes Gaussians that the training views contradict or do not see.
    Floaters,
    /// Removes Gaussians of a lower opacity.
    OpacityMin(f64),
    /// Keeps this many, those that contribute most to the training views.
    MaxGaussians(usize),
    /// Drops SH coefficients above this degree, or adds zeros up to it.
    ShDegree(u32),
    /// Rotates the world so that this direction becomes -y; `None`: the up direction of the photographs.
    Up(Option<DVec3>),
    /// Scales the world about its origin.
    Scale(Scale),
    /// Moves the world.
    Move(DVec3),
    /// Rotates the world about an axis through its origin, counterclockwise as seen against the axis.
    Rotate {
        /// Of any length above 0.
        axis: DVec3,
        /// The angle.
        degrees: f64,
    },
    /// Adds the Gaussians of another model of the same world.
    Merge {
        /// The model file or run.
        file: PathBuf,
        /// Its [`fingerprint`], if a list states it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        hash: Option<String>,
    },
}

/// A region of the world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Region {
    /// Between two corners.
    Box(DVec3, DVec3),
    /// Around a centre, within a radius.
    Sphere(DVec3, f64),
    /// The sphere around what the training cameras look at, that contains them.
    Cameras,
}

/// One index, or the first and the last of a range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Span {
    /// An index.
    One(usize),
    /// The first and the last.
    Range(usize, usize),
}

/// A scale of the world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Scale {
    /// A factor above 0.
    Factor(f64),
    /// Two points of the world, and the distance between them that the scaled one has.
    Points {
        /// The first.
        from: DVec3,
        /// The second.
        to: DVec3,
        /// The distance.
        length: f64,
    },
    /// A table with the positions of cameras, in metres.
    Cameras(PathBuf),
}

impl Region {
    fn check(&self) -> Result<(), String> {
        match *self {
            Self::Box(a, b) if !(a.is_finite() && b.is_finite() && a.cmplt(b).all()) => {
                Err("a box has two corners, the lower numbers first".to_owned())
            }
            Self::Sphere(center, radius)
                if !(center.is_finite() && radius.is_finite() && radius > 0.0) =>
            {
                Err("a sphere has a centre and a radius above 0".to_owned())
            }
            _ => Ok(()),
        }
    }

    /// Whether a point is inside or on the border.
    pub fn contains(&self, point: DVec3) -> bool {
        match *self {
            Self::Box(low, high) => point.cmpge(low).all() && point.cmple(high).all(),
            Self::Sphere(center, radius) => point.distance(center) <= radius,
            Self::Cameras => false,
        }
    }
}

impl Span {
    /// The indices of what is false.
    pub fn of_false(keep: &[bool]) -> Vec<Self> {
        let (mut spans, mut first) = (vec![], 0);
        for part in keep.chunk_by(|a, b| a == b) {
            let last = first + part.len() - 1;
            match (part[0], first == last) {
                (true, _) => {}
                (false, true) => spans.push(Self::One(first)),
                (false, false) => spans.push(Self::Range(first, last)),
            }
            first = last + 1;
        }
        spans
    }
}

impl Scale {
    /// The factor of a number, or of two points.
    pub fn factor(&self) -> Result<Option<f64>, String> {
        let factor = match *self {
            Self::Factor(factor) => factor,
            Self::Points { from, to, length } => length / from.distance(to),
            Self::Cameras(_) => return Ok(None),
        };
        // Also of f32.
        let is_factor = factor.is_finite() && (1e-30..=1e30).contains(&factor);
        is_factor
            .then_some(Some(factor))
            .ok_or_else(|| format!("a scale of {factor} is none; it is a finite number above 0"))
    }
}

impl Operation {
    /// Refuses numbers that no model takes.
    pub fn check(&self) -> Result<(), String> {
        let unit = |direction: DVec3| {
            let has_length = direction.is_finite() && direction.try_normalize().is_some();
            has_length.then_some(()).ok_or_else(|| format!("{direction} is no direction"))
        };
        match self {
            Self::Crop(region) => region.check(),
            Self::OpacityMin(least) if !(0.0..1.0).contains(least) => {
                Err(format!("an opacity of {least} is none; it is 0 or more and below 1"))
            }
            Self::MaxGaussians(0) => Err("0 would leave nothing; it is at least 1".to_owned()),
            Self::ShDegree(degree) if *degree > MAX_SH_DEGREE => {
                Err(format!("an SH degree of {degree} is none; it is 0 to {MAX_SH_DEGREE}"))
            }
            Self::Up(Some(direction)) => unit(*direction),
            Self::Scale(scale) => scale.factor().map(drop),
            Self::Move(by) if !by.is_finite() => Err(format!("{by} is not finite")),
            Self::Rotate { axis, degrees } if degrees.is_finite() => unit(*axis),
            Self::Rotate { degrees, .. } => Err(format!("{degrees} degrees is no angle")),
            _ => Ok(()),
        }
    }

    /// The rotation of [`Operation::Rotate`] and of [`Operation::Up`] with a direction.
    pub fn rotation(&self) -> Option<DQuat> {
        match self {
            Self::Rotate { axis, degrees } => {
                Some(DQuat::from_axis_angle(axis.try_normalize()?, degrees.to_radians()))
            }
            Self::Up(Some(up)) => Some(DQuat::from_rotation_arc(up.try_normalize()?, DVec3::NEG_Y)),
            _ => None,
        }
    }

    /// Whether the model renders otherwise afterwards; a transform of the world does not change what its cameras see.
    pub fn changes_renders(&self) -> bool {
        !matches!(self, Self::Up(_) | Self::Scale(_) | Self::Move(_) | Self::Rotate { .. })
    }

    /// Whether it needs the photographs or their cameras.
    pub fn needs_dataset(&self) -> bool {
        matches!(
            self,
            Self::Floaters
                | Self::MaxGaussians(_)
                | Self::Crop(Region::Cameras)
                | Self::Scale(Scale::Cameras(_))
        )
    }
}

/// A list of operations on one model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditList {
    /// The version of the format.
    nightsplat_edits: u32,
    /// The [`fingerprint`] of the model that the list is for.
    pub model: String,
    /// In order.
    pub edits: Vec<Operation>,
}

/// The version of lists that this build reads and writes.
const VERSION: u32 = 1;

impl EditList {
    /// The operations on a model of this [`fingerprint`].
    pub fn new(model: String, edits: Vec<Operation>) -> Self {
        Self { nightsplat_edits: VERSION, model, edits }
    }

    /// Reads a list; the files that it merges are relative to its own folder.
    pub fn load(path: &Path) -> Result<Self> {
        let refused = |problem: String| Error::input(path, problem);
        let text = input::text(path)?;
        let json: serde_json::Value = serde_json::from_str(&text)
            .map_err(|error| refused(format!("is not JSON: {error}")))?;
        match &json["nightsplat_edits"] {
            version if *version == VERSION => {}
            serde_json::Value::Null => {
                let problem = "is no edit list: it has no `nightsplat_edits`";
                return Err(refused(problem.to_owned()));
            }
            version => {
                let problem = format!(
                    "is an edit list of version {version}; this build reads version {VERSION}"
                );
                return Err(refused(problem));
            }
        }
        let mut list: Self = serde_json::from_value(json)
            .map_err(|error| refused(format!("is no edit list: {error}")))?;
        for (number, operation) in (1..).zip(&mut list.edits) {
            operation.check().map_err(|what| refused(format!("edit {number}: {what}")))?;
            let file = match operation {
                Operation::Merge { file, .. } | Operation::Scale(Scale::Cameras(file)) => file,
                _ => continue,
            };
            *file = path.parent().unwrap_or(Path::new("")).join(&*file);
        }
        Ok(list)
    }

    /// The list as text, on one line per operation.
    pub fn text(&self) -> String {
        let line = |operation: &Operation| format!("    {}", json(operation));
        let lines: Vec<String> = self.edits.iter().map(line).collect();
        format!(
            "{{\n  \"nightsplat_edits\": {},\n  \"model\": \"{}\",\n  \"edits\": [\n{}\n  ]\n}}\n",
            self.nightsplat_edits,
            self.model,
            lines.join(",\n")
        )
    }

    /// The list on one line for a header, without the folders of files.
    pub fn line(&self) -> String {
        let mut list = self.clone();
        for operation in &mut list.edits {
            if let Operation::Merge { file, .. } = operation {
                *file = file.file_name().unwrap_or_default().into();
            }
        }
        json(&list)
    }
}

/// Numbers, names and paths always have a JSON form; a path that is not Unicode does not.
fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).unwrap_or_default()
}

/// The checksum of a model by which an edit list names it: of the shape and every number as the file has them,
/// whatever its header says. Gaussians are added in order, in any parts.
#[derive(Debug)]
pub struct ModelChecksum(hash::Hasher);

impl ModelChecksum {
    /// Before the first of `count` Gaussians.
    pub fn new(count: usize, shape: Shape, origin: DVec3) -> Self {
        let mut hasher = hash::Hasher::default();
        hasher.write(format!("{count} {shape}").as_bytes());
        hasher.write_numbers(&origin.to_array());
        Self(hasher)
    }

    /// Adds the next Gaussians.
    pub fn add(&mut self, part: &Gaussians) {
        let mut row = vec![];
        for index in 0..part.count {
            row.clear();
            part.row(index)
                .for_each(|numbers| row.extend_from_slice(bytemuck::cast_slice(numbers)));
            self.0.write(&row);
        }
    }

    /// As text.
    pub fn text(self) -> String {
        hash::text(self.0.finish())
    }
}

/// The [`ModelChecksum`] of a model.
pub fn fingerprint(gaussians: &Gaussians) -> String {
    let mut fingerprint = ModelChecksum::new(gaussians.count, gaussians.shape, gaussians.origin);
    fingerprint.add(gaussians);
    fingerprint.text()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn every() -> Vec<Operation> {
        vec![
            Operation::Crop(Region::Box(DVec3::NEG_ONE, DVec3::ONE)),
            Operation::Crop(Region::Sphere(DVec3::X, 2.5)),
            Operation::Crop(Region::Cameras),
            Operation::Delete(vec![Span::One(3), Span::Range(7, 9)]),
            Operation::Floaters,
            Operation::OpacityMin(0.05),
            Operation::MaxGaussians(1000),
            Operation::ShDegree(1),
            Operation::Up(Some(DVec3::Z)),
            Operation::Up(None),
            Operation::Scale(Scale::Factor(2.0)),
            Operation::Scale(Scale::Points { from: DVec3::ZERO, to: DVec3::X, length: 0.9 }),
            Operation::Move(DVec3::new(0.1, 0.2, 0.3)),
            Operation::Rotate { axis: DVec3::ONE, degrees: 37.0 },
            Operation::Merge { file: "/a/other.ply".into(), hash: Some("0123".to_owned()) },
        ]
    }

    #[test]
    fn a_list_is_read_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("edits.json");
        let list = EditList::new("00ff".to_owned(), every());
        std::fs::write(&path, list.text()).unwrap();
        assert_eq!(EditList::load(&path).unwrap(), list);
        assert!(!list.line().contains('\n') && !list.line().contains("/a/"), "{}", list.line());
        // Files of a list are relative to it.
        let text = list.text().replace("/a/other.ply", "other.ply");
        std::fs::write(&path, text).unwrap();
        let file = folder.path().join("other.ply");
        let read = EditList::load(&path).unwrap();
        assert!(
            matches!(read.edits.last(), Some(Operation::Merge { file: merged, .. }) if *merged == file)
        );
    }

    #[test]
    fn a_list_of_another_version_or_with_invalid_numbers_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("edits.json");
        let refused = |text: &str, part: &str| {
            std::fs::write(&path, text).unwrap();
            let message = EditList::load(&path).unwrap_err().to_string();
            assert!(message.contains("edits.json") && message.contains(part), "{message}");
        };
        refused("{", "is not JSON");
        refused("{}", "has no `nightsplat_edits`");
        refused(
            r#"{"nightsplat_edits": 2, "model": "", "edits": []}"#,
            "version 2; this build reads",
        );
        let with = |edit: &str| format!(r#"{{"nightsplat_edits":1,"model":"","edits":[{edit}]}}"#);
        refused(&with(r#"{"shear": 1}"#), "unknown variant `shear`");
        refused(&with(r#"{"scale": 0}"#), "edit 1: a scale of 0 is none");
        refused(&with(r#""floaters", {"scale": -1}"#), "edit 2: a scale of -1 is none");
        refused(&with(r#"{"move": [1e999, 0, 0]}"#), "number out of range");
        refused(&with(r#"{"rotate": {"axis": [0, 0, 0], "degrees": 1}}"#), "is no direction");
        refused(&with(r#"{"crop": {"box": [[0, 0, 0], [1, 0, 1]]}}"#), "the lower numbers first");
        refused(&with(r#"{"crop": {"sphere": [[0, 0, 0], 0]}}"#), "a radius above 0");
        refused(&with(r#"{"opacity_min": 1}"#), "an opacity of 1 is none");
        refused(&with(r#"{"max_gaussians": 0}"#), "would leave nothing");
        refused(&with(r#"{"sh_degree": 4}"#), "an SH degree of 4 is none");
    }

    #[test]
    fn the_fingerprint_of_a_model_depends_on_every_number() {
        let model = Gaussians::zeros(3, 1);
        let mut seen = std::collections::BTreeSet::from([fingerprint(&model)]);
        for index in [0, 10, model.parameters.len() - 1] {
            let mut other = model.clone();
            other.parameters[index] = 1.0;
            assert!(seen.insert(fingerprint(&other)), "{index}");
        }
        let moved = Gaussians { origin: DVec3::X, ..model.clone() };
        assert!(seen.insert(fingerprint(&moved)));
        assert!(seen.insert(fingerprint(&Gaussians::zeros(3, 0))));
        assert_eq!(fingerprint(&model), fingerprint(&model.clone()));
    }
}
