//! COLMAP models: cameras, images and points, from the binary or the text encoding.
//!
//! Formats: <https://colmap.github.io/format.html>. Poses are world to view, `OpenCV` axes, quaternions w first.

mod binary;
mod text;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DQuat, DVec2, DVec3};
use nightsplat_core::camera::{Distortion, Lens};
use nightsplat_core::{Error, Result};

use crate::tree;
pub(super) use binary::images_renamed;

/// A registered photograph.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ModelImage {
    pub(super) id: u32,
    pub(super) camera: u32,
    /// Path relative to the image folder.
    pub(super) name: String,
    /// `None` if the model's numbers are not a pose (NaN, or a rotation of length zero).
    pub(super) view_from_world: Option<DAffine3>,
}

/// A triangulated point. Its colour is not read: it may come from normal-light photographs.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ModelPoint {
    pub(super) position: DVec3,
    /// Ids of the images that see it.
    pub(super) images: Vec<u32>,
}

/// The models in the subfolders of a folder, or the folder itself if there are none.
pub(super) fn models_in(folder: &Path, needed: &[&str]) -> Vec<PathBuf> {
    let folders = tree::entries(folder).unwrap_or_default();
    let mut models: Vec<PathBuf> =
        folders.iter().filter_map(|folder| model_in(folder, needed)).collect();
    models.sort();
    if models.is_empty() {
        models.extend(model_in(folder, needed));
    }
    models
}

/// A folder that is itself a model.
pub(super) fn model_in(folder: &Path, needed: &[&str]) -> Option<PathBuf> {
    needed.iter().all(|stem| file(folder, stem).is_some()).then(|| folder.to_owned())
}

/// The model with the most registered photographs that exist, and the count of each if there are several; `None` if
/// there is none.
pub(super) fn largest(
    models: &[PathBuf],
    exists: impl Fn(&str) -> bool,
) -> Result<Option<(&Path, Vec<usize>)>> {
    if let [only] = models {
        return Ok(Some((only, vec![])));
    }
    let count = |folder: &PathBuf| {
        let images = read_images(folder)?;
        Ok(images.iter().filter(|image| exists(&image.name)).count())
    };
    let counts = models.iter().map(count).collect::<Result<Vec<_>>>()?;
    // The first of the largest.
    let largest = (0..counts.len()).rev().max_by_key(|&index| counts[index]);
    Ok(largest.map(|index| (models[index].as_path(), counts)))
}

/// The lenses by camera id.
pub(super) fn read_cameras(folder: &Path) -> Result<BTreeMap<u32, Lens>> {
    match required(folder, "cameras")? {
        ColmapFile::Binary(path) => binary::cameras(&path),
        ColmapFile::Text(path) => text::cameras(&path),
    }
}

/// The registered photographs, in file order.
pub(super) fn read_images(folder: &Path) -> Result<Vec<ModelImage>> {
    match required(folder, "images")? {
        ColmapFile::Binary(path) => binary::images(&path),
        ColmapFile::Text(path) => text::images(&path),
    }
}

/// The points with finite positions, by id; both encodings give the same order.
pub(super) fn read_points(folder: &Path) -> Result<Vec<ModelPoint>> {
    let points = match required(folder, "points3D")? {
        ColmapFile::Binary(path) => binary::points(&path)?,
        ColmapFile::Text(path) => text::points(&path)?,
    };
    Ok(points.into_values().filter(|point| point.position.is_finite()).collect())
}

enum ColmapFile {
    Binary(PathBuf),
    Text(PathBuf),
}

/// A file of a model; one whose name differs in case, such as `Cameras.txt`, where there is no other.
fn file(folder: &Path, stem: &str) -> Option<ColmapFile> {
    let exact = |extension| {
        Some(folder.join(stem).with_extension(extension)).filter(|path| tree::is_file(path))
    };
    if let Some(path) = exact("bin") {
        return Some(ColmapFile::Binary(path));
    }
    if let Some(path) = exact("txt") {
        return Some(ColmapFile::Text(path));
    }
    let mut paths = tree::entries(folder).ok()?;
    paths.sort();
    let alike = |extension: &str| {
        let name = format!("{stem}.{extension}");
        let is_alike = |path: &&PathBuf| {
            path.file_name().is_some_and(|other| other.eq_ignore_ascii_case(&name))
                && tree::is_file(path)
        };
        paths.iter().find(is_alike).cloned()
    };
    alike("bin").map(ColmapFile::Binary).or_else(|| alike("txt").map(ColmapFile::Text))
}

fn required(folder: &Path, stem: &str) -> Result<ColmapFile> {
    file(folder, stem)
        .ok_or_else(|| Error::input(folder, format!("has neither {stem}.bin nor {stem}.txt")))
}

/// Name and number of parameters by model id (colmap/src/colmap/sensor/models.h), up to COLMAP 4.
const MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];

/// The models that are rendered natively, or undistorted on load.
pub(super) const SUPPORTED: [&str; 11] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
    "SIMPLE_FISHEYE",
    "FISHEYE",
];

/// The remedy for photographs of an unsupported model.
pub(super) fn remedy(model: &str) -> &'static str {
    const PANORAMAS: [&str; 6] =
        ["EQUIRECTANGULAR", "SPHERICAL", "PANORAMA", "PANO", "CYLINDRICAL", "OMNIDIRECTIONAL"];
    if PANORAMAS.contains(&model.to_ascii_uppercase().as_str()) {
        "cut the panoramas into the six faces of a cube (90 degrees each) and find the cameras of those"
    } else {
        "run COLMAP's image_undistorter and load its PINHOLE model"
    }
}

/// A camera of a model by name; the error is a message for the user.
fn lens(model: &str, width: u64, height: u64, parameters: &[f64]) -> Result<Lens, String> {
    let none = Distortion::default();
    let fisheye = Distortion { is_fisheye: true, ..none };
    let (focal, principal_point, distortion) = match (model, parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], none),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], none),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => ([f, f], [cx, cy], Distortion { k1, ..none }),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], Distortion { k1, k2, ..none }),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            ([fx, fy], [cx, cy], Distortion { k1, k2, p1, p2, ..none })
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            let is_fisheye = false;
            ([fx, fy], [cx, cy], Distortion { k1, k2, k3, k4, k5, k6, p1, p2, is_fisheye })
        }
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k1]) => {
            ([f, f], [cx, cy], Distortion { k1, ..fisheye })
        }
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => {
            ([f, f], [cx, cy], Distortion { k1, k2, ..fisheye })
        }
        ("SIMPLE_FISHEYE", &[f, cx, cy]) => ([f, f], [cx, cy], fisheye),
        ("FISHEYE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], fisheye),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            ([fx, fy], [cx, cy], Distortion { k1, k2, k3, k4, ..fisheye })
        }
        _ if SUPPORTED.contains(&model) => {
            return Err(format!(
                "has {} parameters, {model} takes another number",
                parameters.len()
            ));
        }
        _ => {
            return Err(format!("has the unsupported model {model}; {}", remedy(model)));
        }
    };
    let [focal, principal_point] = [focal, principal_point].map(DVec2::from_array);
    let side = |pixels: u64| u32::try_from(pixels).unwrap_or(u32::MAX);
    let lens =
        Lens { width: side(width), height: side(height), focal, principal_point, distortion };
    lens.problem()
        .map_or(Ok(lens), |problem| Err(format!("is unusable: {problem}; export the model anew")))
}

fn pose(quaternion: [f64; 4], translation: [f64; 3]) -> Option<DAffine3> {
    let [w, x, y, z] = quaternion;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let translation = DVec3::from_array(translation);
    let usable = rotation.is_finite() && rotation.length() > 1e-6 && translation.is_finite();
    usable.then(|| DAffine3::from_rotation_translation(rotation.normalize(), translation))
}
