//! How a split in density control changes the coverage of images, on the host.

use glam::{Quat, Vec3};
use nightsplat::reference::densify_scatter::{ChildGaussian, half_of};

fn opacity(raw: f32) -> f64 {
    1.0 / (1.0 + f64::from(-raw).exp())
}

/// Composited alpha of Gaussians without rotation, seen along a direction in the x-z plane; image x is in that plane,
/// image y perpendicular to it.
fn alpha(shapes: &[ChildGaussian], angle: f64, [x, y]: [f64; 2]) -> f64 {
    let transmitted = |shape: &ChildGaussian| {
        let scales = shape.log_scales.to_array().map(|log| f64::from(log).exp());
        let center = f64::from(shape.mean.x) * angle.sin();
        let variance = (scales[0] * angle.sin()).powi(2) + (scales[2] * angle.cos()).powi(2);
        let squared = (x - center).powi(2) / variance + (y / scales[1]).powi(2);
        1.0 - opacity(shape.raw_opacity) * (-0.5 * squared).exp()
    };
    1.0 - shapes.iter().map(transmitted).product::<f64>()
}

/// Coverage is the integral of alpha over the image.
#[test]
fn two_halves_cover_what_their_parent_covered_from_every_side() {
    const STEPS: i32 = 48;
    for raw_opacity in [-4.0_f32, -1.0, 0.0, 1.0, 3.0, 6.0] {
        let log_scales = Vec3::new(0.0, 0.5f32.ln(), 0.5f32.ln());
        let parent = ChildGaussian { mean: Vec3::ZERO, log_scales, raw_opacity };
        let halves = [0, 1].map(|copy| half_of(&parent, Quat::IDENTITY, copy));
        assert_eq!(halves[0].mean, -halves[1].mean);
        // Sums over directions, weighted by area on the sphere: before, after, squared difference, squared before.
        let mut sums = [0.0; 4];
        for step in 0..8 {
            let angle = (f64::from(step) + 0.5) / 8.0 * std::f64::consts::FRAC_PI_2;
            let mut covered = [0.0; 2];
            for i in 0..STEPS * STEPS {
                let pixel = [i % STEPS, i / STEPS].map(|k| (f64::from(k) + 0.5) / 6.0 - 4.0);
                let (before, after) =
                    (alpha(&[parent], angle, pixel), alpha(&halves, angle, pixel));
                covered[0] += before;
                covered[1] += after;
                let terms = [before, after, (after - before).powi(2), before * before];
                for (sum, term) in sums.iter_mut().zip(terms) {
                    *sum += angle.sin() * term;
                }
            }
            let change = covered[1] / covered[0] - 1.0;
            assert!(change.abs() < 0.15, "opacity {raw_opacity}, angle {angle}: {change}");
        }
        let (change, difference) = (sums[1] / sums[0] - 1.0, sums[2] / sums[3]);
        assert!(change.abs() < 0.04, "opacity {raw_opacity}: coverage changes by {change}");
        assert!(difference < 0.008, "opacity {raw_opacity}: alpha changes by {difference}");
    }
}
