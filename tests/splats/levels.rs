//! Levels of detail: how many Gaussians they have, what they keep, and how little they change images.

use glam::Quat;
use nightsplat::reference::densify_scatter::{ChildGaussian as Split, half_of};
use nightsplat::splats::model::Model;
use nightsplat_models::gaussians::rest_coefficients;
use nightsplat_models::levels::{Cells, coarser, level};
use nightsplat_photographs::metrics::psnr;

use crate::common::prelude::*;

/// A cloud around the origin.
fn cloud(count: usize, seed: u64) -> Gaussians {
    let mut gaussians = Gaussians::zeros(count, 2);
    let stream = Stream::new(seed, 13);
    for (index, value) in (0..).zip(&mut gaussians.parameters) {
        *value = (stream.uniform(index) * 2.0 - 1.0) as f32;
    }
    gaussians.log_scales_mut().iter_mut().for_each(|scale| *scale = *scale * 0.5 - 2.5);
    gaussians.rest_mut().iter_mut().for_each(|value| *value *= 0.3);
    gaussians
}

fn covariance(gaussians: &Gaussians, index: usize) -> DMat3 {
    let [w, x, y, z] = gaussians.quats()[index].map(f64::from);
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = gaussians.log_scales()[index].as_dvec3().exp();
    axes * DMat3::from_diagonal(scales * scales) * axes.transpose()
}

fn opacity(gaussians: &Gaussians, index: usize) -> f64 {
    1.0 / (1.0 + (-f64::from(gaussians.raw_opacities()[index])).exp())
}

fn raw(opacity: f64) -> f32 {
    (opacity / (1.0 - opacity)).ln() as f32
}

/// The largest difference of two matrices, as a share of the largest number of the second.
fn relative(a: DMat3, b: DMat3) -> f64 {
    let [a, b] = [a, b].map(|matrix| matrix.to_cols_array());
    let largest = b.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    a.iter().zip(b).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs())) / largest
}

#[test]
fn a_level_has_half_as_many_gaussians_rounded_up() {
    for count in [0, 1, 2, 3, 7, 64, 501] {
        let mut all = cloud(count, 1);
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
        let mut one = cloud(1, 2);
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
fn the_halves_of_a_conserving_split_become_the_gaussian_again() {
    for strength in [0.05, 0.5, 0.9] {
        let mut whole = cloud(1, 3);
        whole.raw_opacities_mut()[0] = raw(strength);
        whole.log_scales_mut()[0] = Vec3::new(-2.0, -2.4, -2.8);
        let [w, x, y, z] = whole.quats()[0];
        let rotation = Quat::from_xyzw(x, y, z, w).normalize();
        let parent = Split {
            mean: whole.means()[0],
            log_scales: whole.log_scales()[0],
            raw_opacity: whole.raw_opacities()[0],
        };
        let mut halves = whole.select(&[0, 0]);
        for copy in 0..2 {
            let half = half_of(&parent, rotation, copy);
            halves.means_mut()[copy as usize] = half.mean;
            halves.log_scales_mut()[copy as usize] = half.log_scales;
            halves.raw_opacities_mut()[copy as usize] = half.raw_opacity;
        }
        let (merged, _) = coarser(&halves);
        assert!(merged.means()[0].distance(parent.mean) < 1e-6);
        let off = relative(covariance(&merged, 0), covariance(&whole, 0));
        assert!(off < 0.12, "{strength}: covariance off by {off}");
        let now = opacity(&merged, 0);
        assert!((now / strength - 1.0).abs() < 0.1, "{strength} became {now}");
    }
}

#[test]
fn one_that_is_not_merged_keeps_its_numbers() {
    let mut three = cloud(3, 4);
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
        let Cells { mut order, cells } = Cells::new(cloud(count, 5).means(), most);
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
    let all = cloud(700, 6);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| level(&all, &[all.count], 100, 2))
    };
    let first = on(1);
    assert_eq!(first.count, 8 * 22);
    assert_eq!((on(1), on(3)), (first.clone(), first));
}

/// A wall with a smooth pattern, of flat Gaussians with SH coefficients, and a shelf before it.
fn wall() -> Gaussians {
    const SIDES: [usize; 2] = [56, 40];
    let mut wall = Gaussians::zeros(SIDES[0] * SIDES[1] + 200, 1);
    let stream = Stream::new(8, 1);
    for index in 0..wall.count {
        let draw = |k: u64| stream.uniform(8 * index as u64 + k) as f32;
        let on_wall = index < SIDES[0] * SIDES[1];
        let (x, y) = ((index % SIDES[0]) as f32, (index / SIDES[0]) as f32);
        let position =
            Vec3::new(0.07 * (x - 27.5 + 0.4 * draw(0)), 0.07 * (y - 19.5 + 0.4 * draw(1)), 0.0);
        wall.means_mut()[index] = match on_wall {
            true => position,
            false => Vec3::new(3.0 * draw(0) - 1.5, 0.4 + 0.1 * draw(1), -0.5 - 0.2 * draw(2)),
        };
        wall.log_scales_mut()[index] = match on_wall {
            true => Vec3::new(0.055, 0.055, 0.005).map(f32::ln),
            false => Vec3::new(0.12, 0.05, 0.05).map(f32::ln),
        };
        wall.quats_mut()[index] = [1.0, 0.0, 0.0, 0.1 * draw(3)];
        wall.raw_opacities_mut()[index] = raw(0.9);
        let wave = |k: f32| (2.0 * position.x + k).sin() * (1.7 * position.y - k).cos();
        wall.dc_mut()[index] = match on_wall {
            true => Vec3::new(wave(0.0), wave(1.0), wave(2.0)) + 0.4 * draw(4),
            false => Vec3::new(-0.8, 0.6, 0.9) + 0.3 * draw(4),
        };
        let width = rest_coefficients(1);
        for value in &mut wall.rest_mut()[width * index..][..width] {
            *value = Vec3::splat(0.1 * position.x);
        }
    }
    wall
}

#[test]
fn each_level_looks_like_the_one_before() {
    let gpu = gpu();
    let pose =
        DAffine3::from_mat3_translation(DMat3::from_rotation_y(0.2), DVec3::new(0.0, 0.0, 4.0));
    let camera = Camera::perspective(pose, 0.75, [96, 72]);
    let render = |gaussians: &Gaussians| -> Image {
        let model = Model::from(gaussians.clone());
        let on_device = gaussians.upload(&gpu).unwrap();
        let mut renderer = Renderer::new(&gpu, model.render_settings()).unwrap();
        let options = RenderOptions { sh_degree: 1, background: [0.0; 3] };
        renderer.reserve(gaussians.count, [&camera]).unwrap();
        renderer.render_image(&on_device, &camera, &options).unwrap()
    };
    let full = wall();
    let images: Vec<Image> = (0..4).map(|k| render(&level(&full, &[full.count], 600, k))).collect();
    // Level 0 is the model in another order.
    assert!(psnr(&images[0], &render(&full)).unwrap() > 60.0);
    for (k, least) in [(1, 36.0), (2, 32.0), (3, 28.0)] {
        let value = psnr(&images[k], &images[k - 1]).unwrap();
        assert!(value > least, "level {k}: {value} dB");
    }
}
