//! Cameras: the undistorted pinhole that everything renders with, and the calibrated lens that a dataset lists.
//!
//! Axes are those of `OpenCV` (x right, y down, z forward); pixel units, the image's corner at (0, 0), pixel centres at +0.5.

pub mod frame;
mod path;

use glam::{DAffine3, DVec2, DVec3, UVec2};

use crate::kernels;
pub use frame::Frame;
pub use path::CameraPath;

/// An undistorted pinhole camera with its pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal lengths, pixels.
    pub focal: DVec2,
    /// Where the optical axis meets the image, pixels; rarely the centre.
    pub principal_point: DVec2,
    /// Rigid: world space to view space (`OpenCV` axes).
    pub view_from_world: DAffine3,
}

impl Camera {
    /// The camera's position in world space.
    pub fn center(&self) -> DVec3 {
        self.view_from_world.inverse().translation
    }

    /// Where a world-space point appears, pixels (possibly outside the image); `None` behind the camera.
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        let in_view = self.view_from_world.transform_point3(point);
        (in_view.z > 0.0)
            .then(|| self.focal * in_view.truncate() / in_view.z + self.principal_point)
    }

    /// As [`Camera::project`], inside the image alone.
    pub fn sees(&self, point: DVec3) -> Option<DVec2> {
        let size = DVec2::new(self.width.into(), self.height.into());
        self.project(point)
            .filter(|pixel| pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(size).all())
    }

    /// The same camera over an image of another size.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let scale = DVec2::new(f64::from(width), f64::from(height))
            / DVec2::new(f64::from(self.width), f64::from(self.height));
        Self {
            width,
            height,
            focal: self.focal * scale,
            principal_point: self.principal_point * scale,
            view_from_world: self.view_from_world,
        }
    }
}

/// The camera as the kernels take it.
impl From<&Camera> for kernels::Camera {
    fn from(camera: &Camera) -> Self {
        let DAffine3 { matrix3: rotation, translation } = camera.view_from_world;
        let columns = [rotation.x_axis, rotation.y_axis, rotation.z_axis, translation];
        Self {
            view_from_world: columns.map(|column| column.as_vec3().to_array()),
            focal: camera.focal.as_vec2(),
            principal_point: camera.principal_point.as_vec2(),
            size: UVec2::new(camera.width, camera.height),
        }
    }
}

/// Radial and tangential distortion as `OpenCV` and COLMAP's `OPENCV` model define it.
///
/// COLMAP's `SIMPLE_RADIAL` (`k1`) and `RADIAL` (`k1`, `k2`) are the same formula with zeros; the default is none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// Radial coefficient of r^2.
    pub k1: f64,
    /// Radial coefficient of r^4.
    pub k2: f64,
    /// Tangential coefficient.
    pub p1: f64,
    /// Tangential coefficient.
    pub p2: f64,
}

impl Distortion {
    /// The distorted position of an undistorted one; both at unit depth, relative to the optical axis.
    pub fn distort(&self, DVec2 { x, y }: DVec2) -> DVec2 {
        let r2 = x * x + y * y;
        let radial = 1.0 + self.k1 * r2 + self.k2 * r2 * r2;
        DVec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + 2.0 * self.p2 * x * y + self.p1 * (r2 + 2.0 * y * y),
        )
    }

    /// The determinant of [`Distortion::distort`]'s derivative: not positive where the model folds over itself.
    pub fn determinant(&self, DVec2 { x, y }: DVec2) -> f64 {
        let r2 = x * x + y * y;
        let radial = 1.0 + self.k1 * r2 + self.k2 * r2 * r2;
        let slope = 2.0 * self.k1 + 4.0 * self.k2 * r2; // d radial / d r2, times 2
        let xx = radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x;
        let yy = radial + y * y * slope + 2.0 * self.p2 * x + 6.0 * self.p1 * y;
        let xy = x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y;
        xx * yy - xy * xy
    }
}

/// The intrinsics that a dataset lists for a photograph, before undistortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal lengths, pixels.
    pub focal: DVec2,
    /// Principal point, pixels.
    pub principal_point: DVec2,
    /// Zero for a pinhole.
    pub distortion: Distortion,
}

impl Lens {
    /// The longest side that is taken for an image's; anything beyond comes from a corrupt file.
    pub const MAX_SIDE: u32 = 65_535;

    /// Whether the lens is a pinhole already.
    pub fn is_pinhole(&self) -> bool {
        self.distortion == Distortion::default()
    }

    /// What makes the numbers unusable, if anything.
    pub fn problem(&self) -> Option<String> {
        let sides = 1..=Self::MAX_SIDE;
        let Distortion { k1, k2, p1, p2 } = self.distortion;
        if !sides.contains(&self.width) || !sides.contains(&self.height) {
            Some(format!("its size is {}x{}", self.width, self.height))
        } else if !(self.focal.is_finite() && self.focal.min_element() > 0.0) {
            Some(format!("its focal length is {}", self.focal))
        } else if !self.principal_point.is_finite() {
            Some(format!("its principal point is {}", self.principal_point))
        } else if ![k1, k2, p1, p2].iter().all(|coefficient| coefficient.is_finite()) {
            Some("its distortion is not finite".into())
        } else {
            None
        }
    }

    /// The same lens over a photograph of `width` x `height`; `None` unless that is the same picture at another
    /// scale, to the rounding of a pixel.
    pub fn fitted(&self, width: u32, height: u32) -> Option<Self> {
        let listed = DVec2::new(f64::from(self.width), f64::from(self.height));
        let actual = DVec2::new(f64::from(width), f64::from(height));
        let scale = actual / listed;
        let visible = width > 0 && height > 0;
        let off_by = (listed * scale.max_element() - actual).abs().max_element();
        (visible && off_by <= scale.max_element().max(1.0)).then_some(Self {
            width,
            height,
            focal: self.focal * scale,
            principal_point: self.principal_point * scale,
            distortion: self.distortion,
        })
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
    fn resizing_scales_what_is_projected_along_each_axis() {
        let point = in_world(DVec3::new(0.3, -0.2, 1.5));
        let (full, other) =
            (camera().project(point).unwrap(), camera().resized(25, 30).project(point).unwrap());
        assert!(other.distance(full * DVec2::new(0.25, 0.5)) < 1e-9);
    }

    #[test]
    fn the_determinant_is_that_of_the_distortions_derivative() {
        let distortion = Distortion { k1: -0.2, k2: 0.07, p1: 0.01, p2: -0.02 };
        let (at, step) = (DVec2::new(0.4, -0.3), 1e-6);
        let slope = |axis: DVec2| {
            (distortion.distort(at + step * axis) - distortion.distort(at - step * axis))
                / (2.0 * step)
        };
        let numeric = slope(DVec2::X).perp_dot(slope(DVec2::Y));
        assert!((distortion.determinant(at) - numeric).abs() < 1e-8);
    }

    #[test]
    fn a_lens_fits_a_photograph_of_its_shape_only() {
        let distortion = Distortion { k1: 0.1, ..Distortion::default() };
        let (focal, principal_point) = (DVec2::new(500.0, 510.0), DVec2::new(240.0, 190.0));
        let lens = Lens { width: 500, height: 375, focal, principal_point, distortion };
        assert_eq!(lens.fitted(500, 375), Some(lens));
        assert_eq!(lens.fitted(250, 188).map(|half| half.width), Some(250));
        assert_eq!(lens.fitted(1000, 750).map(|double| double.focal.x), Some(1000.0));
        for (width, height) in [(375, 500), (400, 375), (500, 380), (0, 0)] {
            assert_eq!(lens.fitted(width, height), None, "{width}x{height}");
        }
    }

    #[test]
    fn numbers_that_make_no_lens_are_told_apart() {
        let (focal, principal_point) = (DVec2::splat(50.0), DVec2::splat(20.0));
        let good = Lens {
            width: 40,
            height: 40,
            focal,
            principal_point,
            distortion: Distortion::default(),
        };
        assert_eq!(good.problem(), None);
        let bad = [
            Lens { width: 0, ..good },
            Lens { height: u32::MAX, ..good },
            Lens { focal: DVec2::new(50.0, 0.0), ..good },
            Lens { focal: DVec2::new(f64::NAN, 50.0), ..good },
            Lens { principal_point: DVec2::new(f64::INFINITY, 0.0), ..good },
            Lens { distortion: Distortion { p2: f64::NAN, ..Distortion::default() }, ..good },
        ];
        assert!(bad.iter().all(|lens| lens.problem().is_some()));
    }
}
