//! Levels of detail: they undo splits, and change images little.

use glam::Quat;
use nightsplat::reference::densify_scatter::{ChildGaussian as Split, half_of};
use nightsplat::splats::model::Model;
use nightsplat_models::gaussians::rest_coefficients;
use nightsplat_models::levels::{coarser, level};
use nightsplat_photographs::metrics::psnr;

use crate::common::clouds::{cloud, covariance, opacity, raw, relative};
use crate::common::prelude::*;

#[test]
fn the_halves_of_a_conserving_split_become_the_gaussian_again() {
    for strength in [0.05, 0.5, 0.9] {
        let mut whole = cloud(1, 2, 3);
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
