//! The depth term.

use nightsplat::kernels::{
    DepthGradient, DepthMoments, depth_boxes, depth_correlation, depth_gradient, depth_moments,
};
use nightsplat::loss::{DepthBoxes, DepthLoss, LossTerm as _, Term};

use super::{
    Logged, NOT_FINITE, Torch, assert_close, assert_gradient, bits, central_differences, largest,
    log_step, noise, term_inputs, widen,
};

use crate::common::prelude::*;

const FEATURES: Features = Features { depth: true, ..Features::NONE };

/// Views and the side of their boxes.
const CASES: [([u32; 2], u32); 7] = [
    ([1, 1], 8),
    ([3, 1], 8),
    ([5, 7], 2),
    ([33, 17], 8),
    ([33, 17], 17),
    ([40, 64], 9),
    ([131, 97], 32),
];

/// A rendered and an estimated depth that are correlated.
fn depths([width, height]: [u32; 2]) -> [Vec<f32>; 2] {
    let pixels = (width * height) as usize;
    let depth = noise(1, pixels, 0.2, 0.8);
    let noise = noise(2, pixels, -0.2, 0.2);
    let render = depth.iter().zip(&noise).map(|(depth, noise)| 3.0 + 2.0 * depth + noise).collect();
    [render, depth]
}

/// The regions of a step, the view first, as drawn by the reference.
fn regions_of(size: UVec2, side: u32, key: u32) -> Vec<[u32; 4]> {
    let boxes = DepthBoxes::new(size, side);
    let params = depth_boxes::Params { size, side: boxes.side, box_count: boxes.count, key };
    let regions = vec![[7; 4]; boxes.count as usize + 1];
    run_reference!(depth_boxes, depth_boxes::Constants {}, params, [], [regions])
}

/// P by its definition, in double precision; 1 for a constant.
fn pearson(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len() as f64;
    let standard = |x: &[f64]| -> Vec<f64> {
        let mean = x.iter().sum::<f64>() / n;
        let squares: f64 = x.iter().map(|x| (x - mean).powi(2)).sum();
        let deviation = (squares / (n - 1.0).max(1.0)).sqrt();
        x.iter().map(|x| (x - mean) / (deviation + 1e-6)).collect()
    };
    1.0 - standard(a).iter().zip(standard(b)).map(|(a, b)| a * b).sum::<f64>() / n
}

/// P of a region of planes of `width` columns.
fn pearson_of(width: u32, [left, top, w, h]: [u32; 4], a: &[f64], b: &[f64]) -> f64 {
    let crop = |plane: &[f64]| -> Vec<f64> {
        (0..w * h).map(|i| plane[((top + i / w) * width + left + i % w) as usize]).collect()
    };
    pearson(&crop(a), &crop(b))
}

/// The results of the last kernels.
struct Chain {
    view_values: Vec<f32>,
    box_values: Vec<f32>,
    d_render: Vec<f32>,
}

/// Runs the kernels after the boxes, or their references, on plane 1 of a render of two planes.
macro_rules! chain {
    ($run:ident, $size:expr, $regions:expr, $weights:expr, $images:expr, $chunk_size:expr $(, $threads:ident)?) => {{
        let (size, regions, chunk_size): (UVec2, Vec<[u32; 4]>, u32) = ($size, $regions, $chunk_size);
        let [plane, depth]: [Vec<f32>; 2] = $images;
        let [view_weight, box_weight]: [f32; 2] = $weights;
        let (pixels, boxes) = (size.element_product(), regions.len() as u32 - 1);
        let render = [vec![9.0; pixels as usize], plane].concat();
        let (width, first, view_chunks) = (size.x, pixels, pixels.div_ceil(chunk_size));
        let box_chunks = regions.get(1).map_or(0, |of| (of[2] * of[3]).div_ceil(chunk_size));
        let chunk_count = view_chunks + boxes * box_chunks;
        let params =
            depth_moments::Params { width, first, view_chunks, box_chunks, chunk_count, chunk_size };
        let moments = vec![DepthMoments::default(); chunk_count as usize];
        let moments = $run!(
            depth_moments, depth_moments::Constants::default(), params,
            $($threads::Workgroups([chunk_count, 1, 1]),)? [render, depth, regions], [moments]
        );
        let params = depth_correlation::Params {
            width, first, view_chunks, box_chunks, region_count: boxes + 1, chunk_size, view_weight,
            box_weight,
        };
        let gradients = vec![DepthGradient::default(); regions.len()];
        let (view_values, box_values) = (vec![f32::NAN], vec![f32::NAN; boxes as usize]);
        let (gradients, view_values, box_values) = $run!(
            depth_correlation, depth_correlation::Constants::default(), params,
            $($threads::Workgroups([boxes + 1, 1, 1]),)? [render, depth, regions, moments],
            [gradients, view_values, box_values]
        );
        let params = depth_gradient::Params { size, first, region_count: boxes + 1 };
        let d_render = vec![5.0f32; 2 * pixels as usize];
        let d_render = $run!(
            depth_gradient, depth_gradient::Constants {}, params,
            $($threads::Exactly([pixels, 1, 1]),)? [render, depth, regions, gradients], [d_render]
        );
        assert!(d_render[..pixels as usize].iter().all(|&d| d == 5.0), "another plane was written");
        let d_render = d_render[pixels as usize..].to_vec();
        Chain { view_values, box_values, d_render }
    }};
}

/// Pixels of a chunk on the device.
fn chunk_size() -> u32 {
    gpu().properties().subgroup_size * depth_moments::Constants::default().values_per_thread
}

#[test]
fn the_kernels_match_their_references() {
    for (size, side) in CASES {
        let (_, report) = agreeing(|| evaluate(0.1, side, size, &depths(size), 11));
        assert_eq!(report.passes.len(), 5, "boxes, moments, correlation, gradient, log");
    }
}

#[test]
fn the_reference_gradient_agrees_with_finite_differences() {
    for (size, side) in CASES.into_iter().filter(|(size, _)| size[0] * size[1] < 3000) {
        let images = depths(size);
        let regions = regions_of(size.into(), side, 12);
        let boxes = (regions.len() - 1).max(1) as f64;
        let weights = [0.1, (0.2 / boxes) as f32];
        let [a, b] = [widen(&images[0]), widen(&images[1])];
        let numeric = central_differences(&a, |a| {
            let of = |&region| pearson_of(size[0], region, a, &b);
            0.1 * of(&regions[0]) + 0.2 / boxes * regions[1..].iter().map(of).sum::<f64>()
        });
        let chain = chain!(run_reference, size.into(), regions, weights, images, 100);
        assert_gradient("depth", &chain.d_render, &numeric);
    }
}

#[test]
fn the_term_agrees_with_pytorch() {
    let torch = Torch::read();
    let images = || [torch.get("depth.rendered").to_vec(), torch.get("depth.monocular").to_vec()];
    let mut regions = vec![[0, 0, 31, 24]];
    for corner in torch.get("depth.corners").chunks(2) {
        regions.push([corner[1] as u32, corner[0] as u32, 8, 8]);
    }
    let size = UVec2::new(31, 24);
    let view =
        chain!(run_kernel, size, regions.clone(), [1.0, 0.0], images(), chunk_size(), Threads);
    torch.assert_agrees("depth.global.value", &view.view_values);
    torch.assert_agrees("depth.global.d_rendered", &view.d_render);
    let boxes = chain!(run_kernel, size, regions, [0.0, 0.5], images(), chunk_size(), Threads);
    torch.assert_agrees("depth.local.value", &[boxes.box_values.iter().sum::<f32>() / 2.0]);
    torch.assert_agrees("depth.local.d_rendered", &boxes.d_render);
}

#[test]
fn boxes_are_inside_the_view_and_anywhere_in_it() {
    let size = UVec2::new(61, 47);
    let boxes = DepthBoxes::new(size, 5);
    let mut corners = vec![];
    for key in [0, 1, 77, u32::MAX] {
        let params = depth_boxes::Params { size, side: boxes.side, box_count: boxes.count, key };
        let regions = vec![[7u32; 4]; boxes.count as usize + 1];
        let constants = depth_boxes::Constants {};
        let expected = run_reference!(depth_boxes, constants, params, [], [regions]);
        let threads = Threads::Exactly([boxes.count + 1, 1, 1]);
        let actual = run_kernel!(depth_boxes, constants, params, threads, [], [regions]);
        assert_eq!(actual, expected);
        assert_eq!(actual[0], [0, 0, 61, 47]);
        corners.extend(actual[1..].iter().map(|&[x, y, w, h]| {
            assert_eq!([w, h], [5, 5]);
            assert!(x < 56 && y < 42, "{x} {y}");
            Vec2::new(x as f32 / 56.0, y as f32 / 42.0)
        }));
    }
    let mean = corners.iter().sum::<Vec2>() / corners.len() as f32;
    assert!((mean - 0.48).abs().max_element() < 0.08, "{mean} of {}", corners.len());
    assert!(corners.iter().any(|c| c.min_element() > 0.8));
    assert!(corners.iter().any(|c| c.max_element() < 0.2));
}

#[test]
fn a_view_smaller_than_a_box_has_smaller_boxes_and_a_tiny_view_none() {
    let boxes = |width, height, side| {
        let DepthBoxes { side, count } = DepthBoxes::new(UVec2::new(width, height), side);
        (side, count)
    };
    // The sizes of LOM and RealX3D with the paper's rule: half of those that fit, rounded down.
    assert_eq!(boxes(500, 375, 128), (128, 3));
    assert_eq!(boxes(1600, 1061, 128), (128, 48));
    assert_eq!(boxes(128, 128, 128), (128, 1));
    assert_eq!(boxes(200, 100, 128), (50, 4));
    assert_eq!(boxes(4, 5, 128), (2, 2));
    assert_eq!(boxes(3, 500, 128), (0, 0));
    assert_eq!(boxes(1, 1, 128), (0, 0));
}

/// The whole term on the last plane of a render; returns that plane of the gradient.
fn evaluate(
    weight: f64,
    box_side: u32,
    size: [u32; 2],
    [plane, depth]: &[Vec<f32>; 2],
    step: u64,
) -> (Logged, Vec<f32>) {
    let (gpu, colors) = (gpu(), 3 * plane.len());
    let render = gpu.buffer("render", &[&vec![9.0; colors], &**plane].concat()).unwrap();
    let mut d_render = gpu.buffer("d_render", &vec![f32::NAN; render.len()]).unwrap();
    let mut loss = DepthLoss::new(&gpu, weight, box_side, Stream::new(10, 5)).unwrap();
    loss.reserve(size.into()).unwrap();
    loss.add(Some(depth)).unwrap();
    let inputs = term_inputs(size.into(), FEATURES, &render, step);
    let logged =
        log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log)).unwrap();
    (logged, gpu.read(&d_render).unwrap().split_off(colors))
}

#[test]
fn the_term_is_the_mean_over_the_view_and_over_its_boxes() {
    for (size, box_side) in CASES {
        let images = depths(size);
        let (logged, d_render) = evaluate(0.3, box_side, size, &images, 4);
        let key = (Stream::new(10, 5).bits(4) >> 32) as u32;
        let regions = regions_of(size.into(), box_side, key);
        let [a, b] = [widen(&images[0]), widen(&images[1])];
        let values: Vec<f64> =
            regions.iter().map(|&region| pearson_of(size[0], region, &a, &b)).collect();
        let boxes = regions.len() - 1;
        let local = values[1..].iter().sum::<f64>() / boxes.max(1) as f64;
        let close = |actual: f32, expected: f64| (f64::from(actual) - expected).abs() < 2e-5;
        assert!(close(logged.losses.get(Term::DEPTH), values[0]), "{size:?}");
        assert!(close(logged.losses.get(Term::DEPTH_LOCAL), local), "{size:?}");
        assert_eq!(logged.status, 0);
        let weights = [0.3, 0.3 / boxes.max(1) as f32];
        let expected = chain!(run_reference, size.into(), regions, weights, images, chunk_size());
        let tolerance = 1e-4 * largest(&expected.d_render);
        assert_close("d_render", &d_render, &expected.d_render, tolerance);
    }
}

/// A rounding error of the mean would cause a deviation of 1e-8, and a gradient of 1e8.
#[test]
fn a_constant_depth_has_no_correlation_and_no_gradient() {
    let size = [77, 50];
    let [render, depth] = depths(size);
    let constant = |value: f32| vec![value; 77 * 50];
    for images in [
        [constant(0.3), depth],
        [render, constant(0.7)],
        [constant(0.0), constant(0.0)],
        [constant(12345.678), constant(0.1)],
    ] {
        let (logged, d_render) = evaluate(1.0, 20, size, &images, 0);
        assert_eq!(logged.losses.get(Term::DEPTH), 1.0);
        assert_eq!(logged.losses.get(Term::DEPTH_LOCAL), 1.0);
        assert!(d_render.iter().all(|&d| d == 0.0));
    }
}

#[test]
fn scale_and_offset_of_the_estimate_do_not_matter() {
    let size = [77, 50];
    let [render, depth] = depths(size);
    let farther: Vec<f32> = depth.iter().map(|d| 5.0 * d + 7.0).collect();
    let [(near, d_near), (far, d_far)] =
        [depth, farther].map(|depth| evaluate(1.0, 20, size, &[render.clone(), depth], 0));
    for term in [Term::DEPTH, Term::DEPTH_LOCAL] {
        assert!((near.losses.get(term) - far.losses.get(term)).abs() < 1e-5);
    }
    assert_close("d_render", &d_far, &d_near, 1e-4 * largest(&d_near));
}

#[test]
fn a_value_that_is_not_finite_reaches_the_log() {
    for (at, value) in [(0, f32::NAN), (1234, f32::NAN), (1234, f32::INFINITY)] {
        let [mut render, depth] = depths([77, 50]);
        render[at] = value;
        let images = [render, depth];
        let (logged, _) = evaluate(0.1, 128, [77, 50], &images, 0);
        assert_eq!(logged.losses.first_not_finite(), Some(Term::DEPTH), "{value} at {at}");
        assert_eq!(logged.status, NOT_FINITE);
    }
}

#[test]
fn the_same_step_leaves_the_same_bits_and_another_step_other_boxes() {
    let size = [131, 97];
    let images = depths(size);
    let step = |step: u64| {
        let (logged, d_render) = evaluate(1.0, 24, size, &images, step);
        let values = [Term::DEPTH, Term::DEPTH_LOCAL].map(|term| logged.losses.get(term));
        (bits(&values), bits(&d_render))
    };
    let first = step(3);
    assert!((0..5).all(|_| step(3) == first));
    let other = step(4);
    assert_eq!(other.0[0], first.0[0]);
    assert_ne!(other.0[1], first.0[1]);
}

#[test]
fn buffers_and_views_that_do_not_fit_are_refused() {
    let gpu = gpu();
    for (weight, box_side) in [(-0.1, 128), (f64::NAN, 128), (0.1, 1), (0.1, 0)] {
        assert!(DepthLoss::new(&gpu, weight, box_side, Stream::new(0, 0)).is_err());
    }
    let mut loss = DepthLoss::new(&gpu, 0.1, 4, Stream::new(0, 0)).unwrap();
    loss.reserve(UVec2::splat(16)).unwrap();
    // Wide subgroups need less scratch memory.
    let is_narrow = gpu.properties().subgroup_size <= 8;
    // Narrower than any box, with more chunks than all boxes of the view reserved for.
    let strip = [3, 16 * chunk_size()];
    let long = 3 * strip[1] as usize;
    loss.add(Some(&vec![0.5; long])).unwrap();
    let mut refuses = |len: usize, size: [u32; 2], why: &str| {
        let [render, mut d_render] = [0; 2].map(|_| gpu.zeros("render", len).unwrap());
        let inputs = term_inputs(size.into(), FEATURES, &render, 0);
        let logged =
            log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log));
        let refused = logged.err().unwrap().to_string();
        assert!(refused.contains(why), "{size:?}: {refused}");
    };
    refuses(4 * 256, [0, 8], "no scratch memory for a view of 0 x 8");
    refuses(3 * 256, [16, 16], "holds 768 elements, not 1024");
    let wide = if is_narrow { "no scratch memory for a view of 17 x 16" } else { "not 1088" };
    refuses(4 * 256, [17, 16], wide);
    refuses(long, [256, 256], "no scratch memory for a view of 256 x 256");
    refuses(long, strip, "no scratch memory for a view of 3 x");
}

/// There are enough chunks, but not enough regions.
#[test]
fn more_boxes_than_were_reserved_for_are_refused() {
    let gpu = gpu();
    let mut loss = DepthLoss::new(&gpu, 0.1, 4, Stream::new(0, 0)).unwrap();
    for size in [[16, 16], [3, 64 * chunk_size()]] {
        loss.reserve(size.into()).unwrap();
    }
    loss.add(Some(&[0.5; 512])).unwrap();
    let [render, mut d_render] = [0; 2].map(|_| gpu.zeros("render", 4 * 512).unwrap());
    let inputs = term_inputs([32, 16].into(), FEATURES, &render, 0);
    let logged = log_step(&gpu, |pass, log| loss.record_step(pass, &inputs, &mut d_render, log));
    let refused = logged.err().unwrap().to_string();
    assert!(refused.contains("no scratch memory for a view of 32 x 16"), "{refused}");
}
