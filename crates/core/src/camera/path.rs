//! Camera paths through the poses of photographs, for videos.

use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DMat3, DQuat, DVec3, DVec4};

use super::Camera;
use super::axes::{forward, mean, nearest_to_axes, upwards};
use crate::{Error, Result};

/// The shape of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraPath {
    /// A circle around the point nearest to all optical axes, at the mean height and distance of the cameras.
    Orbit,
    /// The part of that circle that the cameras cover, back and forth.
    Arc,
    /// Two turns around the mean pose, as wide as the spread of the cameras, looking at their focus (LLFF).
    Spiral,
    /// A smooth curve through all poses, in order.
    Interpolate,
}

/// Turns of a spiral, with one oscillation along the optical axis.
const TURNS: f64 = 2.0;

/// Cameras surround a scene if no gap between neighbours is larger, radians.
const SURROUNDED: f64 = 100.0 * PI / 180.0;

/// Cameras that cover less of a circle count as parallel, radians.
const MIN_ARC: f64 = 20.0 * PI / 180.0;

impl CameraPath {
    /// The path that stays close to the cameras of `poses`: an orbit if they surround the scene, an arc if they cover a
    /// part of the circle, a spiral if they are parallel, and a curve through all of them if they look outwards.
    pub fn suited(poses: &[Camera]) -> Self {
        Self::suited_about(poses, upwards(poses))
    }

    /// [`CameraPath::suited`] with a given up direction, a unit vector.
    #[doc(hidden)]
    pub fn suited_about(poses: &[Camera], up: DVec3) -> Self {
        let Some(circle) = Circle::new(poses, up) else { return Self::Spiral };
        let faces = |pose: &&Camera| forward(pose).dot(circle.target - pose.center()) > 0.0;
        let facing = poses.iter().filter(faces).count();
        let [begin, end] = circle.covered(poses);
        if 4 * facing < 3 * poses.len() {
            Self::Interpolate
        } else if TAU - (end - begin) < SURROUNDED {
            Self::Orbit
        } else if end - begin < MIN_ARC {
            Self::Spiral
        } else {
            Self::Arc
        }
    }

    /// `frames` cameras with the image size and focal lengths of the first of `poses`.
    ///
    /// # Errors
    /// [`Error::Usage`] if there is no pose, or the cameras are parallel and there is no point to orbit.
    pub fn cameras(self, poses: &[Camera], frames: usize) -> Result<Vec<Camera>> {
        self.cameras_about(poses, upwards(poses), frames)
    }

    /// [`CameraPath::cameras`] with a given up direction, a unit vector.
    #[doc(hidden)]
    pub fn cameras_about(self, poses: &[Camera], up: DVec3, frames: usize) -> Result<Vec<Camera>> {
        let first = poses.first().ok_or_else(|| {
            Error::Usage("a camera path needs cameras, and there are none".to_owned())
        })?;
        let at = |view_from_world| Camera { view_from_world, ..*first };
        let views: Vec<DAffine3> = match self {
            Self::Interpolate => interpolated(poses, frames),
            Self::Orbit => orbit(poses, up, frames)?,
            Self::Arc => arc(poses, up, frames)?,
            Self::Spiral => spiral(poses, up, frames),
        };
        Ok(views.into_iter().map(at).collect())
    }
}

/// Uniform Catmull-Rom splines of the centres and, within one hemisphere, of the quaternions.
fn interpolated(poses: &[Camera], frames: usize) -> Vec<DAffine3> {
    let world_from_view = poses.iter().map(|pose| pose.view_from_world.inverse());
    let centers: Vec<DVec3> = world_from_view.clone().map(|pose| pose.translation).collect();
    let mut turns: Vec<DVec4> = vec![];
    for pose in world_from_view {
        let turn = DVec4::from(DQuat::from_mat3(&pose.matrix3).normalize());
        // Both signs are the same rotation; the nearer one gives the shorter path.
        let is_far = turns.last().is_some_and(|last| last.dot(turn) < 0.0);
        turns.push(if is_far { -turn } else { turn });
    }
    let segments = poses.len() - 1;
    let frame = |index: usize| {
        let along = segments as f64 * index as f64 / (frames.max(2) - 1) as f64;
        let segment = (along as usize).min(segments.saturating_sub(1));
        let t = along - segment as f64;
        let knot = |offset: usize| (segment + offset).saturating_sub(1).min(segments);
        let knots = [0, 1, 2, 3].map(knot);
        let center: DVec3 = weights(t).into_iter().zip(knots).map(|(w, k)| w * centers[k]).sum();
        let turn: DVec4 = weights(t).into_iter().zip(knots).map(|(w, k)| w * turns[k]).sum();
        DAffine3::from_rotation_translation(DQuat::from_vec4(turn).normalize(), center).inverse()
    };
    (0..frames).map(frame).collect()
}

/// Interpolates between the middle two of four knots.
fn weights(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// A circle around the focus of all cameras, at their mean height and distance.
struct Circle {
    target: DVec3,
    up: DVec3,
    /// Unit vectors to azimuth 0, that of the first camera, and to 90 degrees.
    axes: [DVec3; 2],
    height: f64,
    radius: f64,
}

impl Circle {
    /// `None` if the cameras are parallel.
    fn new(poses: &[Camera], up: DVec3) -> Option<Self> {
        let target = nearest_to_axes(poses)?;
        let offsets = poses.iter().map(|pose| pose.center() - target);
        let level = |offset: DVec3| offset - offset.dot(up) * up;
        let count = poses.len() as f64;
        let height = offsets.clone().map(|offset| offset.dot(up)).sum::<f64>() / count;
        let radius = offsets.clone().map(|offset| level(offset).length()).sum::<f64>() / count;
        let first = offsets.map(level).next().unwrap_or_default();
        let first = first.try_normalize().unwrap_or_else(|| up.any_orthonormal_vector());
        Some(Self { target, up, axes: [first, up.cross(first)], height, radius })
    }

    /// World to view at an azimuth, radians.
    fn at(&self, azimuth: f64) -> DAffine3 {
        let Self { target, up, axes: [x, y], height, radius } = *self;
        let (sin, cos) = azimuth.sin_cos();
        looking(target + height * up + radius * (cos * x + sin * y), target, up)
    }

    /// The azimuths that the cameras cover, from the first to the last, without the largest gap between two neighbours.
    fn covered(&self, poses: &[Camera]) -> [f64; 2] {
        let azimuth = |pose: &Camera| {
            let [x, y] = self.axes.map(|axis| axis.dot(pose.center() - self.target));
            y.atan2(x)
        };
        let mut azimuths: Vec<f64> = poses.iter().map(azimuth).collect();
        azimuths.sort_by(f64::total_cmp);
        let next = azimuths.iter().skip(1).copied().chain([azimuths[0] + TAU]);
        let gaps =
            azimuths.iter().zip(next).map(|(azimuth, next)| (next - azimuth, *azimuth, next));
        let (_, end, begin) = gaps.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default();
        [begin, if end < begin { end + TAU } else { end }]
    }
}

fn orbit(poses: &[Camera], up: DVec3, frames: usize) -> Result<Vec<DAffine3>> {
    let circle = Circle::new(poses, up).ok_or_else(parallel)?;
    let frame = |index: usize| circle.at(TAU * index as f64 / frames.max(1) as f64);
    Ok((0..frames).map(frame).collect())
}

/// Slow at both ends.
fn arc(poses: &[Camera], up: DVec3, frames: usize) -> Result<Vec<DAffine3>> {
    let circle = Circle::new(poses, up).ok_or_else(parallel)?;
    let [begin, end] = circle.covered(poses);
    let frame = |index: usize| {
        let along = 0.5 - 0.5 * (TAU * index as f64 / frames.max(1) as f64).cos();
        circle.at(begin + along * (end - begin))
    };
    Ok((0..frames).map(frame).collect())
}

fn parallel() -> Error {
    let problem =
        "the cameras are parallel: there is no point to orbit; use --path spiral or interpolate";
    Error::Usage(problem.to_owned())
}

fn spiral(poses: &[Camera], up: DVec3, frames: usize) -> Vec<DAffine3> {
    let center = mean(poses.iter().map(Camera::center));
    let forward = mean(poses.iter().map(forward)).normalize_or(DVec3::Z);
    let middle = looking(center, center + forward, up);
    let from_middle = |pose: &Camera| middle.transform_point3(pose.center()).abs();
    let radii = [0, 1, 2].map(|axis| {
        let mut away: Vec<f64> = poses.iter().map(|pose| from_middle(pose)[axis]).collect();
        away.sort_by(f64::total_cmp);
        away[(away.len() - 1) * 9 / 10]
    });
    let reach = DVec3::from(radii).length().max(f64::MIN_POSITIVE);
    let ahead = nearest_to_axes(poses).map(|target| (target - center).dot(forward));
    // Parallel cameras have no focus; with a distant one, the frames are parallel, too.
    let focus = ahead.filter(|&ahead| ahead > 0.0).unwrap_or(10.0 * reach);
    let world_from_middle = middle.inverse();
    let frame = |index: usize| {
        let angle = TAU * TURNS * index as f64 / frames.max(1) as f64;
        let offset = DVec3::new(angle.cos(), angle.sin(), (angle / TURNS).sin());
        let at = world_from_middle.transform_point3(DVec3::from(radii) * offset);
        looking(at, center + focus * forward, up)
    };
    (0..frames).map(frame).collect()
}

/// World to view for a camera at `center` that looks at `target`, with `up` upwards.
pub(super) fn looking(center: DVec3, target: DVec3, up: DVec3) -> DAffine3 {
    let forward = (target - center).normalize_or(DVec3::Z);
    let right = forward.cross(up).try_normalize();
    let right = right.unwrap_or_else(|| forward.any_orthonormal_vector());
    let world_from_view = DMat3::from_cols(right, forward.cross(right), forward);
    DAffine3::from_mat3_translation(world_from_view, center).inverse()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::axes::up;

    const TARGET: DVec3 = DVec3::new(0.5, -0.25, 2.0);

    /// Cameras on an arc, slightly above the point that they look at.
    fn ring(count: usize, turn: f64) -> Vec<Camera> {
        let pose = |index: usize| {
            let (sin, cos) = (turn * index as f64 / count as f64).sin_cos();
            let center = TARGET + DVec3::new(3.0 * cos, -1.0, 3.0 * sin);
            Camera::perspective(looking(center, TARGET, DVec3::NEG_Y), 0.9, [64, 48])
        };
        (0..count).map(pose).collect()
    }

    fn sees_the_target_in_the_middle(camera: &Camera) -> bool {
        camera.project(TARGET).is_some_and(|pixel| pixel.distance(camera.principal_point) < 1e-6)
    }

    #[test]
    fn an_interpolated_path_goes_through_every_pose_and_stays_close_to_them() {
        let poses = ring(5, 2.0);
        let frames = CameraPath::Interpolate.cameras(&poses, 41).unwrap();
        assert_eq!(frames.len(), 41);
        for (pose, frame) in poses.iter().zip(frames.iter().step_by(10)) {
            assert!(frame.center().distance(pose.center()) < 1e-9);
            assert!(
                forward(frame).dot(forward(pose)) > 1.0 - 1e-9
                    && up(frame).dot(up(pose)) > 1.0 - 1e-9
            );
        }
        let step = frames.windows(2).map(|two| two[0].center().distance(two[1].center()));
        assert!(step.fold(0.0, f64::max) < 0.25);
        for frame in &frames {
            assert!((frame.view_from_world.matrix3.determinant() - 1.0).abs() < 1e-9);
        }
        let one = CameraPath::Interpolate.cameras(&poses[..1], 3).unwrap();
        assert!(one.iter().all(|frame| frame.center().distance(poses[0].center()) < 1e-9));
    }

    #[test]
    fn an_orbit_looks_at_the_focus_from_the_distance_of_the_cameras() {
        let poses = ring(7, 2.0);
        let frames = CameraPath::Orbit.cameras(&poses, 12).unwrap();
        assert!(frames.iter().all(sees_the_target_in_the_middle));
        assert!(frames[0].center().distance(poses[0].center()) < 0.2, "{}", frames[0].center());
        let opposite = frames[0].center() - TARGET;
        let opposite = TARGET + DVec3::new(-opposite.x, opposite.y, -opposite.z);
        assert!(frames[6].center().distance(opposite) < 0.2, "{}", frames[6].center());
        let mut parallel = poses[0];
        parallel.view_from_world.translation += DVec3::X;
        let refused = CameraPath::Orbit.cameras(&[poses[0], parallel], 3).unwrap_err().to_string();
        assert!(refused.contains("are parallel") && refused.contains("spiral"), "{refused}");
        assert!(CameraPath::Orbit.cameras(&[], 3).is_err());
    }

    #[test]
    fn an_arc_goes_back_and_forth_over_the_covered_part() {
        let poses = ring(9, 2.25);
        let frames = CameraPath::Arc.cameras(&poses, 16).unwrap();
        assert!(frames.iter().all(sees_the_target_in_the_middle));
        let [first, last] = [0, 8].map(|index| poses[index].center());
        let [begin, middle, end] = [0, 8, 15].map(|index| frames[index].center());
        let [there, back] = [begin.distance(first), begin.distance(last)];
        assert!(there.min(back) < 1e-6, "{begin}");
        let other = if there < back { last } else { first };
        assert!(middle.distance(other) < 1e-6 && end.distance(begin) < 0.3, "{middle} {end}");
        for frame in &frames {
            let nearest = poses.iter().map(|pose| pose.center().distance(frame.center()));
            assert!(nearest.fold(f64::MAX, f64::min) < 0.4, "{}", frame.center());
        }
    }

    #[test]
    fn the_suited_path_stays_close_to_the_cameras() {
        // From a circle of eight, the last are removed one by one.
        for (count, path) in [(8, CameraPath::Orbit), (7, CameraPath::Orbit), (6, CameraPath::Arc)]
        {
            assert_eq!(CameraPath::suited(&ring(8, TAU)[..count]), path, "{count}");
        }
        assert_eq!(CameraPath::suited(&ring(9, 0.3)), CameraPath::Spiral);
        let mut parallel = ring(1, 0.0)[0];
        parallel.view_from_world.translation += DVec3::X;
        assert_eq!(CameraPath::suited(&[ring(1, 0.0)[0], parallel]), CameraPath::Spiral);
        let outwards = |mut pose: Camera| {
            let center = pose.center();
            pose.view_from_world = looking(center, 2.0 * center - TARGET, DVec3::NEG_Y);
            pose
        };
        let outwards: Vec<Camera> = ring(8, TAU).into_iter().map(outwards).collect();
        assert_eq!(CameraPath::suited(&outwards), CameraPath::Interpolate);
    }

    #[test]
    fn a_spiral_stays_among_the_cameras_and_looks_at_their_focus() {
        let poses = ring(9, 0.6);
        let frames = CameraPath::Spiral.cameras(&poses, 30).unwrap();
        let center = mean(poses.iter().map(Camera::center));
        for frame in &frames {
            assert!(frame.center().distance(center) < 1.5);
            assert!(forward(frame).dot((TARGET - frame.center()).normalize()) > 0.99);
        }
        // Parallel cameras have no focus, but a spiral is possible.
        let mut parallel = poses[0];
        parallel.view_from_world.translation += DVec3::X;
        let frames = CameraPath::Spiral.cameras(&[poses[0], parallel], 5).unwrap();
        assert!(frames.iter().all(|frame| frame.view_from_world.is_finite()));
    }
}
