//! Cameras: rendered pinhole or fisheye cameras, and the calibrated lenses of datasets.
//!
//! Axes are those of `OpenCV` (x right, y down, z forward). Pixel coordinates: the image's corner is (0, 0), pixel
//! centres are at +0.5.

mod axes;
pub mod frame;
mod keyframes;
mod lens;
mod model;
mod patch;
mod path;
mod poses;
mod rigid;

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec2Swizzles as _};

pub use axes::{enclosing_sphere, upwards};
pub use frame::TrainingFrame;
pub use keyframes::{Easing, FramePath, PathOptions};
pub use lens::{Distortion, Lens};
pub use model::{CameraModel, KannalaBrandt};
pub use patch::Patch;
pub use path::CameraPath;
pub use poses::CameraPoses;
pub use rigid::deviation_from_rigid;

/// A pinhole, fisheye or orthographic camera with its pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal lengths, pixels; of an orthographic camera pixels per world unit.
    pub focal: DVec2,
    /// The principal point, pixels.
    pub principal_point: DVec2,
    /// The projection model.
    pub model: CameraModel,
    /// Rigid: world space to view space (`OpenCV` axes).
    pub view_from_world: DAffine3,
}

impl Camera {
    /// A pinhole with square pixels and a centred principal point, for an image of `size` (width, height) in pixels;
    /// `fov_y` is the vertical field of view in radians.
    ///
    /// For an engine whose views look along -z with y up: `view_from_world` = `DAffine3::from_scale(DVec3::new(1.0,
    /// -1.0, -1.0)) * view`.
    pub fn perspective(view_from_world: DAffine3, fov_y: f64, [width, height]: [u32; 2]) -> Self {
        let size = DVec2::new(width.into(), height.into());
        Self {
            width,
            height,
            focal: DVec2::splat(0.5 * size.y / (0.5 * fov_y).tan()),
            principal_point: 0.5 * size,
            model: CameraModel::Pinhole,
            view_from_world,
        }
    }

    /// An orthographic camera with square pixels that sees `height` world units from its upper to its lower edge, for
    /// an image of `size` (width, height) in pixels. Axes as those of [`Camera::perspective`].
    pub fn orthographic(view_from_world: DAffine3, height: f64, size: [u32; 2]) -> Self {
        let focal = DVec2::splat(f64::from(size[1]) / height);
        let model = CameraModel::Orthographic;
        Self { focal, model, ..Self::perspective(view_from_world, 1.0, size) }
    }

    /// The camera's position in world space.
    pub fn center(&self) -> DVec3 {
        self.view_from_world.inverse().translation
    }

    /// Projects a world-space point to pixels (possibly outside the image); `None` behind the camera, or beyond the
    /// field of view of a fisheye.
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        let position = self.model.project(self.view_from_world.transform_point3(point))?;
        Some(self.focal * position + self.principal_point)
    }

    /// Unprojects a pixel at a depth, as defined by `CameraModel::depth`, to view space; `None` outside the field of
    /// view of a fisheye.
    #[doc(hidden)]
    pub fn in_view(&self, pixel: DVec2, depth: f64) -> Option<DVec3> {
        self.model.point((pixel - self.principal_point) / self.focal, depth)
    }

    /// The depth of a world-space point, as defined by [`CameraModel::depth`].
    #[doc(hidden)]
    pub fn depth(&self, point: DVec3) -> Option<f64> {
        self.model.depth(self.view_from_world.transform_point3(point))
    }

    /// [`Camera::project`], and `None` outside the image.
    #[doc(hidden)]
    pub fn sees(&self, point: DVec3) -> Option<DVec2> {
        self.sees_within(point, 0.0)
    }

    /// [`Camera::sees`] for an image with a margin, in widths and heights of the image.
    #[doc(hidden)]
    pub fn sees_within(&self, point: DVec3, margin: f64) -> Option<DVec2> {
        let size = DVec2::new(self.width.into(), self.height.into());
        let (from, to) = (-margin * size, (1.0 + margin) * size);
        self.project(point).filter(|pixel| pixel.cmpge(from).all() && pixel.cmplt(to).all())
    }

    /// The pixels that are at least partly outside the image circle of a fisheye, as indices into a plane, ascending.
    #[doc(hidden)]
    pub fn unseen(&self) -> Vec<usize> {
        let CameraModel::Fisheye(lens) = self.model else { return vec![] };
        let reach = lens.radius(lens.largest_angle());
        let size = DVec2::new(self.width.into(), self.height.into());
        // A rectangle is within an ellipse if its corners are.
        let is_within = |corner: DVec2, size: DVec2| {
            let corners = [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE];
            let mut corners = corners.into_iter().map(|at| corner + at * size);
            corners.all(|at| ((at - self.principal_point) / self.focal).length() < reach)
        };
        if is_within(DVec2::ZERO, size) {
            return vec![];
        }
        let corner = |pixel: u64| {
            let [column, row] = [pixel % u64::from(self.width), pixel / u64::from(self.width)];
            DVec2::new(column as f64, row as f64)
        };
        let all = 0..u64::from(self.width) * u64::from(self.height);
        all.filter(|&pixel| !is_within(corner(pixel), DVec2::ONE))
            .map(|pixel| pixel as usize)
            .collect()
    }

    /// The camera rotated about its optical axis: its image is this one's, rotated clockwise by quarter turns.
    #[doc(hidden)]
    pub fn turned(&self, quarters: u32) -> Self {
        (0..quarters % 4).fold(*self, |camera, _| {
            // Right in the rotated image is up in the original, and down is right.
            let turn = DMat3::from_cols(DVec3::Y, DVec3::NEG_X, DVec3::Z);
            Self {
                width: camera.height,
                height: camera.width,
                focal: camera.focal.yx(),
                principal_point: DVec2::new(
                    f64::from(camera.height) - camera.principal_point.y,
                    camera.principal_point.x,
                ),
                model: camera.model,
                view_from_world: DAffine3::from_mat3(turn) * camera.view_from_world,
            }
        })
    }

    /// The same camera with another image size.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let scale = DVec2::new(f64::from(width), f64::from(height))
            / DVec2::new(f64::from(self.width), f64::from(self.height));
        Self {
            width,
            height,
            focal: self.focal * scale,
            principal_point: self.principal_point * scale,
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        let rotation = glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1);
        Camera {
            width: 100,
            height: 60,
            focal: DVec2::new(80.0, 90.0),
            principal_point: DVec2::new(47.0, 33.0),
            model: CameraModel::Pinhole,
            view_from_world: DAffine3::from_rotation_translation(
                rotation,
                DVec3::new(1.0, -2.0, 3.0),
            ),
        }
    }

    fn in_world(in_view: DVec3) -> DVec3 {
        camera().view_from_world.inverse().transform_point3(in_view)
    }

    #[test]
    fn a_perspective_shows_half_its_angle_from_the_centre_to_the_top() {
        let camera = Camera::perspective(DAffine3::IDENTITY, 1.2, [640, 480]);
        let top = camera.project(DVec3::new(0.0, -(0.6_f64.tan()), 1.0)).unwrap();
        assert!((top - DVec2::new(320.0, 0.0)).length() < 1e-9, "{top}");
        let side = camera.project(DVec3::new(0.6_f64.tan(), 0.0, 1.0)).unwrap();
        assert!((side - DVec2::new(560.0, 240.0)).length() < 1e-9, "{side}");
    }

    #[test]
    fn a_point_on_the_axis_appears_at_the_principal_point_and_x_goes_right_y_down() {
        let pixel = camera().project(in_world(DVec3::new(0.0, 0.0, 2.0))).unwrap();
        assert!(pixel.distance(DVec2::new(47.0, 33.0)) < 1e-9);
        let pixel = camera().project(in_world(DVec3::new(0.5, 0.25, 2.0))).unwrap();
        assert!(pixel.distance(DVec2::new(67.0, 44.25)) < 1e-9);
    }

    #[test]
    fn nothing_behind_the_camera_appears() {
        assert_eq!(camera().project(in_world(DVec3::new(0.1, 0.1, -1.0))), None);
        assert_eq!(camera().project(DVec3::NAN), None);
        assert!(camera().view_from_world.transform_point3(camera().center()).length() < 1e-12);
    }

    #[test]
    fn resizing_scales_projections_along_each_axis() {
        let point = in_world(DVec3::new(0.3, -0.2, 1.5));
        let (full, other) =
            (camera().project(point).unwrap(), camera().resized(25, 30).project(point).unwrap());
        assert!(other.distance(full * DVec2::new(0.25, 0.5)) < 1e-9);
    }

    #[test]
    fn a_rotated_camera_shows_the_rotated_image() {
        let point = in_world(DVec3::new(0.3, -0.2, 1.5));
        let DVec2 { x, y } = camera().project(point).unwrap();
        let (width, height) = (f64::from(camera().width), f64::from(camera().height));
        let turned = [(x, y), (height - y, x), (width - x, height - y), (y, width - x), (x, y)];
        for (quarters, (x, y)) in (0..).zip(turned) {
            let turned = camera().turned(quarters);
            assert!(turned.project(point).unwrap().distance(DVec2::new(x, y)) < 1e-9, "{quarters}");
            assert!(turned.center().distance(camera().center()) < 1e-12);
            let is_upright = quarters % 2 == 0;
            assert_eq!(
                (turned.width, turned.height),
                if is_upright { (100, 60) } else { (60, 100) }
            );
        }
    }
}
