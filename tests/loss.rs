//! The loss: its kernels against their references, its gradient against finite differences, its edge cases.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use glam::{UVec2, Vec3};
use nightsplat::gpu::testing::{assert_no_validation_messages, gpu};
use nightsplat::gpu::{Buffer, Gpu, Reference, Threads};
use nightsplat::kernels::{ToneParameters, l1, loss_log, ssim_backward, ssim_forward};
use nightsplat::loss::{Loss, LossInputs, LossLog, StepLoss};
use nightsplat::reference::ssim_backward::gradient;
use nightsplat::reference::ssim_forward::ssim;
use nightsplat::reference::tone::{CURVE_AP3, CURVE_ASE, CURVE_NONE};

const SIZES: [[u32; 2]; 8] =
    [[1, 1], [3, 1], [1, 40], [5, 7], [17, 33], [16, 64], [33, 65], [131, 97]];
const TONE: ToneParameters =
    ToneParameters { white: 0.12, offset: 0.05, gain: 1.07, constants: [0.0; 8] };
const NOT_FINITE: u32 = 2;

/// A dark photograph and a render that is off by a texture and by noise.
fn images([width, height]: [u32; 2]) -> [Vec<f32>; 2] {
    let mut state = 1u32;
    let mut noise = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let count = 3 * width * height;
    let low: Vec<f32> =
        (0..count).map(|i| 0.05 + 0.04 * (i as f32 * 0.37).sin() + 0.01 * noise()).collect();
    let render = (0..count).map(|i| 0.4 + 0.3 * (i as f32 * 0.31).cos() + 0.2 * noise()).collect();
    [render, low]
}

/// What one step of the loss leaves behind.
struct Outcome {
    loss: StepLoss,
    d_render: Vec<f32>,
    status: u32,
}

fn evaluate(
    gpu: &Gpu,
    curve: u32,
    weight: f64,
    size: [u32; 2],
    [render, low]: &[Vec<f32>; 2],
) -> Outcome {
    let size = UVec2::from_array(size);
    let mut loss = Loss::new(gpu, curve, weight, &[size]).unwrap();
    let [render, low] =
        [("render", render), ("low", low)].map(|(name, data)| gpu.buffer(name, data).unwrap());
    let tone = gpu.buffer("tone", &[TONE]).unwrap();
    let mut d_render = gpu.zeros("d_render", render.len()).unwrap();
    let mut log = gpu.zeros("log", 3).unwrap();
    let mut status = gpu.zeros("status", 1).unwrap();
    gpu.run("loss", |pass| {
        let inputs = LossInputs { size, render: &render, low: &low, tone: &tone };
        let log =
            LossLog { log: &mut log, slot: 1, status: &mut status, not_finite_flag: NOT_FINITE };
        loss.record(pass, inputs, &mut d_render, log)
    })
    .unwrap();
    let log = gpu.read(&log).unwrap();
    assert!([log[0], log[2]].iter().all(|other| other.l1 == 0.0 && other.ssim == 0.0));
    let status = gpu.read(&status).unwrap()[0];
    Outcome { loss: log[1], d_render: gpu.read(&d_render).unwrap(), status }
}

/// The first mismatches, so that a failure shows its pattern.
fn assert_close(what: &str, actual: &[f32], expected: &[f32], tolerance: f32) {
    // Positive phrasing: a NaN is a mismatch.
    let is_close = |i: usize| (actual[i] - expected[i]).abs() <= tolerance;
    let bad: Vec<_> = (0..expected.len())
        .filter(|&i| !is_close(i))
        .map(|i| (i, actual[i], expected[i]))
        .take(10)
        .collect();
    assert!(bad.is_empty(), "{what}, tolerance {tolerance}: (index, actual, expected) {bad:?}");
}

fn largest(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |largest, value| value.abs().max(largest))
}

/// Runs both SSIM kernels with their references beside them, with strips of `shape` columns and rows.
fn check_ssim_kernels(gpu: &Gpu, curve: u32, [columns, rows]: [u32; 2], size: [u32; 2]) {
    let [width, height] = size;
    let [render, low] = images(size);
    let count = render.len();
    let threads = 3 * width.div_ceil(columns) * height.div_ceil(rows);
    let forward_constants = ssim_forward::Constants { columns, rows, tone_curve: curve };
    let backward_constants = ssim_backward::Constants { columns, rows, tone_curve: curve };
    let forward_params = ssim_forward::Params { width, height };
    let scale = 1.0 / count as f32;
    let backward_params =
        ssim_backward::Params { width, height, l1_scale: 0.8 * scale, ssim_scale: 0.2 * scale };

    let (mut d_moments, mut d_render) = (vec![Vec3::ZERO; count], vec![0.0; count]);
    let (mut ssim_sum, mut l1_sum) = (vec![0.0], vec![0.0]);
    let tone = [TONE];
    let slices = ssim_forward::Slices {
        render: &render,
        low: &low,
        tone: &tone,
        d_moments: &mut d_moments,
        partials: &mut ssim_sum,
    };
    ssim_forward::Kernel::run(&forward_params, &forward_constants, slices);
    let slices = ssim_backward::Slices {
        render: &render,
        low: &low,
        tone: &tone,
        d_moments: &d_moments,
        d_render: &mut d_render,
        partials: &mut l1_sum,
    };
    ssim_backward::Kernel::run(&backward_params, &backward_constants, slices);

    let [render, low] =
        [("render", &render), ("low", &low)].map(|(name, data)| gpu.buffer(name, data).unwrap());
    let tone = gpu.buffer("tone", &tone).unwrap();
    let mut gpu_d_moments = gpu.zeros("d_moments", count).unwrap();
    let mut gpu_d_render = gpu.zeros("d_render", count).unwrap();
    let mut ssim_partials = gpu.zeros("ssim_partials", threads as usize).unwrap();
    let mut l1_partials = gpu.zeros("l1_partials", threads as usize).unwrap();
    let forward = gpu.pipeline::<ssim_forward::Kernel>(&forward_constants).unwrap();
    let backward = gpu.pipeline::<ssim_backward::Kernel>(&backward_constants).unwrap();
    gpu.run("ssim", |pass| {
        let buffers = ssim_forward::Buffers {
            render: &render,
            low: &low,
            tone: &tone,
            d_moments: &mut gpu_d_moments,
            partials: &mut ssim_partials,
        };
        pass.dispatch(&forward, &forward_params, buffers, Threads::Exactly([threads, 1, 1]))?;
        let buffers = ssim_backward::Buffers {
            render: &render,
            low: &low,
            tone: &tone,
            d_moments: &gpu_d_moments,
            d_render: &mut gpu_d_render,
            partials: &mut l1_partials,
        };
        pass.dispatch(&backward, &backward_params, buffers, Threads::Exactly([threads, 1, 1]))
    })
    .unwrap();

    let sum = |partials: &Buffer<f32>| gpu.read(partials).unwrap().iter().sum::<f32>();
    let near = |actual: f32, expected: f32| (actual - expected).abs() <= 1e-5 * count as f32;
    let context = format!("{width} x {height} in strips of {columns} x {rows}");
    assert!(
        near(sum(&ssim_partials), ssim_sum[0]),
        "{context}: SSIM {} {}",
        sum(&ssim_partials),
        ssim_sum[0]
    );
    assert!(
        near(sum(&l1_partials), l1_sum[0]),
        "{context}: L1 {} {}",
        sum(&l1_partials),
        l1_sum[0]
    );
    // The variances lose about 1e-7 of a squared mean near 1 to cancellation, against a floor of C2 = 9e-4.
    let actual: Vec<f32> =
        gpu.read(&gpu_d_moments).unwrap().iter().flat_map(|d| d.to_array()).collect();
    let expected: Vec<f32> = d_moments.iter().flat_map(|d| d.to_array()).collect();
    assert_close(&context, &actual, &expected, 1e-3 * largest(&expected));
    assert_close(&context, &gpu.read(&gpu_d_render).unwrap(), &d_render, 1e-3 * largest(&d_render));
}

#[test]
fn the_ssim_kernels_match_their_references_at_every_size() {
    let gpu = gpu();
    for size in SIZES {
        check_ssim_kernels(&gpu, CURVE_AP3, [16, 64], size);
    }
    assert_no_validation_messages();
}

#[test]
fn the_shape_of_the_strips_does_not_matter() {
    let gpu = gpu();
    for (shape, curve) in [([2, 32], CURVE_ASE), ([1, 1], CURVE_NONE), ([5, 7], CURVE_AP3)] {
        check_ssim_kernels(&gpu, curve, shape, [37, 41]);
    }
    assert_no_validation_messages();
}

#[test]
fn l1_matches_its_reference() {
    let gpu = gpu();
    for size in SIZES {
        let [render, low] = images(size);
        let count = render.len() as u32;
        let params = l1::Params { value_count: count, l1_scale: 1.0 / count as f32 };
        let constants = l1::Constants { tone_curve: CURVE_ASE, ..Default::default() };
        let (mut expected, mut sum) = (vec![0.0; count as usize], [0.0]);
        let slices = l1::Slices {
            render: &render,
            low: &low,
            tone: &[TONE],
            d_render: &mut expected,
            partials: &mut sum,
        };
        l1::Kernel::run(&params, &constants, slices);
        let outcome = evaluate(&gpu, CURVE_ASE, 0.0, size, &[render, low]);
        assert_close("d_render", &outcome.d_render, &expected, 0.0);
        assert!((outcome.loss.l1 - sum[0] / count as f32).abs() < 1e-6);
        assert_eq!(outcome.loss.ssim, 0.0, "SSIM is not modelled at weight 0");
    }
    assert_no_validation_messages();
}

#[test]
fn loss_log_matches_its_reference() {
    let gpu = gpu();
    let pipeline = gpu.pipeline::<loss_log::Kernel>(&loss_log::Constants::default()).unwrap();
    let partials: Vec<f32> = (0..1000).map(|i| 300.0 + (i as f32 * 0.7).sin()).collect();
    let l1_partials = gpu.buffer("l1_partials", &partials).unwrap();
    let ssim_partials = gpu.buffer("ssim_partials", &partials).unwrap();
    for (l1_partial_count, ssim_partial_count) in [(0, 0), (1, 0), (7, 8), (9, 33), (1000, 999)] {
        let params = loss_log::Params {
            slot: 2,
            l1_partial_count,
            ssim_partial_count,
            mean_scale: 1.0 / 300.0,
            not_finite_flag: NOT_FINITE,
        };
        let (mut expected, mut expected_status) = ([StepLoss::default(); 4], [1]);
        let slices = loss_log::Slices {
            l1_partials: &partials,
            ssim_partials: &partials,
            log: &mut expected,
            status: &mut expected_status,
        };
        loss_log::Kernel::run(&params, &loss_log::Constants::default(), slices);
        let mut log = gpu.zeros::<StepLoss>("log", 4).unwrap();
        let mut status = gpu.buffer("status", &[1]).unwrap();
        gpu.run("loss_log", |pass| {
            let buffers = loss_log::Buffers {
                l1_partials: &l1_partials,
                ssim_partials: &ssim_partials,
                log: &mut log,
                status: &mut status,
            };
            pass.dispatch(&pipeline, &params, buffers, Threads::Workgroups([1, 1, 1]))
        })
        .unwrap();
        for (actual, expected) in gpu.read(&log).unwrap().iter().zip(expected) {
            assert!(
                (actual.l1 - expected.l1).abs() <= 1e-6 * expected.l1,
                "{actual:?} {expected:?}"
            );
            assert!(
                (actual.ssim - expected.ssim).abs() <= 1e-6 * expected.ssim,
                "{actual:?} {expected:?}"
            );
        }
        assert_eq!(gpu.read(&status).unwrap(), expected_status);
    }
    assert_no_validation_messages();
}

/// (1 - w) mean|a - b| + w (1 - mean SSIM) of one channel.
fn loss_of([width, height]: [usize; 2], weight: f64, a: &[f64], b: &[f64]) -> f64 {
    let count = a.len() as f64;
    let l1: f64 = a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum();
    let ssim: f64 = ssim(width, height, a, b).iter().map(|ssim| ssim.value).sum();
    (1.0 - weight) * l1 / count + weight * (1.0 - ssim / count)
}

#[test]
fn the_reference_gradient_is_that_of_finite_differences() {
    for size in [[1, 1], [3, 1], [5, 7], [13, 17]] {
        let count = size[0] * size[1];
        let weight = 0.2;
        let b: Vec<f64> = (0..count).map(|i| 0.5 + 0.4 * (i as f64 * 0.7).sin()).collect();
        // Away from a = b, where |a - b| has no derivative.
        let a: Vec<f64> = (0..count).map(|i| b[i] + if i % 3 == 0 { 0.2 } else { -0.3 }).collect();
        let d_moments: Vec<_> =
            ssim(size[0], size[1], &a, &b).iter().map(|s| s.d_moments).collect();
        let scales = [(1.0 - weight) / count as f64, weight / count as f64];
        let analytic = gradient(size, scales, &a, &b, &d_moments);
        for i in 0..count {
            let h = 1e-6;
            let shifted = |by: f64| {
                let mut a = a.clone();
                a[i] += by;
                loss_of(size, weight, &a, &b)
            };
            let numeric = (shifted(h) - shifted(-h)) / (2.0 * h);
            assert!(
                (numeric - analytic[i]).abs() < 1e-8,
                "{size:?} at {i}: {numeric} {}",
                analytic[i]
            );
        }
    }
}

#[test]
fn an_image_compared_with_itself_costs_nothing() {
    let gpu = gpu();
    let [_, low] = images([40, 30]);
    let outcome = evaluate(
        &gpu,
        CURVE_NONE,
        0.2,
        [40, 30],
        &[low.iter().map(|x| x / TONE.white).collect(), low],
    );
    assert!(outcome.loss.l1 < 1e-7, "{:?}", outcome.loss);
    assert!((outcome.loss.ssim - 1.0).abs() < 1e-6, "{:?}", outcome.loss);
    assert!(largest(&outcome.d_render) < 1e-6, "{}", largest(&outcome.d_render));
    assert_eq!(outcome.status, 0);
    assert_no_validation_messages();
}

#[test]
fn constant_images_have_the_ssim_of_their_means_inside() {
    let gpu = gpu();
    let size = [64, 48];
    let (a, b) = (0.5f32, 0.25f32);
    let count = (3 * size[0] * size[1]) as usize;
    let outcome =
        evaluate(&gpu, CURVE_NONE, 0.2, size, &[vec![a; count], vec![b * TONE.white; count]]);
    assert!((outcome.loss.l1 - 0.25).abs() < 1e-6);
    // Zero padding changes the border; inside, variances vanish and (2ab + C1) / (a^2 + b^2 + C1) remains.
    let inside = f64::from((2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4));
    let plane = [vec![f64::from(a); count / 3], vec![f64::from(b); count / 3]];
    let map = ssim(size[0] as usize, size[1] as usize, &plane[0], &plane[1]);
    assert!((map[24 * 64 + 32].value - inside).abs() < 1e-6);
    let mean = map.iter().map(|ssim| ssim.value).sum::<f64>() / map.len() as f64;
    assert!((f64::from(outcome.loss.ssim) - mean).abs() < 1e-5, "{} {mean}", outcome.loss.ssim);
    assert_no_validation_messages();
}

#[test]
fn black_images_have_a_finite_gradient() {
    let gpu = gpu();
    let count = 3 * 20 * 20;
    let outcome = evaluate(&gpu, CURVE_NONE, 0.5, [20, 20], &[vec![0.0; count], vec![0.0; count]]);
    assert!((outcome.loss.ssim - 1.0).abs() < 1e-6);
    assert!(outcome.d_render.iter().all(|d| d.abs() < 1e-6));
    assert_no_validation_messages();
}

/// Squares near 4e4 round by more than C2: without the floor under the variances the denominator turns negative.
#[test]
fn a_render_that_is_far_too_bright_keeps_its_ssim_positive() {
    let gpu = gpu();
    let count = 3 * 48 * 48;
    for brightness in [150.1f32, 170.3, 190.7, 210.9, 230.3, 250.7] {
        let outcome = evaluate(
            &gpu,
            CURVE_NONE,
            1.0,
            [48, 48],
            &[vec![brightness; count], vec![0.06; count]],
        );
        assert!(outcome.loss.ssim > 0.0, "{brightness}: {:?}", outcome.loss);
        assert_eq!(outcome.status, 0);
    }
    assert_no_validation_messages();
}

#[test]
fn a_value_that_is_not_finite_reaches_the_log_and_the_status() {
    let gpu = gpu();
    for (value, weight) in
        [(f32::NAN, 0.2), (f32::NAN, 0.0), (f32::INFINITY, 0.2), (f32::NEG_INFINITY, 0.0)]
    {
        let [mut render, low] = images([50, 70]);
        render[1234] = value;
        let outcome = evaluate(&gpu, CURVE_AP3, weight, [50, 70], &[render, low]);
        assert!(!outcome.loss.l1.is_finite(), "{value} at weight {weight}: {:?}", outcome.loss);
        assert_eq!(outcome.status, NOT_FINITE);
    }
    assert_no_validation_messages();
}

#[test]
fn the_same_step_leaves_the_same_bits() {
    let gpu = gpu();
    let inputs = images([131, 97]);
    let bits = || {
        let outcome = evaluate(&gpu, CURVE_AP3, 0.2, [131, 97], &inputs);
        let d_render: Vec<u32> = outcome.d_render.iter().map(|d| d.to_bits()).collect();
        (outcome.loss.l1.to_bits(), outcome.loss.ssim.to_bits(), d_render)
    };
    let first = bits();
    for _ in 0..5 {
        assert!(bits() == first);
    }
    assert_no_validation_messages();
}

#[test]
fn a_weight_outside_its_range_is_refused() {
    let gpu = gpu();
    for weight in [-0.1, 1.1, f64::NAN] {
        assert!(Loss::new(&gpu, CURVE_AP3, weight, &[]).is_err());
    }
}

/// A kernel that ran on would write beyond its buffers.
#[test]
fn a_view_that_does_not_fit_is_refused() {
    let gpu = gpu();
    let tone = gpu.buffer("tone", &[TONE]).unwrap();
    let image = gpu.zeros("image", 3 * 64).unwrap();
    for (weight, size, slot) in [
        (0.2, [9, 8], 0),
        (0.0, [9, 8], 0),
        (0.2, [0, 8], 0),
        // As many values, but more strips than there are partial sums.
        (0.2, [64, 1], 0),
        (0.2, [8, 8], 1),
        (0.2, [u32::MAX, u32::MAX], 0),
    ] {
        let mut loss = Loss::new(&gpu, CURVE_AP3, weight, &[UVec2::splat(8)]).unwrap();
        let mut d_render = gpu.zeros("d_render", 3 * 64).unwrap();
        let mut log = gpu.zeros("log", 1).unwrap();
        let mut status = gpu.zeros("status", 1).unwrap();
        let result = gpu.run("loss", |pass| {
            let size = UVec2::from_array(size);
            let inputs = LossInputs { size, render: &image, low: &image, tone: &tone };
            let log = LossLog { log: &mut log, slot, status: &mut status, not_finite_flag: 1 };
            loss.record(pass, inputs, &mut d_render, log)
        });
        assert!(result.is_err(), "{weight} {size:?} {slot}");
    }
    assert_no_validation_messages();
}
