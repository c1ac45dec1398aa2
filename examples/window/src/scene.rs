//! What is in front of the camera: the boxes of the host, around the splats.

use std::f64::consts::FRAC_PI_2;

use nightsplat::Camera;
use nightsplat::glam::{DAffine3, DMat3, DVec3, Vec3};

/// The near plane of the host's depth, in radii of the model.
const NEAR: f64 = 0.01;
/// Vertical field of view, radians.
const FIELD_OF_VIEW: f64 = 0.87;

/// A box along the world's axes. Its faces along x, y and z have 1.0, 0.8 and 0.6 of the colour.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block {
    pub(crate) center: DVec3,
    pub(crate) half_size: DVec3,
    pub(crate) color: Vec3,
}

/// The place of a model, and which way is up there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scene {
    center: DVec3,
    /// The root of the mean square of the distances from the centre.
    radius: f64,
    /// The directions right, forward and up: an axis of the world each, so that a box of the scene is one of the world.
    axes: DMat3,
}

impl Scene {
    /// Around Gaussians with these means. Up is the world's z, or against its y, as in models from COLMAP.
    pub(crate) fn around(means: &[Vec3], is_y_down: bool) -> Self {
        let count = means.len().max(1) as f64;
        let center = means.iter().map(|mean| DVec3::from(*mean)).sum::<DVec3>() / count;
        let square = |mean: &Vec3| DVec3::from(*mean).distance_squared(center);
        let radius = (means.iter().map(square).sum::<f64>() / count).sqrt().max(1e-3);
        let axes = match is_y_down {
            true => DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y),
            false => DMat3::IDENTITY,
        };
        Self { center, radius, axes }
    }

    /// The near plane, world units.
    pub(crate) fn near(&self) -> f64 {
        NEAR * self.radius
    }

    /// A ground below the model, a wall across its left half, a pillar through its right half. None of their shades is
    /// half-way between two bytes, which devices round to either.
    pub(crate) fn blocks(&self) -> [Block; 3] {
        let block = |center: [f64; 3], half_size: [f64; 3], color: [f32; 3]| Block {
            center: self.center + self.radius * (self.axes * DVec3::from(center)),
            half_size: self.radius * (self.axes * DVec3::from(half_size)).abs(),
            color: color.into(),
        };
        [
            block([0.0, 0.0, -1.8], [4.0, 4.0, 0.1], [0.45, 0.51, 0.57]),
            block([-1.6, 0.0, -0.4], [1.5, 0.1, 1.3], [0.77, 0.27, 0.23]),
            block([0.8, 0.1, -0.5], [0.2, 0.2, 1.2], [0.27, 0.73, 0.45]),
        ]
    }
}

/// A camera that looks at the centre of a scene, which the mouse turns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Orbit {
    yaw: f64,
    pitch: f64,
    /// From the centre, in radii.
    distance: f64,
}

impl Default for Orbit {
    fn default() -> Self {
        Self { yaw: 0.2, pitch: 0.2, distance: 4.0 }
    }
}

impl Orbit {
    /// By a drag of this many pixels.
    pub(crate) fn turn(&mut self, right: f64, down: f64) {
        self.yaw -= 0.005 * right;
        self.pitch = (self.pitch + 0.005 * down).clamp(0.01 - FRAC_PI_2, FRAC_PI_2 - 0.01);
    }

    /// By this many notches of the wheel.
    pub(crate) fn approach(&mut self, notches: f64) {
        self.distance = (self.distance * 0.9f64.powf(notches)).clamp(0.1, 100.0);
    }

    /// The library's cameras have x right, y down and z forward, which is also Vulkan's clip space.
    pub(crate) fn camera(&self, scene: &Scene, size: [u32; 2]) -> Camera {
        let ((sin, cos), (rise, run)) = (self.yaw.sin_cos(), self.pitch.sin_cos());
        let up = scene.axes * DVec3::Z;
        let forward = scene.axes * DVec3::new(-sin * run, cos * run, -rise);
        let right = forward.cross(up).normalize();
        let world_from_view = DMat3::from_cols(right, forward.cross(right), forward);
        let eye = scene.center - self.distance * scene.radius * forward;
        let view_from_world = DAffine3 { matrix3: world_from_view, translation: eye }.inverse();
        Camera::perspective(view_from_world, FIELD_OF_VIEW, size)
    }
}
