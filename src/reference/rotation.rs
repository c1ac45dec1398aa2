//! Quaternions (w, x, y, z) as in `include/rotation.glsl`, in f64.

use glam::{DMat3, DVec4};

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

/// A quaternion of unit length; the identity if the length is not a positive number.
pub fn unit_quat(q: DVec4) -> DVec4 {
    let norm = q.length();
    if norm > 1e-12 { q / norm } else { DVec4::X }
}
