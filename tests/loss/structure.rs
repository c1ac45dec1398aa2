//! The structure of a pseudo-GT, and the term that compares a plane of the render with it.

use nightsplat::kernels::structure_l1;
use nightsplat::loss::{LossTerm as _, StructureLoss, Term};
use nightsplat::targets::structure::StructureTarget;

use super::{
    Logged, NOT_FINITE, Torch, assert_close, assert_gradient, bits, central_differences, largest,
    log_step, noise, term_inputs, widen,
};
use crate::common::prelude::*;

const FEATURES: Features = Features { structure: true, ..Features::NONE };

const SIZES: [[u32; 2]; 7] = [[1, 1], [3, 1], [1, 40], [5, 7], [33, 17], [16, 64], [131, 97]];

/// (3, H, W), smooth shapes with some noise.
fn photograph([width, height]: [u32; 2]) -> Vec<f32> {
    let pixels = (width * height) as usize;
    let soft = |i: usize| {
        let (x, y) = ((i % width as usize) as f32, (i % pixels / width as usize) as f32);
        0.5 + 0.3 * (0.2 * x + 0.3 * y + (i / pixels) as f32).sin()
    };
    let noise = noise(3, 3 * pixels, 0.0, 0.1);
    (0..3 * pixels).map(|i| soft(i) + noise[i]).collect()
}

fn structure_of(image: &[f32], size: [u32; 2]) -> Vec<f32> {
    let gpu = gpu();
    let image = gpu.buffer("image", image).unwrap();
    let mut structure = gpu.zeros("structure", image.len() / 3).unwrap();
    let mut target = StructureTarget::new(&gpu).unwrap();
    gpu.run("structure", |pass| target.record(pass, &image, size.into(), &mut structure)).unwrap();
    gpu.read(&structure).unwrap()
}

#[test]
fn the_kernels_match_their_references() {
    for size in SIZES {
        let (structure, report) = agreeing(|| structure_of(&photograph(size), size));
        assert_eq!(structure.len(), (size[0] * size[1]) as usize);
        let kernels: Vec<&str> = report.passes.iter().map(|pass| pass.kernel).collect();
        let chain = ["ciconv_rows", "ciconv_columns", "ciconv_moments", "ciconv_normalize"];
        assert_eq!(kernels, chain);
    }
}

#[test]
fn the_structure_agrees_with_pytorch() {
    let torch = Torch::read();
    let structure = structure_of(torch.get("structure.image"), [31, 24]);
    torch.assert_agrees("structure.target", &structure);
}

#[test]
fn a_flat_image_without_a_border_has_no_structure() {
    // Zero padding is an edge: only black has none.
    let size = [40, 30];
    assert!(structure_of(&vec![0.0; 3 * 40 * 30], size).iter().all(|&s| s == 0.0));
    let gray = structure_of(&vec![0.5; 3 * 40 * 30], size);
    for (i, s) in gray.into_iter().enumerate() {
        let (x, y) = (i % 40, i / 40);
        if (6..34).contains(&x) && (6..24).contains(&y) {
            assert_eq!(s, 0.0, "{x} {y}");
        }
    }
    assert_eq!(structure_of(&[0.7, 0.1, 0.3], [1, 1]), [0.0]);
}

#[test]
fn a_brighter_image_has_the_same_structure() {
    let image = photograph([33, 17]);
    let half: Vec<f32> = image.iter().map(|x| 0.5 * x).collect();
    let [full, half] = [image, half].map(|image| structure_of(&image, [33, 17]));
    assert_close("structure", &half, &full, 2e-3);
}

#[test]
fn the_same_image_has_the_same_structure_in_every_bit() {
    let image = photograph([131, 97]);
    let structure = || bits(&structure_of(&image, [131, 97]));
    let first = structure();
    assert!((0..5).all(|_| structure() == first));
}

#[test]
fn a_view_without_pixels_or_with_a_short_buffer_is_refused() {
    let gpu = gpu();
    let mut target = StructureTarget::new(&gpu).unwrap();
    let image = gpu.zeros("image", 3 * 12).unwrap();
    for (size, len) in [([0, 3], 12), ([5, 3], 15), ([4, 3], 11)] {
        let mut structure = gpu.zeros("structure", len).unwrap();
        let result = gpu.run("s", |pass| target.record(pass, &image, size.into(), &mut structure));
        assert!(result.is_err(), "{size:?} {len}");
    }
}

/// The term on the last plane of a render; returns that plane of the gradient.
fn evaluate(weight: f64, size: UVec2, plane: &[f32], structure: &[f32]) -> (Logged, Vec<f32>) {
    let (gpu, pixels) = (gpu(), plane.len());
    let render = gpu.buffer("render", &[vec![9.0; 3 * pixels], plane.to_vec()].concat()).unwrap();
    let mut d_render = gpu.buffer("d_render", &vec![5.0f32; 4 * pixels]).unwrap();
    let mut loss = StructureLoss::new(&gpu, weight).unwrap();
    loss.add(size, gpu.buffer("structure", structure).unwrap()).unwrap();
    let inputs = term_inputs(size, FEATURES, &render, 1);
    let logged =
        log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log)).unwrap();
    let d_render = gpu.read(&d_render).unwrap();
    assert!(d_render[..3 * pixels].iter().all(|&d| d == 5.0), "another plane was written");
    (logged, d_render[3 * pixels..].to_vec())
}

#[test]
fn the_term_matches_its_reference_and_finite_differences() {
    for size in SIZES {
        let pixels = (size[0] * size[1]) as usize;
        let (render, structure) = (noise(5, pixels, -0.3, 1.3), noise(6, pixels, 0.0, 1.0));
        let weight = 0.01;
        let params = structure_l1::Params {
            pixel_count: pixels as u32,
            first: 0,
            scale: weight as f32 / pixels as f32,
        };
        let constants = structure_l1::Constants::default();
        let (d_render, partials) = (vec![f32::NAN; pixels], vec![0.0f32]);
        let (expected, sum) = run_reference!(
            structure_l1,
            constants,
            params,
            [render, structure],
            [d_render, partials]
        );
        let loss = |p: &[f64]| {
            let differences =
                p.iter().zip(&structure).map(|(p, &s)| (p.clamp(0.0, 1.0) - f64::from(s)).abs());
            weight * differences.sum::<f64>() / pixels as f64
        };
        assert_gradient("structure_l1", &expected, &central_differences(&widen(&render), loss));
        let (logged, actual) = evaluate(weight, size.into(), &render, &structure);
        assert_close("d_render", &actual, &expected, 1e-6 * largest(&expected));
        let mean = sum[0] / pixels as f32;
        assert!((logged.losses.get(Term::STRUCTURE) - mean).abs() <= 1e-6 + 1e-6 * mean);
        assert_eq!(logged.status, 0);
    }
}

#[test]
fn the_term_agrees_with_pytorch() {
    let torch = Torch::read();
    let (prior, target) = (torch.get("structure.prior"), torch.get("structure.target"));
    let (logged, d_prior) = evaluate(1.0, [31, 24].into(), prior, target);
    torch.assert_agrees("structure.value", &[logged.losses.get(Term::STRUCTURE)]);
    torch.assert_agrees("structure.d_prior", &d_prior);
}

#[test]
fn the_gradient_passes_the_clamp_within_its_bounds_only() {
    let (render, structure) = ([-0.1, 0.0, 0.5, 1.0, 1.1], [0.5, 0.5, 0.5, 0.5, 0.5]);
    let (_, d) = evaluate(1.0, [5, 1].into(), &render, &structure);
    assert_eq!(d, [0.0, -0.2, 0.0, 0.2, 0.0]);
}

#[test]
fn a_value_that_is_not_finite_reaches_the_log() {
    let mut render = noise(7, 100, 0.0, 1.0);
    render[57] = f32::NAN;
    let (logged, _) = evaluate(1.0, [10, 10].into(), &render, &noise(8, 100, 0.0, 1.0));
    assert_eq!(logged.losses.first_not_finite(), Some(Term::STRUCTURE));
    assert_eq!(logged.status, NOT_FINITE);
}

#[test]
fn buffers_and_views_that_do_not_fit_are_refused() {
    let gpu = gpu();
    assert!(StructureLoss::new(&gpu, -1.0).is_err() && StructureLoss::new(&gpu, f64::NAN).is_err());
    let mut loss = StructureLoss::new(&gpu, 1.0).unwrap();
    loss.add(UVec2::splat(8), gpu.zeros("structure", 64).unwrap()).unwrap();
    let render = gpu.zeros("render", 4 * 64).unwrap();
    let with_depth = Features { depth: true, ..FEATURES };
    for (size, features) in
        [([0, 8], FEATURES), ([8, 8], with_depth), ([9, 8], FEATURES), ([64, 64], FEATURES)]
    {
        let mut d_render = gpu.zeros("d_render", 4 * 64).unwrap();
        let inputs = term_inputs(size.into(), features, &render, 1);
        let logged =
            log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log));
        assert!(logged.is_err(), "{size:?} {features:?}");
    }
}
