//! The orthographic camera of `include/camera_orthographic.glsl`, in f64.

use glam::DVec3;

use super::ImagePoint;

pub(super) fn image_point(point: DVec3) -> ImagePoint {
    ImagePoint { at: point.truncate(), jacobian: [DVec3::X, DVec3::Y] }
}
