//! The up direction and the focus of a scene, estimated from the axes of its cameras.

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

/// What is up in the world, a unit vector: as perpendicular as can be to the horizontal axes of the cameras, which are
/// held level. The mean of what is up in the images leans where cameras on one side of a scene are pitched. It decides
/// if all cameras look in one direction: their axes then do not determine the pitch.
pub fn upwards(poses: &[Camera]) -> DVec3 {
    /// The squared ratio of the angles by which cameras are rolled and pitched: 2 degrees and 30.
    const ROLL_TO_PITCH: f64 = 0.005;
    /// The variance of the sines of their azimuths from which on their axes decide alone: 6 degrees squared.
    const ENOUGH: f64 = 0.01;
    let right = |pose: &Camera| pose.view_from_world.matrix3.row(0);
    let squared = |axis: DVec3| DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
    let in_images = mean(poses.iter().map(up)).normalize_or(DVec3::NEG_Y);
    let across = mean(poses.iter().map(right)).cross(in_images).normalize_or_zero();
    let azimuths = poses.iter().map(|pose| right(pose).dot(across).powi(2)).sum::<f64>();
    let share = (1.0 - azimuths / poses.len().max(1) as f64 / ENOUGH).max(0.0);
    let mut cost = (DMat3::IDENTITY - squared(in_images)) * (ROLL_TO_PITCH * share);
    for pose in poses {
        cost += squared(right(pose)) * (1.0 / poses.len() as f64);
    }
    // Inverse iteration: the direction of the least cost is left.
    let inverse = (cost + DMat3::from_diagonal(DVec3::splat(1e-6))).inverse();
    let mut upwards = in_images;
    for _ in 0..16 {
        upwards = (inverse * upwards).normalize_or(in_images);
    }
    upwards
}

/// The point with the least squared distances to the optical axes; `None` if they are nearly parallel.
pub(super) fn nearest_to_axes(poses: &[Camera]) -> Option<DVec3> {
    /// Below it, the axes are too close to parallel to determine a distance.
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

/// The sphere that contains the cameras: around the point nearest to their axes if at least three quarters of them
/// face it, else around their mean. The radius is 0 if they all stand in one place.
pub fn enclosing_sphere(poses: &[Camera]) -> (DVec3, f64) {
    let faces = |target: DVec3| {
        let facing = poses.iter().filter(|pose| forward(pose).dot(target - pose.center()) > 0.0);
        4 * facing.count() >= 3 * poses.len()
    };
    let focus = nearest_to_axes(poses).filter(|&focus| faces(focus));
    let center = focus.unwrap_or_else(|| mean(poses.iter().map(Camera::center)));
    let distances = poses.iter().map(|pose| pose.center().distance(center));
    (center, distances.fold(0.0, f64::max))
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DQuat};

    use super::*;

    /// Cameras at azimuths, pitched down and rolled by angles in degrees, in a world whose z is up.
    fn cameras(held: impl Iterator<Item = [f64; 3]>) -> Vec<Camera> {
        let level = DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y);
        let camera = |[azimuth, pitch, roll]: [f64; 3]| {
            let about_z = DMat3::from_rotation_z(azimuth.to_radians());
            let pitched = DMat3::from_rotation_x(-pitch.to_radians());
            let rolled = DMat3::from_rotation_z(roll.to_radians());
            let view_from_world = (about_z * level * pitched * rolled).transpose();
            Camera::perspective(DAffine3::from_mat3(view_from_world), 0.9, [60, 40])
        };
        held.map(camera).collect()
    }

    fn off(poses: &[Camera]) -> f64 {
        upwards(poses).angle_between(DVec3::Z).to_degrees()
    }

    /// From -1 to 1, without a pattern.
    fn shake(index: u32) -> f64 {
        (f64::from(index) * 12.9898).sin()
    }

    #[test]
    fn cameras_on_one_side_that_are_pitched_down_do_not_lean() {
        let arc = cameras((0..21).map(|i| [3.0 * f64::from(i) - 30.0, 40.0, shake(i)]));
        let leaning = mean(arc.iter().map(up)).angle_between(DVec3::Z).to_degrees();
        assert!(leaning > 35.0 && off(&arc) < 3.0, "{leaning} {}", off(&arc));
        let turned = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.2, 2.0);
        let elsewhere = |pose: &Camera| Camera {
            view_from_world: pose.view_from_world * DAffine3::from_quat(turned),
            ..*pose
        };
        let elsewhere: Vec<Camera> = arc.iter().map(elsewhere).collect();
        let expected = turned.inverse() * upwards(&arc);
        assert!(upwards(&elsewhere).angle_between(expected) < 1e-6);
    }

    #[test]
    fn cameras_that_look_one_way_have_what_is_up_in_their_images() {
        // Shake of the hand does not determine the pitch.
        let row = cameras((0..20).map(|i| [shake(i), shake(i + 40), 2.0 * shake(i + 80)]));
        assert!(off(&row) < 5.0, "{}", off(&row));
        let one = cameras([[20.0, 10.0, 0.0]].into_iter());
        assert!((off(&one) - 10.0).abs() < 1e-6, "{}", off(&one));
        assert!(upwards(&[]).is_finite());
    }
}
