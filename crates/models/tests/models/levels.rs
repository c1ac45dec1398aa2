//! Levels of detail: how many Gaussians they have, and what they keep.

use glam::{DVec3, Vec3};
use nightsplat_models::gaussians::Gaussians;
use nightsplat_models::levels::{Cells, coarser, level};

use crate::clouds::{cloud, covariance, opacity, raw, relative};

#[test]
fn a_level_has_half_as_many_gaussians_rounded_up() {
    for count in [0, 1, 2, 3, 7, 64, 501] {
        let mut all = cloud(count, 2, 1);
        let (next, change) = coarser(&all);
        assert_eq!(next.count, count.div_ceil(2), "{count}");
        assert!(next.parameters.iter().all(|value| value.is_finite()), "{count}");
        assert_eq!(change > 0.0, count > 1, "{count}: {change}");
        // All in one place, and without extent.
        all.means_mut().fill(Vec3::ONE);
        all.log_scales_mut().fill(Vec3::splat(-200.0));
        let (next, _) = coarser(&all);
        assert_eq!(next.count, count.div_ceil(2), "{count} in one place");
        assert!(next.parameters.iter().all(|value| value.is_finite()), "{count} in one place");
    }
}

#[test]
fn two_equal_gaussians_become_one_in_their_place_that_covers_as_much() {
    for strength in [0.01, 0.3, 0.9] {
        let mut one = cloud(1, 2, 2);
        one.raw_opacities_mut()[0] = raw(strength);
        let (merged, change) = coarser(&one.select(&[0, 0]));
        assert!(merged.means()[0].distance(one.means()[0]) < 1e-6);
        let growth = covariance(&merged, 0).x_axis.x / covariance(&one, 0).x_axis.x;
        assert!(relative(covariance(&merged, 0), covariance(&one, 0) * growth) < 1e-5);
        for (coefficient, other) in merged.rest().iter().zip(one.rest()) {
            assert!(coefficient.distance(*other) < 1e-6);
        }
        assert!(merged.dc()[0].distance(one.dc()[0]) < 1e-6 && change >= 0.0);
        // The integral of 1 - (1 - o G)^2 is that of o (2 - o / 2) G.
        let expected = strength * (2.0 - 0.5 * strength);
        let covered = opacity(&merged, 0) * growth;
        assert!((covered / expected - 1.0).abs() < 1e-4, "{strength}: {covered}, not {expected}");
        // It is a little wider than each, and wider still where it would be more than opaque.
        let spread = (2.0 - 0.25 * strength) / (2.0 - 0.5 * strength);
        let is_opaque = opacity(&merged, 0) > 0.98;
        assert!((growth / spread - 1.0).abs() < 1e-4 || is_opaque, "{strength}: {growth}");
    }
}

#[test]
fn one_that_is_not_merged_keeps_its_numbers() {
    let mut three = cloud(3, 2, 4);
    three.means_mut().copy_from_slice(&[Vec3::ZERO, 50.0 * Vec3::X, 0.01 * Vec3::Y]);
    three.origin = DVec3::new(1e6, 2.0, 3.0);
    let (next, _) = coarser(&three);
    assert_eq!((next.count, next.origin), (2, three.origin));
    let far = next.means().iter().position(|mean| mean.x > 10.0).unwrap();
    let kept = |model: &Gaussians, index: usize| model.select(&[index as u32]);
    assert_eq!(kept(&next, far), kept(&three, 1));
}

#[test]
fn cells_hold_every_gaussian_once_and_are_between_half_full_and_full() {
    for (count, most) in [(0, 5), (5, 5), (6, 5), (1000, 64), (1000, 1)] {
        let Cells { mut order, cells } = Cells::new(cloud(count, 2, 5).means(), most);
        assert_eq!((cells[0].start, cells.last().unwrap().end), (0, count));
        assert!(cells.windows(2).all(|pair| pair[0].end == pair[1].start));
        let is_full = |cell: &std::ops::Range<usize>| 2 * cell.len() >= most && cell.len() <= most;
        assert!(count <= most || cells.iter().all(is_full), "{count}, {most}: {cells:?}");
        order.sort_unstable();
        assert_eq!(order, (0..count as u32).collect::<Vec<_>>());
    }
}

#[test]
fn levels_are_the_same_bytes_on_any_number_of_threads() {
    let all = cloud(700, 2, 6);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| level(&all, &[all.count], 100, 2))
    };
    let first = on(1);
    assert_eq!(first.count, 8 * 22);
    assert_eq!((on(1), on(3)), (first.clone(), first));
}
