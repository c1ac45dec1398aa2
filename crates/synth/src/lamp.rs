//! A lamp that is fixed to the camera: a headlamp, or the torch of a phone.
//!
//! A small source with the inverse-square law, a Gaussian beam, Lambert's cosine and shadows, beside the lens and
//! slightly tilted: light as it is, rather than the formula that a model fits to it.

use glam::DVec3;
use nightsplat_core::camera::Camera;

/// Where the lamp is: right of the lens and above it, in world units along the camera's axes (right, down, forward).
const OFFSET: DVec3 = DVec3::new(0.05, -0.09, 0.0);

/// The direction of its axis along the camera's axes, not normalised.
const AXIS: DVec3 = DVec3::new(-0.02, 0.04, 1.0);

/// The distance at which the irradiance on the axis is [`COLOUR`].
const REACH: f64 = 2.5;

/// The lamp's light on a surface that faces it at the reach.
const COLOUR: DVec3 = DVec3::new(0.96, 0.98, 1.0);

/// The fraction of the scene's own light that is there beside the lamp.
pub(super) const AMBIENT: f64 = 0.004;

/// The light of the references: the mean of the room's own, and the same on every surface, from all sides. Shading and
/// shadows of a light that no photograph shows could not be known.
pub(super) const EVEN: f64 = 0.58;

/// The lamp of a camera, in the world.
pub(super) struct CameraLamp {
    position: DVec3,
    axis: DVec3,
    /// The angle off the axis at which the light is half as strong, radians.
    half_angle: f64,
}

/// The light of the lamp on a surface.
pub(super) struct LampLight {
    /// The unit vector to the lamp.
    pub(super) to_lamp: DVec3,
    /// What the lamp sends towards the surface, as on a surface that faces it.
    pub(super) radiance: DVec3,
    /// The cosine of the angle between the normal and the direction to the lamp.
    pub(super) cosine: f64,
}

impl CameraLamp {
    /// The lamp of a camera, of half its strength this many degrees off its axis.
    pub(super) fn new(camera: &Camera, degrees: f64) -> Self {
        let world_from_view = camera.view_from_world.inverse();
        Self {
            position: world_from_view.transform_point3(OFFSET),
            axis: world_from_view.transform_vector3(AXIS).normalize(),
            half_angle: degrees.to_radians(),
        }
    }

    /// Its light at a position; `None` on a surface that faces away. `is_clear` says whether nothing is between a
    /// position and another one at a distance in a direction.
    pub(super) fn light(
        &self,
        position: DVec3,
        normal: DVec3,
        is_clear: impl Fn(DVec3, DVec3, f64) -> bool,
    ) -> Option<LampLight> {
        let start = position + 1e-6 * normal;
        let distance = start.distance(self.position);
        let to_lamp = (self.position - start) / distance;
        let cosine = normal.dot(to_lamp);
        if cosine <= 0.0 || !is_clear(start, to_lamp, distance) {
            return None;
        }
        let off_axis = (-self.axis.dot(to_lamp)).clamp(-1.0, 1.0).acos() / self.half_angle;
        let beam = (-off_axis * off_axis).exp2();
        Some(LampLight { to_lamp, radiance: COLOUR * beam * (REACH / distance).powi(2), cosine })
    }
}
