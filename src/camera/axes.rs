//! What the axes of a scene's cameras tell: which way is up, and what they look at.

use glam::{DMat3, DVec3};

use super::Camera;

/// The optical axis, in the world.
pub(super) fn forward(pose: &Camera) -> DVec3 {
    pose.view_from_world.matrix3.row(2)
}

/// What is up in the image, in the world; an image's y points down.
pub(super) fn up(pose: &Camera) -> DVec3 {
    -pose.view_from_world.matrix3.row(1)
}

pub(super) fn mean(vectors: impl ExactSizeIterator<Item = DVec3>) -> DVec3 {
    let count = vectors.len().max(1) as f64;
    vectors.sum::<DVec3>() / count
}

/// What is up in the world, a unit vector, for cameras that are held level: across all their horizontal axes, on the
/// side of their mean. The mean of cameras on one side that look down would lean.
pub(crate) fn upwards(poses: &[Camera]) -> DVec3 {
    let mut horizontal = DMat3::from_diagonal(DVec3::splat(1e-6));
    for pose in poses {
        let right = pose.view_from_world.matrix3.row(0);
        let axes = [right * right.x, right * right.y, right * right.z];
        horizontal += DMat3::from_cols(axes[0], axes[1], axes[2]) * (1.0 / poses.len() as f64);
    }
    // Inverse iteration: what the axes have least of is left.
    let (inverse, mut up) = (horizontal.inverse(), mean(poses.iter().map(up)));
    for _ in 0..8 {
        up = (inverse * up).normalize_or(DVec3::NEG_Y);
    }
    up
}

/// The point with the least squared distances to the optical axes; `None` where they are as good as parallel.
pub(super) fn nearest_to_axes(poses: &[Camera]) -> Option<DVec3> {
    /// Less of the cameras' turns says nothing of a distance.
    const MIN_DETERMINANT: f64 = 1e-6;
    let (mut matrix, mut vector) = (DMat3::ZERO, DVec3::ZERO);
    for pose in poses {
        let axis = forward(pose);
        let across =
            DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        matrix += across;
        vector += across * pose.center();
    }
    let matrix = matrix * (1.0 / poses.len() as f64);
    let is_definite = matrix.determinant() > MIN_DETERMINANT;
    is_definite.then(|| matrix.inverse() * (vector / poses.len() as f64))
}
