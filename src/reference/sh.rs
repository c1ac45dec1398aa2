//! Real spherical harmonics to degree 3 and their derivatives, as in `include/sh.glsl`, in f64.

use glam::DVec3;
pub use nightsplat_models::harmonics::{sh_basis, sh_count};

use crate::kernels::sh::{SH_C1, SH_C2, SH_C3};

/// The derivative of the basis with respect to x, y, z of the direction.
pub fn sh_basis_gradient(degree: u32, d: DVec3) -> [DVec3; 16] {
    let [x, y, z] = d.to_array();
    let v = DVec3::new;
    let mut gradient = [
        DVec3::ZERO,
        v(0.0, -SH_C1, 0.0),
        v(0.0, 0.0, SH_C1),
        v(-SH_C1, 0.0, 0.0),
        SH_C2[0] * v(y, x, 0.0),
        SH_C2[1] * v(0.0, z, y),
        SH_C2[2] * v(-2.0 * x, -2.0 * y, 4.0 * z),
        SH_C2[3] * v(z, 0.0, x),
        SH_C2[4] * v(2.0 * x, -2.0 * y, 0.0),
        SH_C3[0] * v(6.0 * x * y, 3.0 * (x * x - y * y), 0.0),
        SH_C3[1] * v(y * z, x * z, x * y),
        SH_C3[2] * v(-2.0 * x * y, 4.0 * z * z - x * x - 3.0 * y * y, 8.0 * y * z),
        SH_C3[3] * v(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * (x * x + y * y)),
        SH_C3[4] * v(4.0 * z * z - 3.0 * x * x - y * y, -2.0 * x * y, 8.0 * x * z),
        SH_C3[5] * v(2.0 * x * z, -2.0 * y * z, x * x - y * y),
        SH_C3[6] * v(3.0 * (x * x - y * y), -6.0 * x * y, 0.0),
    ];
    gradient[sh_count(degree)..].fill(DVec3::ZERO);
    gradient
}
