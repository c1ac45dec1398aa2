//! Camera poses of a scene: distances between them, and a subset that covers them.

use glam::DVec3;

use super::Camera;

/// Position and direction: the position relative to the mean in units of the standard deviation, the direction as a
/// unit vector.
type CameraPose = [f64; 6];

/// The poses of a scene's cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPoses {
    middle: DVec3,
    /// One over the standard deviation of the positions; 0 if they coincide.
    scale: f64,
    poses: Vec<CameraPose>,
}

impl CameraPoses {
    /// The poses of cameras.
    pub fn new(cameras: &[Camera]) -> Self {
        let count = cameras.len().max(1) as f64;
        let middle = cameras.iter().map(Camera::center).sum::<DVec3>() / count;
        let squares = cameras.iter().map(|camera| camera.center().distance_squared(middle));
        let deviation = (squares.sum::<f64>() / count).sqrt();
        let scale = if deviation > 0.0 { 1.0 / deviation } else { 0.0 };
        let mut all = Self { middle, scale, poses: vec![] };
        all.poses = cameras.iter().map(|camera| all.pose(camera)).collect();
        all
    }

    /// Every `step`th pose, in the same units.
    pub fn every(self, step: usize) -> Self {
        Self { poses: self.poses.into_iter().step_by(step).collect(), ..self }
    }

    /// The squared distance of each pose from that of a camera.
    pub fn squared_distances(&self, camera: &Camera) -> impl Iterator<Item = f64> {
        let from = self.pose(camera);
        self.poses.iter().map(move |pose| squared_distance(pose, &from))
    }

    fn pose(&self, camera: &Camera) -> CameraPose {
        let [x, y, z] = (self.scale * (camera.center() - self.middle)).to_array();
        let [u, v, w] = camera.view_from_world.matrix3.row(2).to_array();
        [x, y, z, u, v, w]
    }
}

fn squared_distance(a: &CameraPose, b: &CameraPose) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

impl Camera {
    /// The indices of `count` cameras, or of all if there are fewer, in ascending order, that cover the poses.
    ///
    /// The cameras are divided into that many groups of about equal size, recursively in two, across the direction of
    /// the largest variance. Of each group the camera nearest to its mean is selected.
    #[doc(hidden)]
    pub fn covering(cameras: &[Self], count: usize) -> Vec<usize> {
        let CameraPoses { poses, .. } = CameraPoses::new(cameras);
        let mut picked = vec![];
        pick(&poses, (0..cameras.len()).collect(), count.min(cameras.len()), &mut picked);
        picked.sort_unstable();
        picked
    }
}

/// Selects `count` poses of a group.
fn pick(poses: &[CameraPose], mut group: Vec<usize>, count: usize, picked: &mut Vec<usize>) {
    match count {
        0 => {}
        1 => picked.extend(nearest_to_mean(poses, &group)),
        _ => {
            let axis = widest_axis(poses, &group);
            group.sort_by(|&a, &b| poses[a][axis].total_cmp(&poses[b][axis]).then(a.cmp(&b)));
            let first = count / 2;
            let rest = group.split_off(group.len() * first / count);
            pick(poses, group, first, picked);
            pick(poses, rest, count - first, picked);
        }
    }
}

fn mean(poses: &[CameraPose], group: &[usize], axis: usize) -> f64 {
    group.iter().map(|&i| poses[i][axis]).sum::<f64>() / group.len().max(1) as f64
}

fn widest_axis(poses: &[CameraPose], group: &[usize]) -> usize {
    let variance = |axis: usize| {
        let mean = mean(poses, group, axis);
        group.iter().map(|&i| (poses[i][axis] - mean).powi(2)).sum::<f64>()
    };
    let axes = (0..6).map(|axis| (axis, variance(axis)));
    axes.reduce(|best, next| if next.1 > best.1 { next } else { best }).map_or(0, |(axis, _)| axis)
}

fn nearest_to_mean(poses: &[CameraPose], group: &[usize]) -> Option<usize> {
    let means: CameraPose = std::array::from_fn(|axis| mean(poses, group, axis));
    let distance = |i: usize| squared_distance(&poses[i], &means);
    group.iter().copied().min_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)))
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat3};

    use super::*;

    fn camera(position: DVec3, turn: f64) -> Camera {
        let rotation = DMat3::from_rotation_y(turn);
        let view_from_world = DAffine3::from_mat3_translation(rotation, -(rotation * position));
        Camera::perspective(view_from_world, 0.9, [10, 10])
    }

    #[test]
    fn a_path_is_covered_from_end_to_end_in_any_order_of_its_views() {
        let steps: Vec<usize> = (0..32).map(|i| i * 13 % 32).collect();
        let cameras: Vec<Camera> =
            steps.iter().map(|&step| camera(DVec3::X * step as f64, 0.0)).collect();
        let mut picked: Vec<usize> =
            Camera::covering(&cameras, 4).into_iter().map(|i| steps[i]).collect();
        picked.sort_unstable();
        for (picked, middle) in picked.iter().zip([3.5, 11.5, 19.5, 27.5]) {
            assert!((*picked as f64 - middle).abs() < 1.0, "{picked} for {middle}");
        }
    }

    #[test]
    fn cameras_at_one_position_differ_by_direction() {
        let cameras: Vec<Camera> =
            (0..16).map(|i| camera(DVec3::ZERO, 0.1 * f64::from(i))).collect();
        let picked = Camera::covering(&cameras, 2);
        assert!(picked[0] < 8 && picked[1] >= 8, "{picked:?}");
    }

    #[test]
    fn no_camera_is_selected_twice_nor_more_than_exist() {
        let cameras = vec![camera(DVec3::ONE, 0.0); 5];
        for (count, picked) in [(0, 0), (1, 1), (3, 3), (5, 5), (9, 5)] {
            let mut indices = Camera::covering(&cameras, count);
            indices.dedup();
            assert_eq!(indices.len(), picked, "{count}");
        }
        assert!(Camera::covering(&[], 3).is_empty());
    }
}
