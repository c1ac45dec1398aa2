//! The pinhole camera of `include/camera.glsl`, in f64.

use glam::{DMat3, DVec2, DVec3, DVec4};

use crate::kernels;

/// A view as the parameters of the projecting kernels describe it.
#[derive(Clone, Debug)]
pub struct Camera {
    /// The rotation from world to view.
    pub rotation: DMat3,
    /// The translation from world to view.
    pub translation: DVec3,
    /// Pixels.
    pub focal: DVec2,
    /// Pixels.
    pub principal_point: DVec2,
    /// Pixels.
    pub size: DVec2,
    /// Where the Jacobian of the projection is taken at the least, x / z and y / z.
    pub least_slope: DVec2,
    /// And at the most.
    pub most_slope: DVec2,
}

impl From<&kernels::Camera> for Camera {
    fn from(camera: &kernels::Camera) -> Self {
        let [x, y, z, translation] =
            camera.view_from_world.map(|column| DVec3::from(column.map(f64::from)));
        Self {
            rotation: DMat3::from_cols(x, y, z),
            translation,
            focal: camera.focal.as_dvec2(),
            principal_point: camera.principal_point.as_dvec2(),
            size: camera.size.as_dvec2(),
            least_slope: camera.least_slope.as_dvec2(),
            most_slope: camera.most_slope.as_dvec2(),
        }
    }
}

impl Camera {
    /// A point of the world in view coordinates.
    pub fn view(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// The camera's position in the world.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// x / z and y / z, no farther than the Jacobian is taken.
    pub fn clamped_slope(&self, mean_in_view: DVec3) -> DVec2 {
        let slope = mean_in_view.truncate() / mean_in_view.z;
        slope.max(self.least_slope).min(self.most_slope)
    }
}

/// The rotation of a unit quaternion (w, x, y, z).
pub fn rotation(q: DVec4) -> DMat3 {
    let [w, x, y, z] = q.to_array();
    DMat3::from_cols_array(&[
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y + w * z),
        2.0 * (x * z - w * y),
        2.0 * (x * y - w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z + w * x),
        2.0 * (x * z + w * y),
        2.0 * (y * z - w * x),
        1.0 - 2.0 * (x * x + y * y),
    ])
}

/// A quaternion of unit length; the identity where the length is not a positive number.
pub fn unit_quat(q: DVec4) -> DVec4 {
    let norm = q.length();
    if norm > 1e-12 { q / norm } else { DVec4::X }
}
