//! The calibrated lenses of datasets, and their distortion.

use glam::{DVec2, Vec2Swizzles as _};

use super::{CameraModel, KannalaBrandt};

/// Lens distortion as COLMAP's camera models define it; the default is none.
///
/// With `(x, y)` at unit depth and r its length, a perspective lens (COLMAP's `SIMPLE_RADIAL`, `RADIAL`, `OPENCV` and
/// `FULL_OPENCV`, which differ in the coefficients that are zero) scales by `(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4
/// r^2 + k5 r^4 + k6 r^6)` and shifts by p1 and p2. A fisheye (`SIMPLE_RADIAL_FISHEYE`, `RADIAL_FISHEYE`,
/// `OPENCV_FISHEYE`) projects the angle t off its axis, t = atan r, to `t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// Radial coefficient of r^2, or of a fisheye's t^2.
    pub k1: f64,
    /// Radial coefficient of r^4 or t^4.
    pub k2: f64,
    /// Radial coefficient of r^6 or t^6.
    pub k3: f64,
    /// Of r^2 in the denominator, or of a fisheye's t^8.
    pub k4: f64,
    /// Of r^4 in the denominator; a fisheye has none.
    pub k5: f64,
    /// Of r^6 in the denominator; a fisheye has none.
    pub k6: f64,
    /// Tangential coefficient; a fisheye has none.
    pub p1: f64,
    /// Tangential coefficient; a fisheye has none.
    pub p2: f64,
    /// Whether the polynomial is a function of angles, not of their tangents.
    pub is_fisheye: bool,
}

impl Distortion {
    /// Distorts a position at unit depth, relative to the optical axis.
    pub fn distort(&self, at: DVec2) -> DVec2 {
        let DVec2 { x, y } = at;
        let r2 = x * x + y * y;
        if self.is_fisheye {
            return at * self.fisheye(r2.sqrt())[0];
        }
        let [radial, _] = self.radial(r2);
        DVec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + 2.0 * self.p2 * x * y + self.p1 * (r2 + 2.0 * y * y),
        )
    }

    /// The determinant of the Jacobian of [`Distortion::distort`]; not positive if the model folds over.
    pub fn determinant(&self, DVec2 { x, y }: DVec2) -> f64 {
        let r2 = x * x + y * y;
        if self.is_fisheye {
            let [scale, slope] = self.fisheye(r2.sqrt());
            return scale * slope;
        }
        let [radial, slope] = self.radial(r2);
        let slope = 2.0 * slope;
        let xx = radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x;
        let yy = radial + y * y * slope + 2.0 * self.p2 * x + 6.0 * self.p1 * y;
        let xy = x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y;
        xx * yy - xy * xy
    }

    /// The radial factor of a perspective lens, and its derivative with respect to r^2.
    fn radial(&self, r2: f64) -> [f64; 2] {
        let Self { k1, k2, k3, k4, k5, k6, .. } = *self;
        let polynomial = |a: f64, b: f64, c: f64| 1.0 + a * r2 + b * r2 * r2 + c * r2 * r2 * r2;
        let slope = |a: f64, b: f64, c: f64| a + 2.0 * b * r2 + 3.0 * c * r2 * r2;
        let (above, below) = (polynomial(k1, k2, k3), polynomial(k4, k5, k6));
        let slope = (slope(k1, k2, k3) * below - above * slope(k4, k5, k6)) / (below * below);
        // Beyond a pole, the factor changes its sign.
        [if below > 0.0 { above / below } else { f64::NAN }, slope]
    }

    /// The radial factor of a fisheye, and the derivative of the distorted radius with respect to r.
    fn fisheye(&self, r: f64) -> [f64; 2] {
        let (lens, angle) = (self.kannala_brandt(), r.atan());
        let factor = if r > 1e-8 { lens.radius(angle) / r } else { 1.0 };
        [factor, lens.slope(angle) / (1.0 + r * r)]
    }

    /// The fisheye polynomial of an angle.
    fn kannala_brandt(&self) -> KannalaBrandt {
        KannalaBrandt { coefficients: [self.k1, self.k2, self.k3, self.k4] }
    }

    /// All coefficients.
    fn coefficients(&self) -> [f64; 8] {
        let Self { k1, k2, k3, k4, k5, k6, p1, p2, .. } = *self;
        [k1, k2, k3, k4, k5, k6, p1, p2]
    }
}

/// The intrinsics of a photograph in a dataset, before undistortion.
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
    /// The longest plausible side; more indicates a corrupt file.
    pub const MAX_SIDE: u32 = 65_535;

    /// The camera model that renders this lens; `None` if there is none, and photographs are undistorted.
    pub fn model(&self) -> Option<CameraModel> {
        match self.distortion {
            distortion if distortion == Distortion::default() => Some(CameraModel::Pinhole),
            distortion if distortion.is_fisheye => {
                Some(CameraModel::Fisheye(distortion.kannala_brandt()))
            }
            _ => None,
        }
    }

    /// The reason why the intrinsics are unusable; `None` if they are valid.
    pub fn problem(&self) -> Option<String> {
        let sides = 1..=Self::MAX_SIDE;
        if !sides.contains(&self.width) || !sides.contains(&self.height) {
            Some(format!("its size is {}x{}", self.width, self.height))
        } else if !(self.focal.is_finite() && self.focal.min_element() > 0.0) {
            Some(format!("its focal length is {}", self.focal))
        } else if !self.principal_point.is_finite() {
            Some(format!("its principal point is {}", self.principal_point))
        } else if !self.distortion.coefficients().iter().all(|value| value.is_finite()) {
            Some("its distortion is not finite".into())
        } else {
            None
        }
    }

    /// The lens for a photograph of `width` x `height`, which must have the same aspect ratio up to a pixel; else
    /// `None`.
    pub fn fitted(&self, width: u32, height: u32) -> Option<Self> {
        let listed = DVec2::new(f64::from(self.width), f64::from(self.height));
        let actual = DVec2::new(f64::from(width), f64::from(height));
        let scale = actual / listed;
        let visible = width > 0 && height > 0;
        let off_by = (listed * scale.max_element() - actual).abs().max_element();
        (visible && off_by <= scale.max_element().max(1.0)).then(|| self.scaled(width, height))
    }

    /// Whether it may be of the input of a network that works on patches of 14 pixels (`VGGT`).
    pub fn is_of_patches(&self) -> bool {
        [self.width, self.height].iter().all(|side| *side >= 224 && side.is_multiple_of(14))
    }

    /// The lens for a photograph of `width` x `height` that was resized to a network's input, each side rounded to
    /// patches; `None` if this is none, or the aspect ratio differs by more.
    pub fn fitted_from_patches(&self, width: u32, height: u32) -> Option<Self> {
        let listed = DVec2::new(f64::from(self.width), f64::from(self.height));
        let scale = DVec2::new(f64::from(width), f64::from(height)) / listed;
        let off_by = (listed * (1.0 - scale.yx() / scale)).abs().min_element();
        (width > 0 && height > 0 && self.is_of_patches() && off_by <= 7.0)
            .then(|| self.scaled(width, height))
    }

    /// The lens for the photograph at another size.
    fn scaled(&self, width: u32, height: u32) -> Self {
        let scale = DVec2::new(
            f64::from(width) / f64::from(self.width),
            f64::from(height) / f64::from(self.height),
        );
        Self {
            width,
            height,
            focal: self.focal * scale,
            principal_point: self.principal_point * scale,
            distortion: self.distortion,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: Distortion = Distortion {
        k1: 0.0,
        k2: 0.0,
        k3: 0.0,
        k4: 0.0,
        k5: 0.0,
        k6: 0.0,
        p1: 0.0,
        p2: 0.0,
        is_fisheye: false,
    };
    const MODELS: [(&str, Distortion); 5] = [
        ("OPENCV", Distortion { k1: -0.2, k2: 0.07, p1: 0.01, p2: -0.02, ..NONE }),
        (
            "FULL_OPENCV",
            Distortion {
                k1: 0.3,
                k2: -0.06,
                k3: 0.011,
                k4: 0.41,
                k5: 0.02,
                k6: -0.004,
                p1: 0.003,
                p2: -0.002,
                is_fisheye: false,
            },
        ),
        ("SIMPLE_RADIAL_FISHEYE", Distortion { k1: -0.03, is_fisheye: true, ..NONE }),
        ("RADIAL_FISHEYE", Distortion { k1: 0.04, k2: -0.013, is_fisheye: true, ..NONE }),
        (
            "OPENCV_FISHEYE",
            Distortion { k1: 0.05, k2: -0.02, k3: 0.006, k4: -0.001, is_fisheye: true, ..NONE },
        ),
    ];

    /// The distortion formulas of COLMAP's documentation and header (sensor/models.h).
    fn published(model: &str, d: Distortion, u: f64, v: f64) -> DVec2 {
        let (u2, v2, uv) = (u.powi(2), v.powi(2), u * v);
        let r = (u2 + v2).sqrt();
        let theta = r.atan2(1.0);
        let along = |thetad: f64| DVec2::new(u * thetad / r, v * thetad / r);
        let tangential = DVec2::new(
            2.0 * d.p1 * uv + d.p2 * (r * r + 2.0 * u2),
            2.0 * d.p2 * uv + d.p1 * (r * r + 2.0 * v2),
        );
        match model {
            "OPENCV" => {
                let radial = d.k1 * r.powi(2) + d.k2 * r.powi(4);
                DVec2::new(u + u * radial, v + v * radial) + tangential
            }
            "FULL_OPENCV" => {
                let radial = (1.0 + d.k1 * r.powi(2) + d.k2 * r.powi(4) + d.k3 * r.powi(6))
                    / (1.0 + d.k4 * r.powi(2) + d.k5 * r.powi(4) + d.k6 * r.powi(6));
                DVec2::new(u * radial, v * radial) + tangential
            }
            "SIMPLE_RADIAL_FISHEYE" => along(theta * (1.0 + d.k1 * theta.powi(2))),
            "RADIAL_FISHEYE" => along(theta * (1.0 + d.k1 * theta.powi(2) + d.k2 * theta.powi(4))),
            _ => along(
                theta
                    * (1.0
                        + d.k1 * theta.powi(2)
                        + d.k2 * theta.powi(4)
                        + d.k3 * theta.powi(6)
                        + d.k4 * theta.powi(8)),
            ),
        }
    }

    /// The undistorted position by Newton's method with central differences, independent of the code under test.
    fn unprojected(model: &str, distortion: Distortion, target: DVec2) -> DVec2 {
        let forward = |at: DVec2| published(model, distortion, at.x, at.y);
        // Along the ray first: a fisheye's tangents are unbounded.
        let mut at = target * 1.0001;
        let (mut low, mut high) = (0.0_f64, 400.0_f64);
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            let reaches = forward(middle * target.normalize()).length() < target.length();
            *(if reaches { &mut low } else { &mut high }) = middle;
            at = middle * target.normalize();
        }
        for _ in 0..20 {
            let step = 1e-6 * at.length().max(1e-3);
            let slope = |axis: DVec2| {
                (forward(at + step * axis) - forward(at - step * axis)) / (2.0 * step)
            };
            let jacobian = glam::DMat2::from_cols(slope(DVec2::X), slope(DVec2::Y));
            at -= jacobian.inverse() * (forward(at) - target);
        }
        at
    }

    #[test]
    fn every_model_projects_as_published_by_colmap_and_is_inverted() {
        for (model, distortion) in MODELS {
            // A fisheye up to 85 degrees off the axis, the others as far as their polynomials increase.
            let angles: &[f64] = if distortion.is_fisheye {
                &[0.5, 10.0, 30.0, 45.0, 60.0, 75.0, 85.0]
            } else {
                &[0.5, 10.0, 20.0, 30.0, 38.0]
            };
            for (angle, turn) in angles.iter().flat_map(|a| [0.0, 0.7, 2.5, 4.0].map(|t| (a, t))) {
                let at = angle.to_radians().tan() * DVec2::from_angle(turn);
                let shown = distortion.distort(at);
                let expected = published(model, distortion, at.x, at.y);
                assert!(
                    shown.distance(expected) < 1e-12,
                    "{model} at {angle}: {shown}, {expected}"
                );
                let back = unprojected(model, distortion, shown);
                let off = back.distance(at) / at.length();
                assert!(off < 1e-9, "{model} at {angle} degrees comes back off by {off}");
                assert!(distortion.determinant(at) > 0.0, "{model} folds at {angle} degrees");
            }
        }
    }

    #[test]
    fn the_determinant_is_that_of_the_jacobian() {
        let step = 1e-6;
        for (name, distortion) in MODELS {
            for at in [DVec2::new(0.4, -0.3), DVec2::new(0.0, 0.9), DVec2::new(1e-9, 0.0)] {
                let slope = |axis: DVec2| {
                    (distortion.distort(at + step * axis) - distortion.distort(at - step * axis))
                        / (2.0 * step)
                };
                let numeric = slope(DVec2::X).perp_dot(slope(DVec2::Y));
                let analytic = distortion.determinant(at);
                assert!(
                    (analytic - numeric).abs() < 1e-8,
                    "{name} at {at}: {analytic}, not {numeric}"
                );
            }
        }
    }

    #[test]
    fn a_lens_only_fits_a_photograph_of_its_aspect_ratio() {
        let distortion = Distortion { k1: 0.1, ..Distortion::default() };
        let (focal, principal_point) = (DVec2::new(500.0, 510.0), DVec2::new(240.0, 190.0));
        let lens = Lens { width: 500, height: 375, focal, principal_point, distortion };
        assert_eq!(lens.fitted(500, 375), Some(lens));
        assert_eq!(lens.fitted(250, 188).map(|half| half.width), Some(250));
        assert_eq!(lens.fitted(1000, 750).map(|double| double.focal.x), Some(1000.0));
        for (width, height) in [(375, 500), (400, 375), (500, 380), (0, 0)] {
            assert_eq!(lens.fitted(width, height), None, "{width}x{height}");
        }
        let patches = Lens { width: 518, height: 392, ..lens };
        let fitted = patches.fitted_from_patches(500, 375).unwrap();
        assert_eq!((fitted.width, fitted.height), (500, 375));
        assert!((fitted.focal.y - 510.0 * 375.0 / 392.0).abs() < 1e-9, "{fitted:?}");
        assert_eq!(patches.fitted(500, 375).or(lens.fitted_from_patches(500, 380)), None);
        let padded = Lens { height: 518, ..patches };
        assert_eq!(padded.fitted_from_patches(500, 375), None);
    }

    #[test]
    fn invalid_intrinsics_are_detected() {
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
