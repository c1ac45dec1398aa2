//! L1 and SSIM of an image.

use nightsplat::Result;
use nightsplat::kernels::ssim;
use nightsplat::loss::{Gradient, Loss, LossInputs, LossRegion, Term};
use nightsplat::reference::ssim::{gradient, ssim};

use super::{NOT_FINITE, Torch, assert_close, bits, central_differences, largest, log_step};
use crate::common::prelude::*;

const SIZES: [[u32; 2]; 8] =
    [[1, 1], [3, 1], [1, 40], [5, 7], [17, 33], [16, 64], [33, 65], [131, 97]];

/// A target, and a render that differs by a texture and noise.
fn images([width, height]: [u32; 2]) -> [Vec<f32>; 2] {
    let mut state = 1u32;
    let mut noise = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let count = 3 * width * height;
    let target: Vec<f32> =
        (0..count).map(|i| 0.45 + 0.35 * (i as f32 * 0.37).sin() + 0.1 * noise()).collect();
    let render = (0..count).map(|i| 0.4 + 0.3 * (i as f32 * 0.31).cos() + 0.2 * noise()).collect();
    [render, target]
}

/// The results of one step of the loss.
struct Outcome {
    l1: f32,
    ssim: f32,
    d_render: Vec<f32>,
    status: u32,
}

fn loss(gpu: &Gpu, ssim_weight: f64) -> Result<Loss> {
    Loss::new(gpu, ssim_weight, [Term::L1, Term::SSIM], Gradient::Written)
}

fn evaluate(gpu: &Gpu, weight: f64, size: [u32; 2], images: &[Vec<f32>; 2]) -> Outcome {
    evaluate_loss_region(gpu, weight, size, LossRegion::whole(size.into()), images)
}

fn evaluate_loss_region(
    gpu: &Gpu,
    weight: f64,
    size: [u32; 2],
    loss_region: LossRegion,
    [render, target]: &[Vec<f32>; 2],
) -> Outcome {
    let size = UVec2::from_array(size);
    let mut loss = loss(gpu, weight).unwrap();
    loss.reserve(size).unwrap();
    let [render, target] = [("render", render), ("target", target)]
        .map(|(name, data)| gpu.buffer(name, data).unwrap());
    let mut d_render = gpu.buffer("d_render", &vec![f32::NAN; render.len()]).unwrap();
    let logged = log_step(gpu, |pass, log| {
        let inputs = LossInputs { size, loss_region, render: &render, target: &target };
        loss.record(pass, inputs, &mut d_render, log)
    })
    .unwrap();
    let [l1, ssim] = [Term::L1, Term::SSIM].map(|term| logged.losses.get(term));
    Outcome { l1, ssim, d_render: gpu.read(&d_render).unwrap(), status: logged.status }
}

/// The kernels of a CPU and those of a GPU, on the same device.
fn on_both_plans(test: impl Fn(&Gpu)) {
    static PLANS: OnceLock<[Gpu; 2]> = OnceLock::new();
    PLANS
        .get_or_init(|| {
            [true, false].map(|is_cpu| gpu_with(|properties| properties.is_cpu = is_cpu))
        })
        .iter()
        .for_each(test);
}

/// Compares the SSIM kernel with its reference: `shape` is the columns of a lane, the rows of a subgroup, and the
/// alignment of loads and stores in floats.
fn check_ssim(shape: [u32; 3], size: [u32; 2], loss_region: LossRegion) -> Vec<f32> {
    let ([columns, rows, alignment], [width, height]) = (shape, size);
    let [render, target] = images(size);
    let scale = 1.0 / render.len() as f32;
    let lanes = gpu().properties().subgroup_size;
    let halo = 10u32.next_multiple_of(alignment);
    // In a strip of the narrowest shape, a subgroup of four has no outputs besides the windows' ends.
    let columns = columns.max((2 * halo / lanes + 1).next_multiple_of(alignment));
    let outputs = lanes * columns - 2 * halo;
    let count = 3 * width.div_ceil(outputs) * height.div_ceil(rows);
    let d_render = vec![f32::NAN; render.len()];
    let [l1_partials, ssim_partials] = [(); 2].map(|()| vec![f32::NAN; count as usize]);
    run_kernel!(
        ssim,
        ssim::Constants { columns, rows, alignment, adds: false },
        ssim::Params {
            width,
            height,
            loss_begin: loss_region.origin,
            loss_end: loss_region.origin + loss_region.size,
            l1_scale: 0.8 * scale,
            ssim_scale: 0.2 * scale,
        },
        Threads::Workgroups([count, 1, 1]),
        [render, target],
        [d_render, l1_partials, ssim_partials]
    )
    .0
}

/// Crops have narrower strips than the views that memory is taken for.
#[test]
fn memory_for_a_view_suffices_for_every_smaller_one() {
    on_both_plans(|gpu| {
        let largest = UVec2::new(72, 100);
        let mut loss = loss(gpu, 0.2).unwrap();
        loss.reserve(largest).unwrap();
        for size in [[72, 100], [71, 100], [61, 99], [37, 27], [1, 100], [72, 9]].map(UVec2::from) {
            let image = || gpu.zeros("image", 3 * size.element_product() as usize).unwrap();
            let ([render, target], mut d_render) = ([image(), image()], image());
            let logged = log_step(gpu, |pass, log| {
                let loss_region = LossRegion::whole(size);
                let inputs = LossInputs { size, loss_region, render: &render, target: &target };
                loss.record(pass, inputs, &mut d_render, log)
            });
            let ssim = logged.unwrap().losses.get(Term::SSIM);
            assert!((ssim - 1.0).abs() < 1e-6, "{size}: {ssim}");
        }
    });
}

/// The strips of a view are a matter of speed.
#[test]
fn no_bit_of_the_gradient_depends_on_the_number_of_strips() {
    let gpu = gpu_with(|properties| properties.is_cpu = false);
    let size = UVec2::new(61, 333);
    let [render, target] =
        images(size.to_array()).map(|image| gpu.buffer("image", &image).unwrap());
    let evaluate = |strips: u32| {
        let mut loss = loss(&gpu, 0.2).unwrap();
        loss.set_ssim_strips(strips.try_into().unwrap());
        loss.reserve(size).unwrap();
        let mut d_render = gpu.uninit("d_render", render.len()).unwrap();
        let logged = log_step(&gpu, |pass, log| {
            let (loss_region, [render, target]) = (LossRegion::whole(size), [&render, &target]);
            let inputs = LossInputs { size, loss_region, render, target };
            loss.record(pass, inputs, &mut d_render, log)
        });
        let losses = logged.unwrap().losses;
        let means = [Term::L1, Term::SSIM].map(|term| f64::from(losses.get(term)));
        (gpu.read(&d_render).unwrap(), means)
    };
    let (d_render, means) = evaluate(6144);
    for strips in [1, 100, 700] {
        let (other, others) = evaluate(strips);
        assert_eq!(bits(&other), bits(&d_render), "{strips} strips");
        for (other, mean) in others.into_iter().zip(means) {
            assert!((other / mean - 1.0).abs() < 1e-5, "{strips} strips: {other} and {mean}");
        }
    }
}

#[test]
fn the_kernel_of_ssim_matches_its_reference_at_every_size() {
    for size in SIZES {
        check_ssim([16, 64, 1], size, LossRegion::whole(size.into()));
    }
}

/// With strips of 8 rows and, in the largest view, of 9.
#[test]
fn both_kernels_of_a_gpu_match_their_references() {
    let gpu = gpu_with(|properties| properties.is_cpu = false);
    let tall = ([120, 640], LossRegion::whole([120, 640].into()));
    for case in all_cases().chain([tall]) {
        check_step(&gpu, 0.2, case, &["ssim_forward", "ssim_backward"]);
    }
}

#[test]
fn the_shape_of_the_strips_does_not_matter() {
    for shape in [[2, 32, 1], [4, 1, 1], [5, 7, 1]] {
        check_ssim(shape, [37, 41], LossRegion::whole([37, 41].into()));
    }
}

/// A vector stored for a column too many overwrites the output of another subgroup.
#[test]
fn whole_vectors_store_the_same_as_single_values() {
    for (size, loss_region) in [
        ([4, 3], LossRegion::whole([4, 3].into())),
        ([40, 41], LossRegion { origin: UVec2::new(2, 1), size: UVec2::new(31, 7) }),
        ([132, 20], LossRegion::whole([132, 20].into())),
    ] {
        for rows in [7, 64] {
            let whole = check_ssim([4, rows, 4], size, loss_region);
            let single = check_ssim([5, rows, 1], size, loss_region);
            // Compilers contract the arithmetic of each shape differently.
            assert_close(&format!("{size:?} {rows}"), &whole, &single, 1e-8);
        }
    }
}

/// A step on the kernels of this plan, each compared with its reference, in order.
fn check_step(gpu: &Gpu, weight: f64, (size, region): ([u32; 2], LossRegion), kernels: &[&str]) {
    let images = images(size);
    let (outcome, report) =
        gpu.checked(|| evaluate_loss_region(gpu, weight, size, region, &images));
    report.agree().unwrap_or_else(|error| panic!("{size:?}: {error}"));
    assert!(report.passes.iter().map(|pass| pass.kernel).eq(kernels.iter().copied()));
    assert_eq!(outcome.status, 0);
    assert!(weight > 0.0 || outcome.ssim == 0.0, "SSIM is not modelled at weight 0");
}

/// Every size and every loss region.
fn all_cases() -> impl Iterator<Item = ([u32; 2], LossRegion)> {
    let whole = |size: [u32; 2]| (size, LossRegion::whole(size.into()));
    SIZES.into_iter().map(whole).chain(loss_regions())
}

#[test]
fn l1_matches_its_reference() {
    all_cases().for_each(|case| check_step(&gpu(), 0.0, case, &["l1", "loss_log"]));
}

/// (1 - w) mean|a - b| + w (1 - mean SSIM) of one channel, with means over the loss region.
fn loss_of(
    [width, height]: [usize; 2],
    loss_region: LossRegion,
    weight: f64,
    a: &[f64],
    b: &[f64],
) -> f64 {
    let ssim = ssim([width, height], a, b);
    let (mut l1_sum, mut ssim_sum, mut count) = (0.0, 0.0, 0.0);
    for i in 0..a.len() {
        if contains(loss_region, i % width, i / width) {
            l1_sum += (a[i] - b[i]).abs();
            ssim_sum += ssim[i];
            count += 1.0;
        }
    }
    (1.0 - weight) * l1_sum / count + weight * (1.0 - ssim_sum / count)
}

fn contains(LossRegion { origin, size }: LossRegion, x: usize, y: usize) -> bool {
    let pixel = UVec2::new(x as u32, y as u32);
    pixel.cmpge(origin).all() && pixel.cmplt(origin + size).all()
}

/// Views with loss regions: all of it, the middle, a corner, one pixel.
fn loss_regions() -> Vec<([u32; 2], LossRegion)> {
    let inside = |size, origin: [u32; 2], region: [u32; 2]| {
        (size, LossRegion { origin: origin.into(), size: region.into() })
    };
    vec![
        inside([1, 1], [0, 0], [1, 1]),
        inside([3, 1], [1, 0], [2, 1]),
        inside([5, 7], [1, 2], [3, 4]),
        inside([17, 33], [0, 0], [17, 20]),
        inside([33, 17], [20, 3], [13, 14]),
        inside([33, 17], [16, 8], [1, 1]),
        inside([70, 66], [6, 7], [50, 48]),
    ]
}

#[test]
fn the_reference_gradient_agrees_with_finite_differences() {
    let whole = |size: [u32; 2]| (size, LossRegion::whole(size.into()));
    let mut cases = vec![whole([1, 1]), whole([3, 1]), whole([5, 7]), whole([13, 17])];
    cases.extend(loss_regions().into_iter().filter(|(size, _)| size[0] < 40));
    for (size, loss_region) in cases {
        let size = size.map(|extent| extent as usize);
        let count = size[0] * size[1];
        let weight = 0.2;
        let b: Vec<f64> = (0..count).map(|i| 0.5 + 0.4 * (i as f64 * 0.7).sin()).collect();
        // Away from a = b, where |a - b| has no derivative.
        let a: Vec<f64> = (0..count).map(|i| b[i] + if i % 3 == 0 { 0.2 } else { -0.3 }).collect();
        let mean_scale = 1.0 / f64::from(loss_region.size.element_product());
        let scales = [(1.0 - weight) * mean_scale, weight * mean_scale];
        let rectangle = [loss_region.origin, loss_region.origin + loss_region.size];
        let analytic = gradient(size, rectangle, scales, &a, &b);
        let numeric = central_differences(&a, |a| loss_of(size, loss_region, weight, a, &b));
        for i in 0..count {
            assert!(
                (numeric[i] - analytic[i]).abs() < 1e-8,
                "{size:?} {loss_region:?} at {i}: {} {}",
                numeric[i],
                analytic[i]
            );
        }
    }
}

#[test]
fn the_kernels_match_their_references_with_a_loss_region() {
    for (size, loss_region) in loss_regions() {
        check_ssim([16, 64, 1], size, loss_region);
        check_ssim([2, 32, 1], size, loss_region);
    }
}

/// The windows of the loss region extend beyond it, so the gradient is not that of the region by itself.
#[test]
fn l1_ignores_the_render_outside_the_loss_region_but_ssim_does_not() {
    on_both_plans(|gpu| {
        let (size, loss_region) =
            ([40, 40], LossRegion { origin: UVec2::splat(15), size: UVec2::splat(10) });
        let [render, target] = images(size);
        let evaluate = |weight: f64, render: &[f32]| {
            let images = [render.to_vec(), target.clone()];
            evaluate_loss_region(gpu, weight, size, loss_region, &images)
        };
        let distance = |i: usize| {
            let axis = |at: usize| 15usize.saturating_sub(at).max(at.saturating_sub(24));
            axis(i % 40).max(axis(i / 40 % 40))
        };
        let mut changed = render.clone();
        (0..changed.len()).filter(|&i| distance(i) > 0).for_each(|i| changed[i] += 0.3);
        let [l1, with_ssim] = [0.0, 0.3].map(|weight| evaluate(weight, &render));
        let l1_changed = evaluate(0.0, &changed);
        assert_eq!(l1.l1, l1_changed.l1);
        assert_eq!(bits(&l1.d_render), bits(&l1_changed.d_render));
        let changed = evaluate(0.3, &changed);
        assert_eq!(with_ssim.l1, changed.l1);
        assert_ne!(with_ssim.ssim, changed.ssim);
        for i in 0..render.len() {
            assert_eq!(l1.d_render[i] != 0.0, distance(i) == 0, "{i}");
            assert_eq!(with_ssim.d_render[i] != 0.0, distance(i) <= 5, "{i}");
        }
    });
}

/// A value that does not count must not affect the mean, unless a window includes it.
#[test]
fn a_nan_beyond_every_window_of_the_loss_region_changes_nothing() {
    on_both_plans(|gpu| {
        let (size, loss_region) =
            ([40, 40], LossRegion { origin: UVec2::splat(8), size: UVec2::splat(10) });
        let images = images(size);
        let mut spoilt = images.clone();
        spoilt[0][39 * 40 + 39] = f32::NAN;
        for weight in [0.0, 0.2] {
            let [whole, spoilt] = [&images, &spoilt]
                .map(|images| evaluate_loss_region(gpu, weight, size, loss_region, images));
            assert!(whole.l1.is_finite() && spoilt.status == 0);
            assert_eq!((spoilt.l1, spoilt.ssim), (whole.l1, whole.ssim));
            assert!(spoilt.d_render == whole.d_render, "the gradient with SSIM of weight {weight}");
        }
    });
}

#[test]
fn a_loss_region_outside_the_view_is_refused() {
    let gpu = gpu();
    let size = UVec2::splat(8);
    let mut loss = loss(&gpu, 0.2).unwrap();
    loss.reserve(size).unwrap();
    let image = gpu.zeros("image", 3 * 64).unwrap();
    for (origin, region) in [([0, 0], [0, 8]), ([1, 0], [8, 8]), ([9, 0], [1, 1]), ([0, 0], [8, 9])]
    {
        let loss_region = LossRegion { origin: origin.into(), size: region.into() };
        let inputs = LossInputs { size, loss_region, render: &image, target: &image };
        let mut d_render = gpu.zeros("d_render", 3 * 64).unwrap();
        let logged = log_step(&gpu, |pass, log| loss.record(pass, inputs, &mut d_render, log));
        assert!(logged.is_err(), "{loss_region:?}");
    }
}

#[test]
fn l1_and_ssim_agree_with_pytorch() {
    let torch = Torch::read();
    on_both_plans(|gpu| {
        let images = [torch.get("image.render").to_vec(), torch.get("image.target").to_vec()];
        let whole = LossRegion::whole([23, 19].into());
        let evaluate = |weight: f64| evaluate_loss_region(gpu, weight, [23, 19], whole, &images);
        let [l1, ssim] = [0.0, 1.0].map(evaluate);
        torch.assert_agrees("image.l1.value", &[l1.l1]);
        torch.assert_agrees("image.l1.d_render", &l1.d_render);
        torch.assert_agrees("image.ssim.value", &[1.0 - ssim.ssim]);
        torch.assert_agrees("image.ssim.d_render", &ssim.d_render);
    });
}

#[test]
fn an_image_compared_with_itself_has_no_loss() {
    on_both_plans(|gpu| {
        let [_, target] = images([40, 30]);
        let outcome = evaluate(gpu, 0.2, [40, 30], &[target.clone(), target]);
        assert!(outcome.l1 < 1e-7, "{}", outcome.l1);
        assert!((outcome.ssim - 1.0).abs() < 1e-6, "{}", outcome.ssim);
        assert!(largest(&outcome.d_render) < 1e-6, "{}", largest(&outcome.d_render));
        assert_eq!(outcome.status, 0);
    });
}

#[test]
fn black_images_have_a_finite_gradient() {
    on_both_plans(|gpu| {
        let count = 3 * 20 * 20;
        let outcome = evaluate(gpu, 0.5, [20, 20], &[vec![0.0; count], vec![0.0; count]]);
        assert!((outcome.ssim - 1.0).abs() < 1e-6);
        assert!(outcome.d_render.iter().all(|d| d.abs() < 1e-6));
    });
}

/// Squares near 4e4 have a rounding error above C2: without the floor of the variances, the denominator becomes
/// negative.
#[test]
fn a_far_too_bright_render_has_a_positive_ssim() {
    on_both_plans(|gpu| {
        let count = 3 * 48 * 48;
        for brightness in [150.1f32, 170.3, 190.7, 210.9, 230.3, 250.7] {
            let outcome =
                evaluate(gpu, 1.0, [48, 48], &[vec![brightness; count], vec![0.5; count]]);
            assert!(outcome.ssim > 0.0, "{brightness}: {}", outcome.ssim);
            assert_eq!(outcome.status, 0);
        }
    });
}

#[test]
fn a_value_that_is_not_finite_reaches_the_log_and_the_status() {
    on_both_plans(|gpu| {
        for (value, weight) in
            [(f32::NAN, 0.2), (f32::NAN, 0.0), (f32::INFINITY, 0.2), (f32::NEG_INFINITY, 0.0)]
        {
            let [mut render, target] = images([50, 70]);
            render[1234] = value;
            let outcome = evaluate(gpu, weight, [50, 70], &[render, target]);
            assert!(!outcome.l1.is_finite(), "{value} at weight {weight}: {}", outcome.l1);
            assert_eq!(outcome.status, NOT_FINITE);
        }
    });
}

#[test]
fn the_same_step_leaves_the_same_bits() {
    on_both_plans(|gpu| {
        let inputs = images([131, 97]);
        let step = || {
            let outcome = evaluate(gpu, 0.2, [131, 97], &inputs);
            (outcome.l1.to_bits(), outcome.ssim.to_bits(), bits(&outcome.d_render))
        };
        let first = step();
        for _ in 0..5 {
            assert!(step() == first);
        }
    });
}

#[test]
fn a_weight_outside_its_range_is_refused() {
    let gpu = gpu();
    for weight in [-0.1, 1.1, f64::NAN] {
        assert!(loss(&gpu, weight).is_err());
    }
}

/// A kernel without bounds would write beyond its buffers.
#[test]
fn a_view_that_does_not_fit_is_refused() {
    on_both_plans(|gpu| {
        let image = gpu.zeros("image", 3 * 256).unwrap();
        for (weight, size, slot) in [
            (0.2, [17, 16], 0),
            (0.0, [17, 16], 0),
            (0.2, [0, 8], 0),
            (0.2, [16, 16], 3),
            (0.2, [u32::MAX, u32::MAX], 0),
        ] {
            let mut loss = loss(gpu, weight).unwrap();
            loss.reserve(UVec2::splat(16)).unwrap();
            let mut d_render = gpu.zeros("d_render", 3 * 256).unwrap();
            let result = log_step(gpu, |pass, log| {
                let size = UVec2::from_array(size);
                let loss_region = LossRegion::whole(size);
                let inputs = LossInputs { size, loss_region, render: &image, target: &image };
                log.slot = slot;
                loss.record(pass, inputs, &mut d_render, log)
            });
            assert!(result.is_err(), "{weight} {size:?} {slot}");
        }
        // As many values, but more subgroups than there are partial sums, if subgroups are narrow.
        let mut loss = loss(gpu, 0.2).unwrap();
        loss.reserve(UVec2::splat(16)).unwrap();
        let mut d_render = gpu.zeros("d_render", 3 * 256).unwrap();
        let result = log_step(gpu, |pass, log| {
            let size = UVec2::new(256, 1);
            let loss_region = LossRegion::whole(size);
            let inputs = LossInputs { size, loss_region, render: &image, target: &image };
            loss.record(pass, inputs, &mut d_render, log)
        });
        assert!(result.is_err() || gpu.properties().subgroup_size > 8);
    });
}

#[test]
fn a_second_term_adds_to_the_gradient_of_the_first() {
    on_both_plans(|gpu| {
        for (size, weight) in [([40, 30], 0.2), ([37, 31], 0.2), ([37, 31], 0.0)] {
            let images = images(size);
            let first: Vec<f32> = (0..images[0].len()).map(|i| (i as f32 * 0.1).sin()).collect();
            let second = evaluate(gpu, weight, size, &images).d_render;
            let size = UVec2::from_array(size);
            let mut loss = Loss::new(gpu, weight, [Term::L1, Term::SSIM], Gradient::Added).unwrap();
            loss.reserve(size).unwrap();
            let [render, target] = images.map(|image| gpu.buffer("image", &image).unwrap());
            let mut d_render = gpu.buffer("d_render", &first).unwrap();
            log_step(gpu, |pass, log| {
                let loss_region = LossRegion::whole(size);
                let inputs = LossInputs { size, loss_region, render: &render, target: &target };
                loss.record(pass, inputs, &mut d_render, log)
            })
            .unwrap();
            let expected: Vec<f32> =
                first.iter().zip(second).map(|(first, second)| first + second).collect();
            let what = format!("{size} {weight}");
            assert_close(&what, &gpu.read(&d_render).unwrap(), &expected, 2.0 * f32::EPSILON);
        }
    });
}
