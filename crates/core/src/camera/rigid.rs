//! Poses that are a rotation and a translation.

use glam::{DAffine3, DMat3};

/// The largest deviation at which a pose still counts as rigid.
const MAX_DEVIATION: f64 = 1e-3;

/// The deviation of a pose from a rotation and a translation, if it is too large: the largest entry of R R^T - I, or
/// infinity if the pose mirrors or is not finite.
pub fn deviation_from_rigid(pose: &DAffine3) -> Option<f64> {
    if !pose.is_finite() || pose.matrix3.determinant() < 0.0 {
        return Some(f64::INFINITY);
    }
    let off = pose.matrix3 * pose.matrix3.transpose() - DMat3::IDENTITY;
    let deviation = off.to_cols_array().into_iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    (deviation > MAX_DEVIATION).then_some(deviation)
}
