//! Real spherical harmonics to degree 3 on the host, in f64, and their rotation.

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

/// The factors of the basis functions by degree, as in `include/sh.glsl`; 1 / (2 sqrt(pi)) is the constant one.
pub const SH_C0: f64 = 0.28209479177387814;
/// Of degree 1.
pub const SH_C1: f64 = 0.4886025119029199;
/// Of degree 2.
pub const SH_C2: [f64; 5] = [
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
];
/// Of degree 3.
pub const SH_C3: [f64; 7] = [
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
];

/// Coefficients per colour up to a degree.
pub fn sh_count(degree: u32) -> usize {
    (degree as usize + 1).pow(2)
}

/// The basis in the unit direction `d`; entries above `degree` are zero.
pub fn sh_basis(degree: u32, d: DVec3) -> [f64; 16] {
    let [x, y, z] = d.to_array();
    let mut basis = [
        SH_C0,
        -SH_C1 * y,
        SH_C1 * z,
        -SH_C1 * x,
        SH_C2[0] * x * y,
        SH_C2[1] * y * z,
        SH_C2[2] * (2.0 * z * z - x * x - y * y),
        SH_C2[3] * x * z,
        SH_C2[4] * (x * x - y * y),
        SH_C3[0] * y * (3.0 * x * x - y * y),
        SH_C3[1] * x * y * z,
        SH_C3[2] * y * (4.0 * z * z - x * x - y * y),
        SH_C3[3] * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
        SH_C3[4] * x * (4.0 * z * z - x * x - y * y),
        SH_C3[5] * z * (x * x - y * y),
        SH_C3[6] * x * (x * x - 3.0 * y * y),
    ];
    basis[sh_count(degree)..].fill(0.0);
    basis
}

/// Directions and weights of the integral over the sphere, exact for polynomials of degree 7: Gauss-Legendre quadrature
/// with four rings of eight directions.
pub fn quadrature() -> impl Iterator<Item = (DVec3, f64)> + Clone {
    const RINGS: [(f64, f64); 4] = [
        (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
        (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
        (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
        (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    ];
    const DIRECTIONS: u32 = 8;
    let ring = |(z, weight): (f64, f64)| {
        (0..DIRECTIONS).map(move |index| {
            let (sin, cos) = (TAU * f64::from(index) / f64::from(DIRECTIONS)).sin_cos();
            let ring = (1.0 - z * z).sqrt();
            (DVec3::new(ring * cos, ring * sin, z), weight * TAU / f64::from(DIRECTIONS))
        })
    };
    RINGS.into_iter().flat_map(ring)
}

/// The rotation of coefficients above degree 0: row k, column j is the contribution of coefficient j to the new
/// coefficient k. Degrees do not mix.
#[derive(Clone, Debug, PartialEq)]
pub struct HarmonicRotation([[f64; 15]; 15]);

impl HarmonicRotation {
    /// The matrix of a rotation of directions.
    ///
    /// The basis is orthonormal over the sphere, so an entry is the integral of the product of a rotated basis function
    /// and another one, polynomials of degree 6.
    pub fn new(rotation: DMat3) -> Self {
        let mut parts = [[0.0; 15]; 15];
        for (direction, weight) in quadrature() {
            let (turned, basis) = (sh_basis(3, rotation * direction), sh_basis(3, direction));
            for degree in 1..=3 {
                let own_degree = sh_count(degree - 1)..sh_count(degree);
                for k in own_degree.clone() {
                    for j in own_degree.clone() {
                        parts[k - 1][j - 1] += weight * turned[k] * basis[j];
                    }
                }
            }
        }
        Self(parts)
    }

    /// Rotates the coefficients above degree 0 of one Gaussian: 0, 3, 8 or 15.
    pub fn turn(&self, rest: &mut [glam::Vec3]) {
        let before: Vec<DVec3> = rest.iter().map(|value| value.as_dvec3()).collect();
        for (value, parts) in rest.iter_mut().zip(&self.0) {
            *value = before
                .iter()
                .zip(parts)
                .map(|(value, part)| *value * *part)
                .sum::<DVec3>()
                .as_vec3();
        }
    }
}

#[cfg(all(test, feature = "train"))]
mod tests {
    use glam::DQuat;
    use nalgebra::{DMatrix, DVector};

    use super::*;

    /// Another way to the same coefficients: those that fit the colours of the rotated directions by least squares.
    #[test]
    fn rotated_coefficients_are_those_that_fit_rotated_colours_by_least_squares() {
        let rotation = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 0.646);
        let directions: Vec<DVec3> = (0..60_u32)
            .map(|k| {
                // A spiral of even steps in z covers the sphere.
                let z = 1.0 - (2.0 * f64::from(k) + 1.0) / 60.0;
                let (sin, cos) = (2.4 * f64::from(k)).sin_cos();
                let ring = (1.0 - z * z).sqrt();
                DVec3::new(ring * cos, ring * sin, z)
            })
            .collect();
        let coefficients: Vec<f64> = (0..15).map(|k| ((k * k % 7) as f64 - 3.0) / 5.0).collect();
        let color = |direction: &DVec3| {
            let basis = sh_basis(3, rotation.inverse() * *direction);
            coefficients.iter().zip(&basis[1..]).map(|(c, b)| c * b).sum::<f64>()
        };
        let colors = DVector::from_iterator(60, directions.iter().map(color));
        let basis = |row: usize, column: usize| sh_basis(3, directions[row])[column + 1];
        let matrix = DMatrix::from_fn(60, 15, basis);
        let expected = matrix.svd(true, true).solve(&colors, 1e-12).unwrap();

        let mut turned: Vec<glam::Vec3> =
            coefficients.iter().map(|value| glam::Vec3::splat(*value as f32)).collect();
        HarmonicRotation::new(DMat3::from_quat(rotation)).turn(&mut turned);
        for (turned, expected) in turned.iter().zip(&expected) {
            assert!((f64::from(turned.x) - expected).abs() < 2e-7, "{turned} {expected}");
        }
    }
}
