//! Cameras as the kernels take them.

use glam::{DAffine3, DVec2};
use nightsplat_core::camera::{CameraModel, Patch};

use crate::kernels;
use crate::kernels::camera::{CAMERA_FISHEYE, CAMERA_ORTHOGRAPHIC, CAMERA_PINHOLE};
use crate::kernels::camera_pinhole::JACOBIAN_MARGIN;

/// The patch as the kernels take it: a camera with a shifted principal point.
impl From<&Patch> for kernels::Camera {
    fn from(patch: &Patch) -> Self {
        let DAffine3 { matrix3: rotation, translation } = patch.camera.view_from_world;
        let columns = [rotation.x_axis, rotation.y_axis, rotation.z_axis, translation];
        let [focal, principal_point] =
            [patch.camera.focal, patch.camera.principal_point].map(|at: DVec2| at.as_vec2());
        let whole = Patch::from(&patch.camera).size.as_vec2();
        let margin = JACOBIAN_MARGIN as f32 * whole;
        let (distortion, largest_angle) = match patch.camera.model {
            CameraModel::Pinhole | CameraModel::Orthographic => ([0.0; 4], 0.0),
            CameraModel::Fisheye(lens) => {
                (lens.coefficients.map(|k| k as f32), lens.largest_angle() as f32)
            }
        };
        Self {
            view_from_world: columns.map(|column| column.as_vec3().to_array()),
            focal,
            principal_point: patch.own_camera().principal_point.as_vec2(),
            size: patch.size,
            min_slope: -(principal_point + margin) / focal,
            max_slope: (whole - principal_point + margin) / focal,
            distortion,
            largest_angle,
            model: model_number(&patch.camera.model),
        }
    }
}

/// The number of the camera model in kernels.
pub(crate) fn model_number(model: &CameraModel) -> u32 {
    match model {
        CameraModel::Pinhole => CAMERA_PINHOLE,
        CameraModel::Fisheye(_) => CAMERA_FISHEYE,
        CameraModel::Orthographic => CAMERA_ORTHOGRAPHIC,
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, Vec2};
    use nightsplat_core::camera::Camera;

    use super::*;

    #[test]
    fn a_patch_takes_its_jacobian_as_far_as_the_whole_does() {
        let camera = Camera {
            width: 100,
            height: 60,
            focal: DVec2::new(80.0, 90.0),
            principal_point: DVec2::new(47.0, 33.0),
            model: CameraModel::Pinhole,
            view_from_world: DAffine3::from_translation(DVec3::new(0.5, 0.0, 2.0)),
        };
        let whole = kernels::Camera::from(&Patch::from(&camera));
        assert_eq!(whole.min_slope, Vec2::new(-62.0 / 80.0, -42.0 / 90.0));
        assert_eq!(whole.max_slope, Vec2::new(68.0 / 80.0, 36.0 / 90.0));
        assert_eq!(Patch::from(&camera).half_view(), Vec2::new(50.0, 30.0));
        let patches = camera.patches(|size| size.x <= 50);
        let right = kernels::Camera::from(&patches[1]);
        assert_eq!((right.min_slope, right.max_slope), (whole.min_slope, whole.max_slope));
        assert_eq!(right.principal_point, Vec2::new(-3.0, 33.0));
        assert_eq!(patches[1].half_view(), Vec2::new(25.0, 15.0));
    }
}
