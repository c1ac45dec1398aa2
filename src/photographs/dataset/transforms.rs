//! NeRF-style listings: `transforms_{train,test,val}.json` or one `transforms.json`.
//!
//! `transform_matrix` is view to world in OpenGL axes (x right, y up, z back). Intrinsics stand at the top, in a frame,
//! or both: the frame's win.

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec2, DVec3};
use serde::Deserialize;

use super::Split;
use super::colmap::SUPPORTED;
use super::listed::{ListedView, Listing};
use super::names::below_first;
use crate::base::input;
use crate::camera::{Distortion, Lens};
use crate::photographs::image::Image;
use crate::photographs::image::files::{Files, stem};
use crate::{Error, Result};

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: Intrinsics,
    frames: Vec<ListedFrame>,
}

#[derive(Deserialize)]
struct ListedFrame {
    file_path: String,
    /// 4x4 or 3x4 rows; `None` stands for NaN.
    transform_matrix: Vec<Vec<Option<f64>>>,
    #[serde(flatten)]
    own: Intrinsics,
}

#[derive(Clone, Default, Deserialize)]
struct Intrinsics {
    #[serde(default, deserialize_with = "number")]
    w: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    h: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    fl_x: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    fl_y: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    camera_angle_x: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    cx: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    cy: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    k1: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    k2: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    k3: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    k4: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    p1: Option<f64>,
    #[serde(default, deserialize_with = "number")]
    p2: Option<f64>,
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
}

/// A number that is there; null stands for NaN, which is not the same as leaving it out.
fn number<'de, D: serde::Deserializer<'de>>(value: D) -> Result<Option<f64>, D::Error> {
    Option::<f64>::deserialize(value).map(|number| number.or(Some(f64::NAN)))
}

/// The files that make up a listing below `root`, with the split each stands for; empty where there is none.
///
/// `transforms_val.json` often repeats test views: it counts only where there is no test listing.
pub(super) fn find(root: &Path) -> Vec<(PathBuf, Option<Split>)> {
    let existing = |name: &str| Some(root.join(name)).filter(|path| path.is_file());
    let held_out = existing("transforms_test.json").or_else(|| existing("transforms_val.json"));
    match (existing("transforms_train.json"), held_out) {
        (Some(train), Some(test)) => vec![(train, Some(Split::Train)), (test, Some(Split::Test))],
        (Some(single), None) => vec![(single, None)],
        (None, _) => existing("transforms.json").map(|single| (single, None)).into_iter().collect(),
    }
}

/// Reads one file's frames into the listing; a frame without a usable pose or size goes to `skipped`.
pub(super) fn read(
    root: &Path,
    path: &Path,
    split: Option<Split>,
    files: &Files,
    listing: &mut Listing,
) -> Result<()> {
    let text = input::text(path)?;
    let transforms: Transforms = serde_json::from_str(&nan_as_null(&text)).map_err(|error| {
        let remedy = if error.is_eof() {
            "it is cut short, copy it again"
        } else {
            "mend or export it anew"
        };
        Error::input(path, format!("is not a usable transforms file ({error}); {remedy}"))
    })?;
    for frame in transforms.frames {
        let listed = frame.file_path.replace('\\', "/");
        let listed = listed.trim_start_matches("./").to_owned();
        let Some(view_from_world) = pose(&frame.transform_matrix) else {
            listing.skipped.push(format!(
                "{listed}: its transform_matrix is no finite rotation and translation"
            ));
            continue;
        };
        let file = files.find(root, &listed);
        let intrinsics = frame.own.over(&transforms.shared);
        let Some(size) = intrinsics.size(file.as_deref()) else {
            listing.skipped.push(format!(
                "{listed}: neither w and h nor a readable file says how large it is"
            ));
            continue;
        };
        let lens = intrinsics
            .lens(size)
            .map_err(|problem| Error::input(path, format!("{listed}: {problem}")))?;
        let (name, below) = (stem(&listed).to_owned(), below_first(&listed).to_owned());
        listing.frames.push(ListedView { name, listed, below, split, file, lens, view_from_world });
    }
    Ok(())
}

/// Python writes NaN and Infinity bare, which JSON does not know; as null they are reported with their frame.
fn nan_as_null(text: &str) -> String {
    let quoted = |(index, part): (usize, &str)| match index % 2 {
        0 => part.replace("-Infinity", "null").replace("Infinity", "null").replace("NaN", "null"),
        _ => part.to_owned(),
    };
    // Between quotes nothing changes; an escaped quote swaps inside and outside, so such a file is left alone.
    if text.contains("\\\"") {
        return text.to_owned();
    }
    text.split('"').enumerate().map(quoted).collect::<Vec<_>>().join("\"")
}

fn pose(rows: &[Vec<Option<f64>>]) -> Option<DAffine3> {
    let row = |index: usize| -> Option<[f64; 4]> {
        let values: Option<Vec<f64>> = rows.get(index)?.iter().copied().collect();
        values?.try_into().ok()
    };
    let [x, y, z] = [row(0)?, row(1)?, row(2)?];
    let rotation =
        DMat3::from_cols_array(&[x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]]).transpose();
    let world_from_gl = DAffine3 { matrix3: rotation, translation: DVec3::new(x[3], y[3], z[3]) };
    let off = rotation.transpose() * rotation - DMat3::IDENTITY;
    // Positive phrasing: a NaN fails the test too.
    let is_rotation =
        off.to_cols_array().iter().all(|entry| entry.abs() < 1e-3) && rotation.determinant() > 0.0;
    let opencv_from_gl = DAffine3::from_scale(DVec3::new(1.0, -1.0, -1.0));
    (is_rotation && world_from_gl.is_finite()).then(|| opencv_from_gl * world_from_gl.inverse())
}

impl Intrinsics {
    fn over(self, shared: &Self) -> Self {
        let shared = shared.clone();
        // One focal length's spelling in the frame overrides the other's at the top.
        let own_focal = self.fl_x.is_some() || self.camera_angle_x.is_some();
        let shared_focal = |value: Option<f64>| if own_focal { None } else { value };
        Self {
            w: self.w.or(shared.w),
            h: self.h.or(shared.h),
            fl_x: self.fl_x.or(shared_focal(shared.fl_x)),
            fl_y: self.fl_y.or(shared_focal(shared.fl_y)),
            camera_angle_x: self.camera_angle_x.or(shared_focal(shared.camera_angle_x)),
            cx: self.cx.or(shared.cx),
            cy: self.cy.or(shared.cy),
            k1: self.k1.or(shared.k1),
            k2: self.k2.or(shared.k2),
            k3: self.k3.or(shared.k3),
            k4: self.k4.or(shared.k4),
            p1: self.p1.or(shared.p1),
            p2: self.p2.or(shared.p2),
            camera_model: self.camera_model.or(shared.camera_model),
            is_fisheye: self.is_fisheye.or(shared.is_fisheye),
        }
    }

    /// Width and height, pixels: as listed, else the file's.
    fn size(&self, file: Option<&Path>) -> Option<DVec2> {
        if let (Some(w), Some(h)) = (self.w, self.h) {
            return Some(DVec2::new(w, h));
        }
        let (width, height) = Image::size_of(file?).ok()?;
        Some(DVec2::new(f64::from(width), f64::from(height)))
    }

    fn lens(&self, size: DVec2) -> Result<Lens, String> {
        let undistort = "run COLMAP's image_undistorter and export its PINHOLE model";
        let model = self.camera_model.as_deref().unwrap_or("OPENCV");
        if model != "PERSPECTIVE" && !SUPPORTED.contains(&model) {
            return Err(format!("the camera model {model} is not supported; {undistort}"));
        }
        let is_fisheye = self.is_fisheye == Some(true) || model.ends_with("FISHEYE");
        let nonzero = |value: Option<f64>| value.unwrap_or(0.0) != 0.0;
        if !is_fisheye && nonzero(self.k4) {
            // Of r^8 in some exports, in OpenCV's a denominator.
            return Err(format!("k4 of a lens that is no fisheye is not supported; {undistort}"));
        }
        if is_fisheye && (nonzero(self.p1) || nonzero(self.p2)) {
            return Err(format!("p1 and p2 of a fisheye are not supported; {undistort}"));
        }
        let from_angle = self.camera_angle_x.map(|angle| 0.5 * size.x / (0.5 * angle).tan());
        let fl_x =
            self.fl_x.or(from_angle).ok_or("there is neither fl_x nor camera_angle_x; add one")?;
        let coefficient = |value: Option<f64>| value.unwrap_or(0.0);
        let lens = Lens {
            // A saturating cast: nonsense becomes a size that `problem` refuses.
            width: size.x.round() as u32,
            height: size.y.round() as u32,
            focal: DVec2::new(fl_x, self.fl_y.unwrap_or(fl_x)),
            principal_point: DVec2::new(
                self.cx.unwrap_or(0.5 * size.x),
                self.cy.unwrap_or(0.5 * size.y),
            ),
            distortion: Distortion {
                k1: coefficient(self.k1),
                k2: coefficient(self.k2),
                k3: coefficient(self.k3),
                k4: coefficient(self.k4),
                p1: coefficient(self.p1),
                p2: coefficient(self.p2),
                is_fisheye,
                ..Distortion::default()
            },
        };
        lens.problem().map_or(Ok(lens), |problem| Err(format!("{problem}; mend the intrinsics")))
    }
}
