//! Camera models: the projection of directions onto the image.

use std::f64::consts::FRAC_PI_2;

use glam::{DVec2, DVec3};

/// The projection of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum CameraModel {
    /// Perspective: x / z and y / z.
    #[default]
    Pinhole,
    /// `OPENCV_FISHEYE`: a polynomial of the angle off the axis.
    Fisheye(KannalaBrandt),
    /// Parallel: x and y, where the focal lengths are pixels per world unit. It is rendered, not trained on.
    Orthographic,
}

/// The polynomial of a fisheye (Kannala and Brandt 2006, as in `OpenCV` and COLMAP): the angle t off the axis is
/// projected to `t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)` focal lengths from the principal point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct KannalaBrandt {
    /// k1 to k4.
    pub coefficients: [f64; 4],
}

impl KannalaBrandt {
    /// The radius, in focal lengths, at an angle off the axis, in radians.
    #[doc(hidden)]
    pub fn radius(&self, angle: f64) -> f64 {
        let [k1, k2, k3, k4] = self.coefficients;
        let t2 = angle * angle;
        angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    }

    /// Its derivative.
    #[doc(hidden)]
    pub fn slope(&self, angle: f64) -> f64 {
        let [k1, k2, k3, k4] = self.coefficients;
        let t2 = angle * angle;
        1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    }

    /// The largest angle of the field of view, in radians: 90 degrees, or less if the radius stops increasing.
    #[doc(hidden)]
    pub fn largest_angle(&self) -> f64 {
        const STEPS: u32 = 4096;
        let at = |step: u32| FRAC_PI_2 * f64::from(step) / f64::from(STEPS);
        // Written so that a NaN does not increase.
        let rises = |angle: f64| self.slope(angle) > 0.0;
        let Some(step) = (1..=STEPS).find(|&step| !rises(at(step))) else { return FRAC_PI_2 };
        let (mut low, mut high) = (at(step - 1), at(step));
        for _ in 0..48 {
            let middle = 0.5 * (low + high);
            *(if rises(middle) { &mut low } else { &mut high }) = middle;
        }
        low
    }

    /// The angle at a radius, in focal lengths; `None` beyond the largest radius.
    #[doc(hidden)]
    pub fn angle(&self, radius: f64) -> Option<f64> {
        let (mut low, mut high) = (0.0, self.largest_angle());
        if !(0.0..self.radius(high)).contains(&radius) {
            return None;
        }
        // Bisection down to neighbouring floats.
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            *(if self.radius(middle) <= radius { &mut low } else { &mut high }) = middle;
        }
        Some(0.5 * (low + high))
    }
}

impl CameraModel {
    /// The depth of a view-space point (x right, y down, z forward), for sorting and the near plane: the
    /// distance for a fisheye, else z. `None` outside the field of view.
    #[doc(hidden)]
    pub fn depth(&self, point: DVec3) -> Option<f64> {
        match self {
            Self::Pinhole | Self::Orthographic => Some(point.z).filter(|&z| z > 0.0),
            Self::Fisheye(lens) => {
                let angle = point.truncate().length().atan2(point.z);
                (point.z > 0.0 && angle < lens.largest_angle()).then(|| point.length())
            }
        }
    }

    /// Projects a view-space point, in focal lengths from the principal point; `None` outside the field of view.
    #[doc(hidden)]
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        self.depth(point)?;
        Some(match self {
            Self::Pinhole => point.truncate() / point.z,
            Self::Orthographic => point.truncate(),
            Self::Fisheye(lens) => {
                let across = point.truncate();
                let angle = across.length().atan2(point.z);
                lens.radius(angle) * across.normalize_or(DVec2::X)
            }
        })
    }

    /// Unprojects a position, in focal lengths from the principal point, at a depth, to view space; `None` outside the
    /// field of view.
    #[doc(hidden)]
    pub fn point(&self, position: DVec2, depth: f64) -> Option<DVec3> {
        match self {
            Self::Pinhole => Some(position.extend(1.0) * depth),
            Self::Orthographic => Some(position.extend(depth)),
            Self::Fisheye(lens) => {
                let (sin, cos) = lens.angle(position.length())?.sin_cos();
                Some((sin * position.normalize_or(DVec2::X)).extend(cos) * depth)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [[f64; 4]; 4] = [
        [0.0; 4],
        [0.05, -0.02, 0.006, -0.001],
        // Increases up to 70 degrees and decreases beyond.
        [-0.2231, 0.0, 0.0, 0.0],
        [-0.0124, 0.0044, -0.0031, 0.0005],
    ];

    #[test]
    fn unprojected_points_are_projected_to_their_place() {
        for coefficients in LENSES {
            let model = CameraModel::Fisheye(KannalaBrandt { coefficients });
            for (x, y) in [(0.0, 0.0), (0.3, -0.2), (-0.7, 0.1), (1e-9, 0.0), (0.5, 0.5)] {
                let position = DVec2::new(x, y);
                let point = model.point(position, 3.0).unwrap();
                assert!((model.depth(point).unwrap() - 3.0).abs() < 1e-12);
                assert!(
                    model.project(point).unwrap().distance(position) < 1e-12,
                    "{coefficients:?}"
                );
            }
        }
        let position = DVec2::new(0.4, -3.0);
        let point = CameraModel::Pinhole.point(position, 2.0).unwrap();
        assert_eq!((point.z, CameraModel::Pinhole.project(point)), (2.0, Some(position)));
        let point = CameraModel::Orthographic.point(position, 2.0).unwrap();
        assert_eq!(point, DVec3::new(0.4, -3.0, 2.0));
        assert_eq!(CameraModel::Orthographic.project(point), Some(position));
        assert_eq!(CameraModel::Orthographic.project(-DVec3::Z), None);
    }

    #[test]
    fn the_field_of_view_ends_at_90_degrees_or_where_the_radius_falls() {
        let fold = KannalaBrandt { coefficients: LENSES[2] };
        let largest = fold.largest_angle();
        assert!((largest - (1.0f64 / (3.0 * 0.2231)).sqrt()).abs() < 1e-9, "{largest}");
        for lens in LENSES.map(|coefficients| KannalaBrandt { coefficients }) {
            let (model, largest) = (CameraModel::Fisheye(lens), lens.largest_angle());
            let at = |angle: f64| DVec3::new(0.6 * angle.sin(), -0.8 * angle.sin(), angle.cos());
            assert!(model.project(at(largest - 1e-6)).is_some());
            for angle in [largest + 1e-6, FRAC_PI_2 + 1e-6, 2.0, 3.0, std::f64::consts::PI] {
                assert_eq!(model.project(at(angle)), None, "{lens:?} {angle}");
            }
            assert_eq!(model.point(DVec2::X * (lens.radius(largest) + 1e-9), 1.0), None);
            assert_eq!(model.project(DVec3::NAN), None);
        }
        assert_eq!(KannalaBrandt { coefficients: [f64::NAN; 4] }.angle(0.5), None);
    }
}
