//! The pinhole of `include/camera_pinhole.glsl`, in f64.

use glam::{DVec2, DVec3};

use super::ImagePoint;

/// x / z and y / z.
#[derive(Clone, Debug)]
pub struct Pinhole {
    /// The lower bound of x / z and y / z for the Jacobian of the projection.
    pub min_slope: DVec2,
    /// The upper bound.
    pub max_slope: DVec2,
}

impl Pinhole {
    /// x / z and y / z, clamped to the bounds of the Jacobian.
    pub fn clamped_slope(&self, point: DVec3) -> DVec2 {
        let slope = point.truncate() / point.z;
        slope.max(self.min_slope).min(self.max_slope)
    }

    pub(super) fn image_point(&self, point: DVec3) -> ImagePoint {
        let slope = self.clamped_slope(point);
        let rows = [DVec3::new(1.0, 0.0, -slope.x), DVec3::new(0.0, 1.0, -slope.y)];
        ImagePoint { at: point.truncate() / point.z, jacobian: rows.map(|row| row / point.z) }
    }

    pub(super) fn backward(&self, point: DVec3, d_place: DVec2, d_rows: [DVec3; 2]) -> DVec3 {
        let (z, free_slope) = (point.z, point.truncate() / point.z);
        let slope = self.clamped_slope(point);
        let [d_x, d_y] = d_rows;
        let mut d_slope = -DVec2::new(d_x.z, d_y.z) / z;
        for axis in 0..2 {
            if free_slope[axis] != slope[axis] {
                d_slope[axis] = 0.0;
            }
        }
        let d_xy = (d_place + d_slope) / z;
        let d_inverse_z = d_x.x - slope.x * d_x.z + d_y.y - slope.y * d_y.z;
        d_xy.extend(-d_inverse_z / (z * z) - d_xy.dot(free_slope))
    }
}
