//! The similarity between two worlds, from the same camera centres in both.
//!
//! Least squares in closed form: rotation by Horn's quaternion (B. K. P. Horn, "Closed-form solution of absolute
//! orientation using unit quaternions", 1987: never a reflection), scale and translation after Umeyama 1991.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix4, SymmetricEigen};

/// `point -> scale * rotation * point + translation`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Similarity {
    scale: f64,
    rotation: DQuat,
    translation: DVec3,
    /// The largest remaining distance of a pair, relative to the largest distance of a target from their mean.
    pub(super) residual: f64,
}

impl Similarity {
    /// From `(source, target)` pairs; `None` for fewer than three or if all are collinear.
    pub(super) fn solve(pairs: &[(DVec3, DVec3)]) -> Option<Self> {
        let count = pairs.len() as f64;
        let source_mean = pairs.iter().map(|pair| pair.0).sum::<DVec3>() / count;
        let target_mean = pairs.iter().map(|pair| pair.1).sum::<DVec3>() / count;
        let centered =
            || pairs.iter().map(|(source, target)| (*source - source_mean, *target - target_mean));

        let covariance = centered().fold(DMat3::ZERO, |sum, (s, t)| sum + outer(s, t));
        if pairs.len() < 3
            || on_a_line(centered().map(|pair| pair.0))
            || on_a_line(centered().map(|pair| pair.1))
        {
            return None;
        }
        let rotation = horn_rotation(covariance);
        let spread: f64 = centered().map(|(source, _)| source.length_squared()).sum();
        let scale =
            centered().map(|(source, target)| target.dot(rotation * source)).sum::<f64>() / spread;
        let translation = target_mean - scale * (rotation * source_mean);

        let mut similarity = Self { scale, rotation, translation, residual: f64::NAN };
        let extent = centered().map(|(_, target)| target.length()).fold(0.0, f64::max);
        let distance =
            |(source, target): &(DVec3, DVec3)| similarity.apply(*source).distance(*target);
        similarity.residual = pairs.iter().map(distance).fold(0.0, f64::max) / extent;
        (scale > 0.0 && similarity.residual.is_finite()).then_some(similarity)
    }

    /// A source point in the target's world.
    pub(super) fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }
}

fn outer(column: DVec3, row: DVec3) -> DMat3 {
    DMat3::from_cols(column * row.x, column * row.y, column * row.z)
}

/// Whether the offsets leave a rotation undetermined: no two of them span a plane.
fn on_a_line(offsets: impl Iterator<Item = DVec3> + Clone) -> bool {
    let longest =
        offsets.clone().fold(DVec3::ZERO, |a, b| if b.length() > a.length() { b } else { a });
    let widest = offsets.map(|offset| offset.cross(longest).length()).fold(0.0, f64::max);
    // A positive condition: zero spread is also collinear.
    let spans_a_plane = widest > 1e-6 * longest.length_squared();
    !spans_a_plane
}

/// The rotation that best maps sources to targets, from the sum of `source * target^T`.
fn horn_rotation(covariance: DMat3) -> DQuat {
    let s = |row: usize, column: usize| covariance.col(column)[row];
    let (xx, yy, zz) = (s(0, 0), s(1, 1), s(2, 2));
    let (yz, zx, xy) = (s(1, 2) - s(2, 1), s(2, 0) - s(0, 2), s(0, 1) - s(1, 0));
    let (xy2, yz2, zx2) = (s(0, 1) + s(1, 0), s(1, 2) + s(2, 1), s(2, 0) + s(0, 2));
    let quaternions = SymmetricEigen::new(Matrix4::from([
        [xx + yy + zz, yz, zx, xy],
        [yz, xx - yy - zz, xy2, zx2],
        [zx, xy2, yy - xx - zz, yz2],
        [xy, zx2, yz2, zz - xx - yy],
    ]));
    let leading = quaternions.eigenvectors.column(quaternions.eigenvalues.imax());
    DQuat::from_xyzw(leading[1], leading[2], leading[3], leading[0]).normalize()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn centers() -> Vec<DVec3> {
        (0..9)
            .map(f64::from)
            .map(|i| DVec3::new((1.3 * i).sin(), 0.2 * i, (0.7 * i).cos() - 0.1 * i))
            .collect()
    }

    #[test]
    fn a_known_similarity_is_recovered() {
        for angle in [0.0, 0.3, 1.9, 0.999 * PI, PI, 5.0] {
            let rotation = DQuat::from_axis_angle(DVec3::new(0.3, -0.8, 0.5).normalize(), angle);
            let map = |point: DVec3| 3.7 * (rotation * point) + DVec3::new(-4.0, 11.0, 0.5);
            let pairs: Vec<_> = centers().iter().map(|center| (*center, map(*center))).collect();
            let solved = Similarity::solve(&pairs).unwrap();
            assert!(solved.residual < 1e-13, "{angle}: {}", solved.residual);
            let point = DVec3::new(7.0, -2.0, 9.0);
            assert!(solved.apply(point).distance(map(point)) < 1e-11, "{angle}");
        }
    }

    #[test]
    fn a_mirrored_world_has_a_large_residual() {
        let pairs: Vec<_> = centers().iter().map(|c| (*c, DVec3::new(-c.x, c.y, c.z))).collect();
        assert!(Similarity::solve(&pairs).is_none_or(|solved| solved.residual > 0.05));
    }

    #[test]
    fn collinear_or_coincident_centres_determine_nothing() {
        let line: Vec<_> =
            (0..5).map(|i| (DVec3::X * f64::from(i), DVec3::Y * f64::from(i))).collect();
        assert!(Similarity::solve(&line).is_none());
        assert!(Similarity::solve(&[(DVec3::ONE, DVec3::ONE); 5]).is_none());
        assert!(Similarity::solve(&line[..2]).is_none());
        assert!(Similarity::solve(&[]).is_none());
    }
}
