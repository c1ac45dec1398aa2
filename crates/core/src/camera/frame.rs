//! The training frame: near the origin and of an extent near 2, whatever the world's scale and offset.
//!
//! ```text
//! position in the frame = (position in the world - center) * scale
//! ```
//!
//! The device computes in f32, which is most precise near zero; near plane, squared distances and initial sizes are
//! absolute. Therefore cameras and points are transformed into the frame on the host, in f64, and the trained model is
//! transformed back. The scale is a power of two, and a world near its origin is not moved, so that a world of an
//! extent of 1.5 to 3 is its own training frame, to the bit.

use std::ops::Bound;

use glam::{DAffine3, DVec3};

use super::Camera;
use crate::settings;
use crate::settings::Rule;

settings! {
"frame."
/// A translation and a uniform scale of the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingFrame {
    /// The origin of the training frame, in world coordinates.
    center: [f64; 3] = [0.0; 3], "found from the cameras, and recorded"
        => Rule::List(3, 3, &Rule::Number(Bound::Unbounded, Bound::Unbounded)), in "world units";
    /// Units of the training frame per world unit.
    scale: f64 = 1.0, "found from the cameras, and recorded"
        => Rule::Number(Bound::Included(f64::MIN_POSITIVE), Bound::Unbounded);
}
}

/// The extent of the scene in the training frame.
pub const FRAME_EXTENT: f64 = 2.0;

/// The frame is not translated if the world's origin is at most this many extents away: f32 loses three bits.
const NEAR_ORIGIN: f64 = 8.0;

/// From this many extents away from the origin, positions in f32 are 1e-5 of the extent apart: files store them
/// relative to another origin.
const FAR_FROM_ORIGIN: f64 = 64.0;

/// A camera this many times as far from the centre as the median is an outlier.
const OUTLIER: f64 = 32.0;

impl TrainingFrame {
    /// The world itself.
    #[doc(hidden)]
    pub const WORLD: Self = Self { center: [0.0; 3], scale: 1.0 };

    /// The training frame of cameras around `center` with an extent of `extent` world units.
    #[doc(hidden)]
    pub fn new(center: DVec3, extent: f64) -> Self {
        // The power of two that scales the extent to 0.75 to 1.5 times the frame's, within the range of invertible
        // scales.
        let octave = (0.75 * FRAME_EXTENT / extent).log2().ceil().clamp(-900.0, 900.0);
        let scale = octave.exp2();
        let is_near = center.abs().max_element() * scale <= NEAR_ORIGIN * FRAME_EXTENT;
        let center = if is_near { DVec3::ZERO } else { center };
        Self { center: center.to_array(), scale }
    }

    fn center(&self) -> DVec3 {
        DVec3::from_array(self.center)
    }

    /// From the world to the training frame.
    #[doc(hidden)]
    pub fn framed(&self, position: DVec3) -> DVec3 {
        (position - self.center()) * self.scale
    }

    /// From the training frame to the world.
    #[doc(hidden)]
    pub fn unframed(&self, position: DVec3) -> DVec3 {
        position / self.scale + self.center()
    }

    /// The camera in the training frame; its view space is scaled, too.
    #[doc(hidden)]
    pub fn camera(&self, camera: &Camera) -> Camera {
        if *self == Self::WORLD {
            return *camera;
        }
        let DAffine3 { matrix3, translation } = camera.view_from_world;
        let translation = (translation + matrix3 * self.center()) * self.scale;
        Camera { view_from_world: DAffine3 { matrix3, translation }, ..*camera }
    }

    /// The origin of positions in files: the world's, or the training frame's if f32 is too coarse for the world's.
    #[doc(hidden)]
    pub fn file_origin(&self) -> DVec3 {
        let center = self.center();
        let is_far = center.abs().max_element() * self.scale > FAR_FROM_ORIGIN * FRAME_EXTENT;
        if is_far { center } else { DVec3::ZERO }
    }
}

/// What is to be said of a file whose positions are relative to an origin; nothing of the world's.
pub fn relative_to(origin: DVec3) -> Option<String> {
    let [x, y, z] = origin.to_array();
    (origin != DVec3::ZERO).then(|| {
        format!("positions are relative, as f32 is too coarse: world = position + {x} {y} {z}")
    })
}

/// Mean and extent of the camera positions: the extent is 1.1 times the largest distance to the mean (3DGS). Cameras
/// more than 32 times as far away as the median are excluded, since their poses are most likely wrong.
///
/// If all positions coincide, the extent is zero.
pub fn spread(centers: &[DVec3]) -> (DVec3, f64) {
    let mut around = centers.to_vec();
    let middle = DVec3::from_array([0, 1, 2].map(|axis| median(centers.iter().map(|c| c[axis]))));
    let half = median(centers.iter().map(|center| center.distance(middle)));
    if half > 0.0 {
        around.retain(|center| center.distance(middle) <= OUTLIER * half);
    }
    let mean = around.iter().sum::<DVec3>() / around.len().max(1) as f64;
    let radius = around.iter().map(|center| center.distance(mean)).fold(0.0, f64::max);
    // A smaller spread is rounding error of a single position's coordinates.
    let is_spread = radius > 1e-12 * mean.length();
    (mean, if is_spread { 1.1 * radius } else { 0.0 })
}

/// Whether [`spread`] excludes a camera.
pub fn stands_elsewhere(center: DVec3, mean: DVec3, extent: f64) -> bool {
    // All inliers are closer than the extent.
    extent > 0.0 && center.distance(mean) > extent
}

/// The median; 0 if empty.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    fn camera(translation: DVec3) -> Camera {
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1);
        let view_from_world = DAffine3::from_rotation_translation(rotation, translation);
        Camera::perspective(view_from_world, 0.7, [100, 60])
    }

    #[test]
    fn a_camera_shows_the_same_in_the_training_frame_as_in_the_world() {
        for (extent, offset) in [(2.0, 0.0), (2e-6, 0.0), (2e6, 3e7), (1.0, 1e7), (40.0, 1e7)] {
            let center = DVec3::new(offset, -0.5 * offset, 0.1 * offset);
            let frame = TrainingFrame::new(center, extent);
            let rotation = camera(DVec3::ZERO).view_from_world.matrix3;
            let camera = camera(rotation * -center + DVec3::new(0.1, 0.2, 1.0) * extent);
            for x in [-0.3, 0.0, 0.2] {
                let position = center + extent * DVec3::new(x, 0.1, -0.2);
                let there = camera.project(position).unwrap();
                let here = frame.camera(&camera).project(frame.framed(position)).unwrap();
                // At an offset of 1e7 extents, nine digits of a pixel's position remain.
                assert!(here.distance(there) < 1e-5, "{extent} {offset}: {here} {there}");
                let back = frame.unframed(frame.framed(position));
                assert!(back.distance(position) <= 1e-8 * extent.max(offset), "{back}");
            }
        }
    }

    #[test]
    fn a_centred_world_with_an_extent_of_1_5_to_3_is_its_own_frame() {
        for extent in [1.51, 2.0, 2.99] {
            assert_eq!(
                TrainingFrame::new(DVec3::splat(4.0), extent),
                TrainingFrame::WORLD,
                "{extent}"
            );
        }
        assert_eq!(TrainingFrame::new(DVec3::ZERO, 3.1).scale, 0.5);
        assert_eq!(TrainingFrame::new(DVec3::ZERO, 1.4).scale, 2.0);
        for exponent in -40..40 {
            let extent = 1.7 * f64::from(exponent).exp2();
            assert_eq!(TrainingFrame::new(DVec3::ZERO, extent).scale * extent, 1.7);
        }
        let far = TrainingFrame::new(DVec3::new(1e7, 0.0, 0.0), 2.0);
        assert_eq!((far.center[0], far.file_origin().x), (1e7, 1e7));
        assert_eq!(TrainingFrame::new(DVec3::new(100.0, 0.0, 0.0), 2.0).file_origin(), DVec3::ZERO);
        for extent in [1e-300, 1e300, f64::MIN_POSITIVE, f64::MAX] {
            assert!(TrainingFrame::new(DVec3::ZERO, extent).check_rows().is_ok(), "{extent}");
        }
    }

    #[test]
    fn a_camera_far_from_all_others_is_ignored() {
        let ring: Vec<DVec3> = (0..12)
            .map(f64::from)
            .map(|a| DVec3::new((0.5 * a).cos(), (0.5 * a).sin(), 0.0))
            .collect();
        let alone = spread(&ring);
        for far in [1e3, 1e30, 1e308] {
            let mut with_one = ring.clone();
            with_one.push(DVec3::splat(far));
            assert_eq!(spread(&with_one), alone, "{far}");
            assert!(stands_elsewhere(DVec3::splat(far), alone.0, alone.1));
        }
        assert!(ring.iter().all(|&center| !stands_elsewhere(center, alone.0, alone.1)));
        assert_eq!(spread(&[DVec3::ONE; 3]), (DVec3::ONE, 0.0));
        assert_eq!(spread(&[]), (DVec3::ZERO, 0.0));
    }
}
