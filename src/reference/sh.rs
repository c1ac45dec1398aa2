//! Real spherical harmonics to degree 3, as `include/sh.glsl` has them, in f64.

use glam::DVec3;

const C0: f64 = 0.282_094_791_773_878_14;
const C1: f64 = 0.488_602_511_902_919_9;
const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Coefficients per colour up to a degree.
pub fn sh_count(degree: u32) -> usize {
    (degree as usize + 1).pow(2)
}

/// The basis in the unit direction `d`; entries above `degree` are zero.
pub fn sh_basis(degree: u32, d: DVec3) -> [f64; 16] {
    let [x, y, z] = d.to_array();
    let mut basis = [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        C2[1] * y * z,
        C2[2] * (2.0 * z * z - x * x - y * y),
        C2[3] * x * z,
        C2[4] * (x * x - y * y),
        C3[0] * y * (3.0 * x * x - y * y),
        C3[1] * x * y * z,
        C3[2] * y * (4.0 * z * z - x * x - y * y),
        C3[3] * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
        C3[4] * x * (4.0 * z * z - x * x - y * y),
        C3[5] * z * (x * x - y * y),
        C3[6] * x * (x * x - 3.0 * y * y),
    ];
    basis[sh_count(degree)..].fill(0.0);
    basis
}

/// The derivative of the basis with respect to x, y, z of the direction.
pub fn sh_basis_gradient(degree: u32, d: DVec3) -> [DVec3; 16] {
    let [x, y, z] = d.to_array();
    let v = DVec3::new;
    let mut gradient = [
        DVec3::ZERO,
        v(0.0, -C1, 0.0),
        v(0.0, 0.0, C1),
        v(-C1, 0.0, 0.0),
        C2[0] * v(y, x, 0.0),
        C2[1] * v(0.0, z, y),
        C2[2] * v(-2.0 * x, -2.0 * y, 4.0 * z),
        C2[3] * v(z, 0.0, x),
        C2[4] * v(2.0 * x, -2.0 * y, 0.0),
        C3[0] * v(6.0 * x * y, 3.0 * (x * x - y * y), 0.0),
        C3[1] * v(y * z, x * z, x * y),
        C3[2] * v(-2.0 * x * y, 4.0 * z * z - x * x - 3.0 * y * y, 8.0 * y * z),
        C3[3] * v(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * (x * x + y * y)),
        C3[4] * v(4.0 * z * z - 3.0 * x * x - y * y, -2.0 * x * y, 8.0 * x * z),
        C3[5] * v(2.0 * x * z, -2.0 * y * z, x * x - y * y),
        C3[6] * v(3.0 * (x * x - y * y), -6.0 * x * y, 0.0),
    ];
    gradient[sh_count(degree)..].fill(DVec3::ZERO);
    gradient
}
