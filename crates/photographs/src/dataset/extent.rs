//! Position and size of a scene, and points too far away to belong to it.

use glam::DVec3;
use nightsplat_core::camera::{Camera, TrainingFrame, frame, upwards};

use super::layout::DatasetLayout;
use super::{Dataset, View};

impl Dataset {
    /// The scene's size as in 3DGS: 1.1 times the largest distance of a training camera from their mean, world units.
    /// If all are at one position, half of the points are within it; without points it is 1.
    #[doc(hidden)]
    pub fn extent(&self) -> f64 {
        self.center_and_extent().1
    }

    /// The coordinate frame of training.
    #[doc(hidden)]
    pub fn frame(&self) -> TrainingFrame {
        let (center, extent) = self.center_and_extent();
        TrainingFrame::new(center, extent)
    }

    /// The world's up direction, a unit vector: perpendicular to the horizontal axes of the training cameras. A
    /// NeRF-style listing has z up by convention, which is exact even if cameras are not level; it is used unless the
    /// cameras are rotated by a quarter turn.
    pub fn up(&self) -> DVec3 {
        const MIN_COSINE: f64 = 0.7;
        let cameras: Vec<Camera> = self.train_views().map(View::upright_camera).collect();
        let up = upwards(&cameras);
        let has_convention =
            DatasetLayout::detect(&self.root).is_ok_and(|layout| !layout.listings().is_empty());
        if has_convention && up.z > MIN_COSINE { DVec3::Z } else { up }
    }

    /// The mean position of the training cameras, and the extent.
    fn center_and_extent(&self) -> (DVec3, f64) {
        let centers = self.train_views().map(|view| view.camera.center());
        let (center, spread) = frame::spread(&centers.collect::<Vec<DVec3>>());
        if spread > 0.0 {
            return (center, spread);
        }
        let mut away: Vec<f64> =
            self.points.iter().map(|point| point.position.distance(center)).collect();
        let half = away.len() / 2;
        let typical = (!away.is_empty())
            .then(|| *away.select_nth_unstable_by(half, f64::total_cmp).1)
            .filter(|&distance| distance > 0.0);
        (center, typical.unwrap_or(1.0))
    }

    /// Leaves out points that the device cannot represent or that are a million extents away: they are useless, and
    /// their Gaussians would not stay finite.
    pub(super) fn leave_out_far_points(&mut self) {
        const MAX_EXTENTS: f64 = 1e6;
        let (center, extent) = self.center_and_extent();
        let before = self.points.len();
        // A positive condition: it is false for NaN.
        self.points.retain(|point| point.position.distance(center) <= MAX_EXTENTS * extent);
        let gone = before - self.points.len();
        if gone > 0 {
            tracing::warn!(
                "{}: {gone} of {before} points lie more than a million times the cameras' extent away, or nowhere; \
                 they are left out",
                self.root.display()
            );
        }
    }

    /// Warns about training cameras far from all others.
    pub(super) fn warn_of_other_worlds(&self) {
        let (center, extent) = self.center_and_extent();
        for view in self.train_views() {
            let camera = view.camera.center();
            if frame::stands_elsewhere(camera, center, extent) {
                tracing::warn!(
                    "view {} stands {:.0e} extents of the other cameras away from them; check its pose",
                    view.name,
                    camera.distance(center) / extent
                );
            }
        }
    }
}
