//! The camera of `include/camera.glsl`, in f64.

pub mod fisheye;
mod orthographic;
pub mod pinhole;

use glam::{DMat3, DVec2, DVec3};

use crate::kernels;
use crate::kernels::camera::{CAMERA_FISHEYE, CAMERA_ORTHOGRAPHIC};

use fisheye::Fisheye;
use pinhole::Pinhole;

/// A camera as in the buffer of cameras.
#[derive(Clone, Debug)]
pub struct ReferenceCamera {
    /// The rotation from world to view; for an instance, that from its model with its scale.
    pub rotation: DMat3,
    /// The translation from world to view.
    pub translation: DVec3,
    /// Pixels.
    pub focal: DVec2,
    /// Pixels.
    pub principal_point: DVec2,
    /// Pixels.
    pub size: DVec2,
    /// The projection, in units of the focal lengths.
    pub model: ReferenceLens,
}

/// A camera model.
#[derive(Clone, Debug)]
pub enum ReferenceLens {
    /// `include/camera_pinhole.glsl`
    Pinhole(Pinhole),
    /// `include/camera_fisheye.glsl`
    Fisheye(Fisheye),
    /// `include/camera_orthographic.glsl`
    Orthographic,
}

/// The projection of a point, in units of the focal lengths.
#[derive(Clone, Copy, Debug)]
pub struct ImagePoint {
    /// Relative to the principal point.
    pub at: DVec2,
    /// Its derivative with respect to the point, row by row.
    pub jacobian: [DVec3; 2],
}

impl From<&kernels::Camera> for ReferenceCamera {
    fn from(camera: &kernels::Camera) -> Self {
        let [x, y, z, translation] =
            camera.view_from_world.map(|column| DVec3::from(column.map(f64::from)));
        let model = match camera.model {
            CAMERA_FISHEYE => ReferenceLens::Fisheye(Fisheye {
                distortion: camera.distortion.map(f64::from),
                largest_angle: camera.largest_angle.into(),
            }),
            CAMERA_ORTHOGRAPHIC => ReferenceLens::Orthographic,
            _ => ReferenceLens::Pinhole(Pinhole {
                min_slope: camera.min_slope.as_dvec2(),
                max_slope: camera.max_slope.as_dvec2(),
            }),
        };
        Self {
            rotation: DMat3::from_cols(x, y, z),
            translation,
            focal: camera.focal.as_dvec2(),
            principal_point: camera.principal_point.as_dvec2(),
            size: camera.size.as_dvec2(),
            model,
        }
    }
}

impl ReferenceCamera {
    /// A point of the world in view coordinates.
    pub fn view(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// The camera's position in the world.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.inverse() * self.translation)
    }

    /// The direction in which a point of the world is seen, of any length.
    pub fn direction(&self, point: DVec3) -> DVec3 {
        match &self.model {
            ReferenceLens::Orthographic => self.rotation.row(2),
            _ => point - self.center(),
        }
    }

    /// The depth of a point in view coordinates; not positive if the model does not see it.
    pub fn depth(&self, point: DVec3) -> f64 {
        match &self.model {
            ReferenceLens::Pinhole(_) | ReferenceLens::Orthographic => point.z,
            ReferenceLens::Fisheye(fisheye) => fisheye.depth(point),
        }
    }

    /// The pixel at which a point of positive depth is seen.
    pub fn project(&self, point: DVec3) -> DVec2 {
        self.focal * self.image_point(point).at + self.principal_point
    }

    /// The derivative of the pixel with respect to the point, row by row.
    pub fn jacobian(&self, point: DVec3) -> [DVec3; 2] {
        let [x, y] = self.image_point(point).jacobian;
        [self.focal.x * x, self.focal.y * y]
    }

    fn image_point(&self, point: DVec3) -> ImagePoint {
        match &self.model {
            ReferenceLens::Pinhole(pinhole) => pinhole.image_point(point),
            ReferenceLens::Fisheye(fisheye) => fisheye.image_point(point),
            ReferenceLens::Orthographic => orthographic::image_point(point),
        }
    }

    /// The gradient of the point, from those of its pixel and of the rows of [`ReferenceCamera::jacobian`]; none of an
    /// orthographic camera.
    pub fn backward(&self, point: DVec3, d_pixel: DVec2, d_rows: [DVec3; 2]) -> DVec3 {
        let d_place = self.focal * d_pixel;
        let d_rows = [self.focal.x * d_rows[0], self.focal.y * d_rows[1]];
        match &self.model {
            ReferenceLens::Pinhole(pinhole) => pinhole.backward(point, d_place, d_rows),
            ReferenceLens::Fisheye(fisheye) => fisheye.backward(point, d_place, d_rows),
            ReferenceLens::Orthographic => DVec3::ZERO,
        }
    }

    /// The first-order change of depth between a point and another at an offset.
    pub(super) fn depth_change(&self, point: DVec3, offset: DVec3) -> f64 {
        match &self.model {
            ReferenceLens::Pinhole(_) | ReferenceLens::Orthographic => offset.z,
            ReferenceLens::Fisheye(_) => point.dot(offset) / point.length(),
        }
    }

    /// The point moved to another depth.
    pub(super) fn at_depth(&self, point: DVec3, depth: f64) -> DVec3 {
        match &self.model {
            ReferenceLens::Pinhole(_) | ReferenceLens::Orthographic => {
                point.truncate().extend(depth)
            }
            ReferenceLens::Fisheye(_) => point * (depth / point.length()),
        }
    }
}
