//! Intrinsics of a NeRF-style listing: shared, per frame, or both.

use std::path::Path;

use glam::DVec2;
use nightsplat_core::camera::{Distortion, Lens};
use serde::Deserialize;

use crate::dataset::colmap::{SUPPORTED, remedy};
use crate::image::Image;
use crate::image::ImageFile as _;

#[derive(Clone, Default, Deserialize)]
pub(super) struct Intrinsics {
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

/// A number that is present; null represents NaN, which differs from a missing key.
fn number<'de, D: serde::Deserializer<'de>>(value: D) -> Result<Option<f64>, D::Error> {
    Option::<f64>::deserialize(value).map(|number| number.or(Some(f64::NAN)))
}

impl Intrinsics {
    pub(super) fn over(self, shared: &Self) -> Self {
        let shared = shared.clone();
        // Either spelling of the focal length in the frame overrides both at the top level.
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

    /// Width and height, pixels: as listed, else those of the file.
    pub(super) fn size(&self, file: Option<&Path>) -> Option<DVec2> {
        if let (Some(w), Some(h)) = (self.w, self.h) {
            return Some(DVec2::new(w, h));
        }
        let (width, height) = Image::size_of(file?).ok()?;
        Some(DVec2::new(f64::from(width), f64::from(height)))
    }

    pub(super) fn lens(&self, size: DVec2) -> Result<Lens, String> {
        let model = self.camera_model.as_deref().unwrap_or("OPENCV");
        let undistort = remedy(model);
        if model != "PERSPECTIVE" && !SUPPORTED.contains(&model) {
            return Err(format!("the camera model {model} is not supported; {undistort}"));
        }
        let is_fisheye = self.is_fisheye == Some(true) || model.ends_with("FISHEYE");
        let nonzero = |value: Option<f64>| value.unwrap_or(0.0) != 0.0;
        if !is_fisheye && nonzero(self.k4) {
            // A coefficient of r^8 in some exports, of a denominator in OpenCV.
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
            // A saturating cast: invalid values become a size that `problem` refuses.
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
