//! The fisheye of `include/camera_fisheye.glsl`, in f64.

use glam::{DVec2, DVec3};

use super::ImagePoint;

/// A point at the angle t off the axis is at the distance `t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)` from the
/// principal point.
#[derive(Clone, Debug)]
pub struct Fisheye {
    /// k1 to k4.
    pub distortion: [f64; 4],
    /// Points at this angle off the axis or more are not seen, radians.
    pub largest_angle: f64,
}

/// A point in polar coordinates, with its distorted radius.
struct Ray {
    distance: f64,
    across: DVec2,
    sine: f64,
    cosine: f64,
    radius: f64,
    /// The first two derivatives of the radius with respect to the angle.
    slope: f64,
    bend: f64,
    /// radius / sine, and its derivative.
    stretch: f64,
    d_stretch: f64,
}

impl Fisheye {
    pub(super) fn depth(&self, point: DVec3) -> f64 {
        let angle = point.truncate().length().atan2(point.z);
        let is_seen = point.z > 0.0 && angle < self.largest_angle;
        if is_seen { point.length() } else { -1.0 }
    }

    fn ray(&self, point: DVec3) -> Ray {
        let off_axis = point.truncate().length();
        let distance = point.length();
        let (sine, cosine) = (off_axis / distance, point.z / distance);
        let t = off_axis.atan2(point.z);
        let power = |exponent: usize| t.powi(exponent as i32);
        // The derivative of an order of 1 + k1 t^2 + .., times a power of t: terms with their factors.
        let sum = |factor: &dyn Fn(f64) -> f64, less: usize| -> f64 {
            let terms = self.distortion.iter().zip(1..);
            terms.map(|(k, i)| k * factor((2 * i + 1) as f64) * power(2 * i + 1 - less)).sum()
        };
        let factor = 1.0 + sum(&|_| 1.0, 1);
        let ratio = if sine > 0.0 { t / sine } else { 1.0 };
        // t / sin t = 1 + t^2 / 6 + 7 t^4 / 360 + 31 t^6 / 15120 + ...; near the axis, the closed form of its
        // derivative cancels.
        let d_ratio = if t < 0.02 {
            t / 3.0 + 7.0 / 90.0 * power(3) + 31.0 / 2520.0 * power(5)
        } else {
            (sine - t * cosine) / (sine * sine)
        };
        Ray {
            distance,
            across: point.truncate().try_normalize().unwrap_or(DVec2::X),
            sine,
            cosine,
            radius: t * factor,
            slope: 1.0 + sum(&|n| n, 1),
            bend: sum(&|n| n * (n - 1.0), 2),
            stretch: factor * ratio,
            d_stretch: sum(&|n| n - 1.0, 2) * ratio + factor * d_ratio,
        }
    }

    pub(super) fn image_point(&self, point: DVec3) -> ImagePoint {
        let Ray { distance, across: n, sine, cosine, radius, slope, stretch, .. } = self.ray(point);
        let row = |axis: DVec2| {
            let along = axis.dot(n);
            let plane = stretch * (axis - along * n) + slope * cosine * along * n;
            plane.extend(-slope * sine * along) / distance
        };
        ImagePoint { at: radius * n, jacobian: [row(DVec2::X), row(DVec2::Y)] }
    }

    /// With respect to distance, angle and azimuth.
    pub(super) fn backward(&self, point: DVec3, d_place: DVec2, d_rows: [DVec3; 2]) -> DVec3 {
        let ray = self.ray(point);
        let n = ray.across;
        let side = n.perp();
        let part = |by: DVec2| by.x * d_rows[0] + by.y * d_rows[1];
        let (along, beside) = (part(n), part(side));
        let [nn, ns] = [n, side].map(|axis| along.truncate().dot(axis));
        let [sn, ss] = [n, side].map(|axis| beside.truncate().dot(axis));
        let Ray { distance, sine, cosine, slope, bend, stretch, d_stretch, .. } = ray;

        let by_distance = -(stretch * ss + slope * cosine * nn - slope * sine * along.z);
        let by_angle = d_stretch * ss + (bend * cosine - slope * sine) * nn
            - (bend * sine + slope * cosine) * along.z
            + distance * slope * d_place.dot(n);
        let by_turn = (d_stretch * cosine - stretch * sine) * (ns + sn) - slope * beside.z
            + distance * stretch * d_place.dot(side);
        let d_xy = (by_distance * sine + by_angle * cosine) * n + by_turn * side;
        d_xy.extend(by_distance * cosine - by_angle * sine) / (distance * distance)
    }
}
