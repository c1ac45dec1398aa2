//! Exports of a model: SPZ, glTF, USD, SOG, streamed SOG, and a page with its own viewer.
//!
//! Each exports the Gaussians as they are in `model.ply`: in the colours that viewers expect and with `OpenCV`'s axes,
//! y down and z forward. The model is as bright as its targets; a dark one would show banding, as SPZ quantises colours
//! to steps of 1.9 / 255.

pub mod glb;
pub mod page;
mod palette;
pub mod sog;
pub mod spz;
pub mod streamed;
pub mod usd;

use std::io::Write as _;
use std::path::Path;
use std::str::FromStr;

use flate2::{Compression, GzBuilder};
use glam::{DMat3, DQuat, DVec3, Vec3};
use nightsplat_core::output::write_whole;
use nightsplat_core::{Error, Result};

use crate::gaussians::{Gaussians, ModelFacts, ply, rest_coefficients};

/// The formats of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// The layout that every viewer opens, with provenance in its header.
    Ply,
    /// A tenth of the size, mostly 8 bits per value.
    Spz(spz::Version),
    /// glTF with `KHR_gaussian_splatting`.
    Glb,
    /// `OpenUSD` with `ParticleField3DGaussianSplat`, as text.
    Usda,
    /// The same in a package.
    Usdz,
    /// A fifteenth of the size; `PlayCanvas`.
    Sog,
    /// A folder of SOG in chunks at several levels of detail, which viewers of `PlayCanvas` load as needed.
    StreamedSog,
    /// A page with a viewer and photographs. Only a run is exported as one.
    Html,
}

impl Format {
    /// Every format.
    #[doc(hidden)]
    pub const ALL: [Self; 8] = [
        Self::Ply,
        Self::Spz(spz::Version::V4),
        Self::Glb,
        Self::Usda,
        Self::Usdz,
        Self::Sog,
        Self::StreamedSog,
        Self::Html,
    ];

    /// The name on the command line, and the extension of its files.
    #[doc(hidden)]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Spz(_) => "spz",
            Self::Glb => "glb",
            Self::Usda => "usda",
            Self::Usdz => "usdz",
            Self::Sog => "sog",
            Self::StreamedSog => "streamed-sog",
            Self::Html => "html",
        }
    }

    /// The format that a file's extension names: `ply`, `spz`, `glb`, `usda`, `usdz` or `sog`.
    ///
    /// # Errors
    /// [`Error::Usage`] for any other extension.
    pub fn from_path(path: &Path) -> Result<Self> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let is_file = |format: &Self| !matches!(format, Self::StreamedSog | Self::Html);
        let mut files = Self::ALL.into_iter().filter(is_file);
        files.find(|format| format.name() == extension).ok_or_else(|| {
            let problem =
                "has no extension of a model file; name it .ply, .spz, .glb, .usda, .usdz or .sog";
            Error::Usage(format!("{} {problem}", path.display()))
        })
    }

    /// Writes Gaussians in the colours that viewers show; the file appears under its name only once it is complete.
    #[doc(hidden)]
    pub fn write(self, gaussians: &Gaussians, provenance: &Provenance, path: &Path) -> Result<()> {
        let bytes = match self {
            Self::Ply => {
                let comments = provenance.ply_comments(gaussians);
                return ply::save_with_comments(gaussians, path, &comments);
            }
            Self::StreamedSog => {
                let tile = streamed::TileLoader::whole(path, gaussians);
                let division = streamed::Division::default();
                return streamed::write(path, &[tile], provenance, division).map(drop);
            }
            Self::Html => {
                let problem = "a page needs photographs: `nightsplat export RUN --format html`";
                return Err(Error::Usage(problem.to_owned()));
            }
            Self::Spz(version) => spz::encode(gaussians, provenance, version)?,
            Self::Glb => glb::encode(gaussians, provenance)?,
            Self::Usda => usd::encode(gaussians, provenance)?,
            Self::Usdz => usd::pack(gaussians, provenance)?,
            Self::Sog => sog::encode(gaussians, provenance)?,
        };
        write_whole(path, &bytes)
    }
}

impl FromStr for Format {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|format| format.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::Usage(format!("unknown format `{name}`; the formats are {names}"))
        })
    }
}

impl Gaussians {
    /// Writes the Gaussians in the format that the file's extension names, as [`Format::from_path`] does.
    ///
    /// # Errors
    /// The extension names none, the model does not fit the format, or the file cannot be written; no partial file is
    /// left.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        self.save_as(path, Format::from_path(path)?)
    }

    /// Writes the model in a format, regardless of the file's extension.
    ///
    /// # Errors
    /// Those of [`Gaussians::save`].
    pub fn save_as(&self, path: impl AsRef<Path>, format: Format) -> Result<()> {
        format.write(self, &Provenance::default(), path.as_ref())
    }
}

/// Provenance of a model, stored in exported files.
#[derive(Clone, Debug, Default)]
pub struct Provenance {
    /// The name of the dataset's folder.
    pub dataset: String,
    /// The tone curve of its targets.
    pub curve: String,
    /// The exposure of the model, in words.
    pub exposure: String,
    /// The rotation that was applied by [`Gaussians::rotated`].
    pub rotation: DQuat,
    /// Settings that a renderer requires; the origin is that of the Gaussians.
    pub facts: ModelFacts,
    /// The edit lists that were applied, each on one line.
    pub edits: Vec<String>,
}

/// The key of an edit list in a file's header.
pub const EDITS: &str = "edits";

/// The program's name and version in files.
pub const GENERATOR: &str = concat!("nightsplat ", env!("CARGO_PKG_VERSION"));

impl Provenance {
    /// Lines for a header.
    pub fn lines(&self) -> Vec<String> {
        let Self { dataset, curve, exposure, edits, .. } = self;
        let lines = [
            ("generator", GENERATOR),
            ("dataset", dataset),
            ("curve", curve),
            ("exposure", exposure),
        ];
        let line = |(key, value): (&str, &str)| {
            format!("{key}: {}", value.replace(char::is_control, " ").trim())
        };
        let edits = edits.iter().map(|list| (EDITS, list.as_str()));
        lines.into_iter().chain(edits).filter(|(_, value)| !value.is_empty()).map(line).collect()
    }
}

impl Provenance {
    /// The comments of a PLY, with those that tell a reader how to render it.
    pub fn ply_comments(&self, gaussians: &Gaussians) -> Vec<String> {
        let mut lines = self.lines();
        // The origin is added by the reader in the rotated world.
        let turned = self.rotation != DQuat::IDENTITY;
        let line = self.world_line(gaussians, false).filter(|_| turned);
        lines.extend(line.map(|line| format!("dataset's {line}")));
        lines.extend(self.facts.comments());
        lines
    }

    /// The facts for a file of `gaussians`, with their origin.
    fn facts_of(&self, gaussians: &Gaussians) -> ModelFacts {
        ModelFacts { origin: gaussians.origin, ..self.facts.clone() }
    }

    /// A header line that maps the file's positions to the dataset's world, if they differ. `half_turned`: the file's
    /// axes are those of OpenGL.
    fn world_line(&self, gaussians: &Gaussians, half_turned: bool) -> Option<String> {
        let back = self.rotation.inverse();
        let position = if self.rotation != DQuat::IDENTITY {
            let sign = if half_turned { -1.0 } else { 1.0 };
            let half_turn = DVec3::new(1.0, sign, sign);
            let rows = (DMat3::from_quat(back) * DMat3::from_diagonal(half_turn)).transpose();
            let row = |row: DVec3| format!("[{}, {}, {}]", row.x, row.y, row.z);
            let [x, y, z] = [rows.x_axis, rows.y_axis, rows.z_axis].map(row);
            format!("[{x}, {y}, {z}] (x, y, z)")
        } else if half_turned {
            "(x, -y, -z)".to_owned()
        } else {
            "(x, y, z)".to_owned()
        };
        let [x, y, z] = (back * gaussians.origin).to_array();
        if gaussians.origin != DVec3::ZERO {
            Some(format!("world = {position} + ({x}, {y}, {z})"))
        } else {
            (self.rotation != DQuat::IDENTITY).then(|| format!("world = {position}"))
        }
    }
}

/// The sign of each spherical harmonic above degree 0 under the half turn about x, in the order of the coefficients.
const HALF_TURN: [f32; 15] =
    [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

/// The model rotated by half a turn about x: from `OpenCV`'s axes to OpenGL's, y up and z backward. Only signs change,
/// so every value stays exact.
pub fn half_turn(gaussians: &Gaussians) -> Gaussians {
    let mut turned = gaussians.clone();
    for mean in turned.means_mut() {
        *mean = Vec3::new(mean.x, -mean.y, -mean.z);
    }
    // T R T with T = diag(1, -1, -1).
    for [_, _, y, z] in turned.quats_mut() {
        (*y, *z) = (-*y, -*z);
    }
    let coefficients = rest_coefficients(turned.shape.sh_degree);
    if coefficients > 0 {
        for rest in turned.rest_mut().chunks_exact_mut(coefficients) {
            rest.iter_mut().zip(HALF_TURN).for_each(|(value, sign)| *value *= sign);
        }
    }
    turned
}

/// The rotation as a unit quaternion (w, x, y, z); the identity if its length is 0.
fn unit([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    let length = (w * w + x * x + y * y + z * z).sqrt();
    if length > 1e-12 { [w, x, y, z].map(|part| part / length) } else { [1.0, 0.0, 0.0, 0.0] }
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// The opacity before the sigmoid that a byte represents; finite for 0 and 255.
fn raw_opacity(byte: u8) -> f32 {
    // The middle of the interval that rounds to 0, or to 255.
    let opacity = f32::from(byte).clamp(0.25, 254.75) / 255.0;
    (opacity / (1.0 - opacity)).ln()
}

fn gzip(bytes: &[u8]) -> Result<Vec<u8>> {
    gzip_with(bytes, None)
}

/// Gzip with a comment in the header, which readers skip.
fn gzip_with(bytes: &[u8], comment: Option<String>) -> Result<Vec<u8>> {
    let builder = comment.into_iter().fold(GzBuilder::new(), GzBuilder::comment);
    let mut encoder = builder.write(vec![], Compression::best());
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    written.map_err(|error| Error::output("an export", format!("cannot be compressed: {error}")))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::gaussians::Shape;
    use crate::harmonics::sh_basis;
    use nightsplat_core::random::Stream;

    /// Random Gaussians of ordinary values.
    pub(crate) fn drawn(count: usize, sh_degree: u32) -> Gaussians {
        let mut gaussians = Gaussians::zeros(count, Shape::from(sh_degree));
        let stream = Stream::new(7, 11);
        for (index, value) in (0..).zip(&mut gaussians.parameters) {
            *value = (stream.uniform(index) * 2.0 - 1.0) as f32;
        }
        gaussians.means_mut().iter_mut().for_each(|mean| *mean *= 4.0);
        gaussians.log_scales_mut().iter_mut().for_each(|scale| *scale = *scale * 2.0 - 4.0);
        gaussians.raw_opacities_mut().iter_mut().for_each(|opacity| *opacity *= 4.0);
        gaussians.rest_mut().iter_mut().for_each(|value| *value *= 0.3);
        gaussians
    }

    #[test]
    fn a_model_is_saved_in_the_format_of_its_extension() {
        let (model, folder) = (drawn(4, 1), tempfile::tempdir().unwrap());
        for (name, magic) in [
            ("a.ply", "ply"),
            ("a.spz", "NGSP"),
            ("a.glb", "glTF"),
            ("a.usda", "#usda 1.0"),
            ("A.SOG", "PK"),
        ] {
            let path = folder.path().join(name);
            model.save(&path).unwrap();
            assert!(std::fs::read(&path).unwrap().starts_with(magic.as_bytes()), "{name}");
        }
        assert_eq!(Gaussians::open(folder.path().join("a.ply")).unwrap(), model);
        let refused = model.save(folder.path().join("a.splat")).unwrap_err().to_string();
        assert!(refused.contains("a.splat") && refused.contains(".spz"), "{refused}");
    }

    #[test]
    fn every_format_states_the_origin_of_its_positions() {
        let mut model = drawn(4, 1);
        model.origin = DVec3::new(4_499_999.6, 519_997.7, -10_001.8);
        let provenance = Provenance::default();
        let numbers = "(4499999.6, 519997.7, -10001.8)";
        let turned = format!("world = (x, -y, -z) + {numbers}");
        let has = |file: &[u8], text: &str| {
            file.windows(text.len()).any(|window| window == text.as_bytes())
        };
        for version in [spz::Version::V3, spz::Version::V4] {
            let file = spz::encode(&model, &provenance, version).unwrap();
            assert!(has(&file, &turned), "{version:?}");
        }
        assert!(has(&glb::encode(&model, &provenance).unwrap(), &turned));
        let sog = sog::encode(&model, &provenance).unwrap();
        let mut archive = zip::ZipArchive::new(std::io::Cursor::new(sog)).unwrap();
        let meta = std::io::read_to_string(archive.by_name("meta.json").unwrap()).unwrap();
        assert!(meta.contains(&format!("world = (x, y, z) + {numbers}")), "{meta}");
        // The line maps to the world before the rotation.
        let rotation = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
        let provenance = Provenance { rotation, ..Provenance::default() };
        let rotated = model.rotated(rotation);
        let line = provenance.world_line(&rotated, true).unwrap();
        assert!(has(&glb::encode(&rotated, &provenance).unwrap(), &line));
        let numbers = line.split(|c: char| !"+-.e0123456789".contains(c));
        let numbers: Vec<f64> = numbers.filter_map(|number| number.parse().ok()).collect();
        let rows = [0, 3, 6].map(|at| DVec3::from_slice(&numbers[at..]));
        let origin = DVec3::from_slice(&numbers[9..]);
        for (mean, in_file) in model.means().iter().zip(half_turn(&rotated).means()) {
            let back = rows.map(|row| row.dot(in_file.as_dvec3()));
            let error = DVec3::from_array(back) + origin - (mean.as_dvec3() + model.origin);
            assert!(error.length() < 1e-5, "{line}: {error}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("turned.ply");
        Format::Ply.write(&rotated, &provenance, &path).unwrap();
        assert_eq!(Gaussians::open(&path).unwrap(), rotated);
        assert!(has(&std::fs::read(&path).unwrap(), "comment dataset's world = [["));
        model.origin = DVec3::ZERO;
        assert!(!has(&glb::encode(&model, &Provenance::default()).unwrap(), "world ="));
    }

    /// Asserts that `turned` is `model` after the rotation.
    fn assert_turned(turned: &Gaussians, model: &Gaussians, turn: DMat3) {
        let rotation = |[w, x, y, z]: [f32; 4]| {
            let quat = DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
            DMat3::from_quat(quat.normalize())
        };
        let axes = |model: &Gaussians, i: usize| {
            let scale = DMat3::from_diagonal((model.log_scales()[i].as_dvec3() * 2.0).exp());
            let rotation = rotation(model.quats()[i]);
            rotation * scale * rotation.transpose()
        };
        let coefficients = rest_coefficients(model.shape.sh_degree);
        for i in 0..model.count {
            let error = turned.means()[i].as_dvec3() - turn * model.means()[i].as_dvec3();
            assert!(error.length() < 1e-6, "{i}: {error}");
            let difference = axes(turned, i) - turn * axes(model, i) * turn.transpose();
            assert!(difference.abs().to_cols_array().iter().all(|&error| error < 1e-6), "{i}");
            let direction = DVec3::new(0.3, -0.5 + i as f64 / 10.0, 0.7).normalize();
            let color = |model: &Gaussians, direction: DVec3| {
                let values = sh_basis(model.shape.sh_degree, direction);
                let rest = &model.rest()[coefficients * i..][..coefficients];
                rest.iter().zip(&values[1..]).map(|(c, b)| c.as_dvec3() * *b).sum::<DVec3>()
            };
            let difference = color(turned, turn * direction) - color(model, direction);
            assert!(difference.length() < 1e-6, "{i}: {difference}");
        }
    }

    #[test]
    fn a_turned_model_looks_the_same_from_a_turned_camera() {
        let model = drawn(20, 3);
        let turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        assert_turned(&half_turn(&model), &model, turn);
        for degree in 0..=3 {
            let model = drawn(20, degree);
            for (a, b, c) in [(0.0, 0.0, 0.0), (1.0, 2.0, -0.5), (-2.5, 0.3, 1.7), (3.1, 0.0, 0.0)]
            {
                let rotation = DQuat::from_euler(glam::EulerRot::XYZ, a, b, c);
                assert_turned(&model.rotated(rotation), &model, DMat3::from_quat(rotation));
            }
        }
    }
}
