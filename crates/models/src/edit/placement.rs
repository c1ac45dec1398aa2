//! Where an edited model is in the world of its dataset.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use nightsplat_core::camera::{Camera, TrainingFrame};

/// A similarity: a point of the dataset's world is at `scale * rotation * point + translation` of the edited one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Above 0.
    pub scale: f64,
    /// A unit quaternion.
    pub rotation: DQuat,
    /// In the edited world.
    pub translation: DVec3,
}

impl Placement {
    /// The dataset's world.
    pub const IDENTITY: Self =
        Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Scales the edited world about its origin.
    pub fn scale(&mut self, factor: f64) {
        self.scale *= factor;
        self.translation *= factor;
    }

    /// Rotates the edited world about its origin.
    pub fn rotate(&mut self, rotation: DQuat) {
        self.rotation = (rotation * self.rotation).normalize();
        self.translation = rotation * self.translation;
    }

    /// Moves the edited world.
    pub fn translate(&mut self, by: DVec3) {
        self.translation += by;
    }

    /// A point of the dataset's world in the edited one.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// A camera of the dataset in the edited world; its image is the same.
    pub fn camera(&self, camera: &Camera) -> Camera {
        if *self == Self::IDENTITY {
            return *camera;
        }
        let DAffine3 { matrix3, translation } = camera.view_from_world;
        let matrix3 = matrix3 * DMat3::from_quat(self.rotation.inverse());
        let translation = self.scale * translation - matrix3 * self.translation;
        Camera { view_from_world: DAffine3 { matrix3, translation }, ..*camera }
    }

    /// The frame in which the edited model has the size that the model has in `frame`.
    pub fn frame(&self, frame: &TrainingFrame) -> TrainingFrame {
        if *self == Self::IDENTITY {
            return *frame;
        }
        TrainingFrame {
            center: self.point(DVec3::from_array(frame.center)).to_array(),
            scale: frame.scale / self.scale,
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    #[test]
    fn a_camera_sees_the_same_point_in_the_same_place_of_the_edited_world() {
        let pose = DAffine3::from_rotation_translation(
            DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 0.7),
            DVec3::new(0.3, -0.2, 4.0),
        );
        let camera = Camera::perspective(pose, 0.9, [64, 48]);
        let mut placement = Placement::IDENTITY;
        placement.rotate(DQuat::from_axis_angle(DVec3::new(1.0, -1.0, 2.0).normalize(), 0.646));
        placement.translate(DVec3::new(10.0, -3.0, 0.5));
        placement.scale(0.25);
        placement.rotate(DQuat::from_rotation_x(1.0));
        let moved = placement.camera(&camera);
        for point in [DVec3::new(0.1, 0.2, 0.3), DVec3::new(-1.0, 0.5, 0.0)] {
            let [before, other] =
                [camera.project(point), moved.project(placement.point(point))].map(Option::unwrap);
            assert!(before.distance(other) < 1e-9, "{before} {other}");
            assert!(before != DVec2::ZERO);
            let [near, far] = [camera.depth(point), moved.depth(placement.point(point))];
            assert!((near.unwrap() * 0.25 - far.unwrap()).abs() < 1e-12);
        }
        let frame = TrainingFrame { center: [1.0, 2.0, 3.0], scale: 4.0 };
        let placed = placement.frame(&frame);
        assert_eq!(
            (placed.scale, placed.framed(placement.point(DVec3::new(1.0, 2.0, 3.0)))),
            (16.0, DVec3::ZERO)
        );
    }
}
