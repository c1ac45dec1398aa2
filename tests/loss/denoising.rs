//! The denoising terms.

use nightsplat::Result;
use nightsplat::kernels::denoising;
use nightsplat::loss::{DenoisingLoss, LossInputs, LossRegion, Term, Weights};

use super::{
    Logged, NOT_FINITE, Torch, assert_close, assert_gradient, bits, central_differences, largest,
    log_step, noise, widen,
};
use crate::common::prelude::*;

/// Of the mean squared difference and the total variation.
const WEIGHTS: [f64; 2] = [0.7, 1.3];

fn term(gpu: &Gpu, [denoising, total_variation]: [f64; 2]) -> Result<DenoisingLoss> {
    DenoisingLoss::new(gpu, &Weights { denoising, total_variation, ..Weights::default() })
}

/// Views and their loss regions.
fn cases() -> Vec<(UVec2, LossRegion)> {
    let whole = |size: [u32; 2]| (size.into(), LossRegion::whole(size.into()));
    let inside = |size: [u32; 2], origin: [u32; 2], region: [u32; 2]| {
        (size.into(), LossRegion { origin: origin.into(), size: region.into() })
    };
    vec![
        whole([1, 1]),
        whole([3, 1]),
        whole([1, 3]),
        whole([5, 7]),
        whole([33, 17]),
        whole([70, 66]),
        inside([5, 7], [1, 2], [3, 4]),
        inside([33, 17], [20, 3], [13, 14]),
        inside([33, 17], [16, 8], [1, 1]),
        inside([33, 40], [4, 15], [1, 20]),
    ]
}

/// Both terms by their definition, in double precision, with means over the loss region.
fn loss_of(
    size: UVec2,
    LossRegion { origin, size: region }: LossRegion,
    a: &[f64],
    b: &[f64],
) -> f64 {
    let (mut squares, mut vertical, mut horizontal) = (0.0, 0.0, 0.0);
    let at = |channel: u32, x: u32, y: u32| {
        ((channel * size.y + origin.y + y) * size.x + origin.x + x) as usize
    };
    for channel in 0..3 {
        for y in 0..region.y {
            for x in 0..region.x {
                let i = at(channel, x, y);
                squares += (a[i] - b[i]).powi(2);
                if y > 0 {
                    vertical += (a[i] - a[at(channel, x, y - 1)]).powi(2);
                }
                if x > 0 {
                    horizontal += (a[i] - a[at(channel, x - 1, y)]).powi(2);
                }
            }
        }
    }
    let mean = |sum: f64, count: u32| if count == 0 { 0.0 } else { sum / f64::from(3 * count) };
    let tv = 2.0
        * (mean(vertical, region.x * (region.y - 1)) + mean(horizontal, (region.x - 1) * region.y));
    WEIGHTS[0] * mean(squares, region.x * region.y) + WEIGHTS[1] * tv
}

struct Outcome {
    logged: Logged,
    d_denoised: Vec<f32>,
    d_render: Vec<f32>,
}

fn evaluate(
    weights: [f64; 2],
    (size, loss_region): (UVec2, LossRegion),
    [denoised, render]: [&[f32]; 2],
) -> Outcome {
    let gpu = gpu();
    let [mut d_denoised, mut d_render] =
        ["d_denoised", "d_render"].map(|d| gpu.buffer(d, &vec![f32::NAN; render.len()]).unwrap());
    let [denoised, render] =
        [("denoised", denoised), ("render", render)].map(|(n, x)| gpu.buffer(n, x).unwrap());
    let mut loss = term(&gpu, weights).unwrap();
    loss.reserve(size).unwrap();
    let logged = log_step(&gpu, |pass, log| {
        let inputs = LossInputs { size, loss_region, render: &denoised, target: &render };
        loss.record(pass, inputs, &mut d_denoised, &mut d_render, log)
    })
    .unwrap();
    let [d_denoised, d_render] = [d_denoised, d_render].map(|d| gpu.read(&d).unwrap());
    Outcome { logged, d_denoised, d_render }
}

#[test]
fn the_terms_match_their_reference_and_finite_differences() {
    for (size, loss_region) in cases() {
        let values = 3 * size.element_product() as usize;
        let (denoised, render) = (noise(1, values, 0.0, 1.0), noise(2, values, -0.2, 1.2));
        let region_size = loss_region.size;
        let pair_scale = |pairs: u32| if pairs == 0 { 0.0 } else { 2.0 / (3 * pairs) as f32 };
        let params = denoising::Params {
            width: size.x,
            height: size.y,
            loss_begin: loss_region.origin,
            loss_end: loss_region.origin + region_size,
            mse_weight: WEIGHTS[0] as f32,
            tv_weight: WEIGHTS[1] as f32,
            mean_scale: 1.0 / (3 * region_size.element_product()) as f32,
            x_scale: pair_scale((region_size.x - 1) * region_size.y),
            y_scale: pair_scale(region_size.x * (region_size.y - 1)),
        };
        let constants = denoising::Constants::default();
        let [d_denoised, d_render] = [0; 2].map(|_| vec![f32::NAN; values]);
        let [mse_partials, tv_partials] = [0; 2].map(|_| vec![0.0f32]);
        let (d_denoised, d_render, mse_partials, tv_partials) = run_reference!(
            denoising,
            constants,
            params,
            [denoised, render],
            [d_denoised, d_render, mse_partials, tv_partials]
        );
        if values < 3000 {
            let (a, b) = (widen(&denoised), widen(&render));
            let numeric = central_differences(&a, |a| loss_of(size, loss_region, a, &b));
            assert_gradient("d_denoised", &d_denoised, &numeric);
            let numeric = central_differences(&b, |b| loss_of(size, loss_region, &a, b));
            assert_gradient("d_render", &d_render, &numeric);
        }
        let actual = evaluate(WEIGHTS, (size, loss_region), [&denoised, &render]);
        let close = |what: &str, actual: &[f32], expected: &[f32]| {
            assert_close(what, actual, expected, 1e-5 * largest(expected));
        };
        close("d_denoised", &actual.d_denoised, &d_denoised);
        close("d_render", &actual.d_render, &d_render);
        let losses = actual.logged.losses;
        close("MSE", &[losses.get(Term::DENOISING)], &[mse_partials[0] * params.mean_scale]);
        close("TV", &[losses.get(Term::TOTAL_VARIATION)], &tv_partials);
        assert_eq!(actual.logged.status, 0);
    }
}

#[test]
fn the_terms_agree_with_pytorch() {
    let torch = Torch::read();
    let size = UVec2::new(17, 13);
    let images = [torch.get("denoising.denoised"), torch.get("denoising.rendered")];
    let evaluate = |mse: f64, total_variation: f64| {
        evaluate([mse, total_variation], (size, LossRegion::whole(size)), images)
    };
    let (mse, tv) = (evaluate(1.0, 0.0), evaluate(0.0, 1.0));
    torch.assert_agrees("denoising.mse.value", &[mse.logged.losses.get(Term::DENOISING)]);
    torch.assert_agrees("denoising.mse.d_denoised", &mse.d_denoised);
    torch.assert_agrees("denoising.mse.d_rendered", &mse.d_render);
    torch.assert_agrees("denoising.tv.value", &[tv.logged.losses.get(Term::TOTAL_VARIATION)]);
    torch.assert_agrees("denoising.tv.d_denoised", &tv.d_denoised);
    assert!(tv.d_render.iter().all(|&d| d == 0.0), "the total variation has no business here");
}

#[test]
fn a_constant_image_equal_to_the_render_has_no_loss() {
    let size = UVec2::new(20, 21);
    let image = vec![0.3; 3 * 420];
    let outcome = evaluate(WEIGHTS, (size, LossRegion::whole(size)), [&image, &image]);
    assert_eq!(outcome.logged.losses.get(Term::DENOISING), 0.0);
    assert_eq!(outcome.logged.losses.get(Term::TOTAL_VARIATION), 0.0);
    assert!([outcome.d_denoised, outcome.d_render].concat().iter().all(|&d| d == 0.0));
}

#[test]
fn a_value_that_is_not_finite_reaches_the_log_if_it_counts() {
    let size = UVec2::splat(20);
    let loss_region = LossRegion { origin: UVec2::splat(5), size: UVec2::splat(10) };
    let image = noise(3, 1200, 0.0, 1.0);
    let with_nan = |x: usize| {
        let mut image = image.clone();
        image[20 * x + x] = f32::NAN;
        image
    };
    let broken = |images: [&[f32]; 2]| {
        let Logged { losses, status } = evaluate(WEIGHTS, (size, loss_region), images).logged;
        assert_eq!(status, if losses.first_not_finite().is_some() { NOT_FINITE } else { 0 });
        [Term::DENOISING, Term::TOTAL_VARIATION].map(|term| !losses.get(term).is_finite())
    };
    assert_eq!(broken([&image, &with_nan(7)]), [true, false]);
    assert_eq!(broken([&with_nan(7), &image]), [true, true]);
    assert_eq!(broken([&with_nan(4), &image]), [false, false]);
    assert_eq!(broken([&image, &with_nan(15)]), [false, false]);
}

#[test]
fn the_same_step_leaves_the_same_bits() {
    let size = UVec2::new(131, 97);
    let values = 3 * size.element_product() as usize;
    let (denoised, render) = (noise(1, values, 0.0, 1.0), noise(2, values, 0.0, 1.0));
    let step = || {
        let outcome = evaluate(WEIGHTS, (size, LossRegion::whole(size)), [&denoised, &render]);
        let terms = [Term::DENOISING, Term::TOTAL_VARIATION];
        let values = terms.map(|term| outcome.logged.losses.get(term));
        (bits(&values), bits(&outcome.d_denoised), bits(&outcome.d_render))
    };
    let first = step();
    assert!((0..5).all(|_| step() == first));
}

#[test]
fn buffers_and_views_that_do_not_fit_are_refused() {
    let gpu = gpu();
    for weights in [[-1.0, 0.0], [0.0, f64::INFINITY]] {
        assert!(term(&gpu, weights).is_err());
    }
    let mut loss = term(&gpu, WEIGHTS).unwrap();
    loss.reserve(UVec2::splat(8)).unwrap();
    let whole = |size: [u32; 2]| (size.into(), LossRegion::whole(size.into()));
    let is_narrow = gpu.properties().subgroup_size <= 8;
    let outside = LossRegion { origin: UVec2::splat(1), size: UVec2::splat(8) };
    // Buffers of 8 x 8 pixels, and some that are longer than the scratch memory, which wide subgroups need less of.
    for (len, (size, loss_region), why) in [
        (192, whole([0, 8]), "0 x 8"),
        (192, whole([9, 8]), if is_narrow { "9 x 8" } else { "not 216" }),
        (190, whole([8, 8]), "holds 190 elements, not 192"),
        (30_000, whole([100, 100]), "100 x 100"),
        (192, (UVec2::splat(8), outside), "loss region"),
    ] {
        let image = gpu.zeros("image", len).unwrap();
        let [mut d_denoised, mut d_render] = [0; 2].map(|_| gpu.zeros("d", len).unwrap());
        let logged = log_step(&gpu, |pass, log| {
            let inputs = LossInputs { size, loss_region, render: &image, target: &image };
            loss.record(pass, inputs, &mut d_denoised, &mut d_render, log)
        });
        let refused = logged.err().unwrap().to_string();
        assert!(refused.contains(why), "{size} {loss_region:?}: {refused}");
    }
}
