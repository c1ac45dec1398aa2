//! One order of depth for the views of a draw: what is nearer to one eye is nearer to the other, as both look almost
//! the same way.

use glam::{DVec3, DVec4};
use nightsplat_core::camera::{Camera, CameraModel};

use crate::{Error, Result};

/// The depth by which the Gaussians of a view are sorted.
#[derive(Clone, Copy, Debug)]
pub(super) enum DepthOrder {
    /// Their own in the view.
    Own,
    /// That of several views.
    Shared {
        /// Its dot product with (point in the view, 1) is the depth.
        axis: [f32; 4],
        /// An earlier view of the draw has sorted them.
        is_kept: bool,
    },
}

impl DepthOrder {
    /// Of each of the cameras of a draw that share one sort.
    pub(super) fn shared(cameras: &[Camera]) -> impl Iterator<Item = Self> {
        let axis = mean_axis(cameras);
        let centers = || cameras.iter().map(|camera| camera.view_from_world.inverse().translation);
        let middle = centers().sum::<DVec3>() / cameras.len().max(1) as f64;
        cameras.iter().zip(centers()).enumerate().map(move |(at, (camera, center))| {
            let turned = camera.view_from_world.transform_vector3(axis);
            let axis = turned.extend(axis.dot(center - middle)).as_vec4().to_array();
            Self::Shared { axis, is_kept: at > 0 }
        })
    }

    pub(super) fn is_shared(self) -> bool {
        matches!(self, Self::Shared { .. })
    }

    pub(super) fn is_kept(self) -> bool {
        matches!(self, Self::Shared { is_kept: true, .. })
    }

    /// As the kernel takes it.
    pub(super) fn axis(self) -> [f32; 4] {
        match self {
            Self::Own => DVec4::Z.as_vec4().to_array(),
            Self::Shared { axis, .. } => axis,
        }
    }
}

/// The direction in the world in which a camera looks.
fn axis(camera: &Camera) -> DVec3 {
    camera.view_from_world.matrix3.row(2)
}

fn mean_axis(cameras: &[Camera]) -> DVec3 {
    cameras.iter().map(axis).sum::<DVec3>().normalize_or_zero()
}

/// Farther off the mean, much of what a camera sees may have no depth along it.
const LARGEST_ANGLE: f64 = 30.0;

/// Refuses cameras that cannot share a sort.
pub(super) fn check_axes(cameras: &[Camera]) -> Result<()> {
    let mean = mean_axis(cameras);
    for (index, camera) in cameras.iter().enumerate() {
        if matches!(camera.model, CameraModel::Fisheye(_)) {
            return Err(Error::Usage(format!(
                "camera {index} is a fisheye, which is sorted by distance; draw without one sort"
            )));
        }
        // Of opposite axes there is no mean.
        let degrees = axis(camera).angle_between(mean).to_degrees();
        let degrees = if degrees.is_nan() { 180.0 } else { degrees };
        if degrees > LARGEST_ANGLE {
            return Err(Error::Usage(format!(
                "camera {index} looks {degrees:.0} degrees beside the mean of all, and one sort is for at most \
                 {LARGEST_ANGLE:.0}; draw without one sort"
            )));
        }
    }
    Ok(())
}
