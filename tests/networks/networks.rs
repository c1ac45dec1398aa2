//! The networks on the device: against references in double precision, and their rules of use.

use nightsplat::gpu::{CheckReport, DeviceChoice};
use nightsplat::networks::{Denoiser, Parameters, Precision, Tonemapper};

use super::model;
use super::{largest, narrow, widen};
use crate::common::prelude::*;

/// The results of a network for two images and a gradient: output, gradients of parameters and of both inputs.
#[derive(PartialEq)]
pub(crate) struct Outcome {
    pub(crate) output: Vec<f32>,
    pub(crate) parameters: Vec<f32>,
    pub(crate) inputs: [Vec<f32>; 2],
}

/// The initial content of the buffer that is accumulated into.
const BEFORE: f32 = 0.25;

/// Runs a network forward and backward, and subtracts the initial content of the second input's gradient.
macro_rules! run_network {
    ($network:ident, $output:ident, $size:expr, $images:expr) => {{
        let (gpu, size): (_, UVec2) = (gpu(), $size);
        let [first, second, d_output] =
            $images.map(|image: &[f32]| gpu.buffer("image", image).unwrap());
        let mut d_first = gpu.buffer("d_first", &vec![f32::NAN; first.len()]).unwrap();
        let mut d_second = gpu.buffer("d_second", &vec![BEFORE; first.len()]).unwrap();
        $network.reserve(size).unwrap();
        gpu.run("network", |pass| {
            $network.forward(pass, size, &first, &second)?;
            let gradients = (&mut d_first, &mut d_second);
            $network.backward(pass, size, &first, &second, &d_output, gradients.0, gradients.1)
        })
        .unwrap();
        let mut output = gpu.read($network.$output()).unwrap();
        output.truncate(first.len());
        let d_second = gpu.read(&d_second).unwrap().iter().map(|d| d - BEFORE).collect();
        Outcome {
            output,
            parameters: gpu.read(&$network.parameters().gradients).unwrap(),
            inputs: [gpu.read(&d_first).unwrap(), d_second],
        }
    }};
}

pub(crate) fn run_denoiser(denoiser: &mut Denoiser, size: UVec2, images: [&[f32]; 3]) -> Outcome {
    run_network!(denoiser, denoised, size, images)
}

pub(crate) fn run_tonemapper(
    tonemapper: &mut Tonemapper,
    size: UVec2,
    images: [&[f32]; 3],
) -> Outcome {
    run_network!(tonemapper, output, size, images)
}

/// Two inputs and a gradient; the second input is so bright that some values clamp.
fn images(size: UVec2, seed: u64) -> [Vec<f32>; 3] {
    let mut random = Random::new(seed);
    [[0.0, 0.5], [0.4, 1.9], [-1.0, 1.0]].map(|[low, high]| {
        (0..3 * size.element_product()).map(|_| random.between(low, high) as f32).collect()
    })
}

/// Compares each tensor of a gradient relative to the largest of its layer: a bias in front of a norm has no gradient,
/// except for the rounding of cancelling sums.
pub(crate) fn assert_gradients(
    what: &str,
    parameters: &Parameters,
    actual: &[f32],
    expected: &[f32],
) {
    assert_eq!(actual.len(), expected.len(), "{what}");
    let tensors = parameters.tensors();
    for pair in tensors.chunks(2) {
        let range = pair[0].offset..pair[1].offset + pair[1].element_count();
        let bound = 1e-4 * largest(&expected[range.clone()]) + 1e-9;
        let what = format!("{what}, {}", pair[0].name);
        assert_close(&what, &actual[range.clone()], &expected[range], |_, _| bound);
    }
}

fn assert_outcome(
    what: &str,
    parameters: &Parameters,
    actual: &Outcome,
    output: &[f64],
    gradients: &model::Gradients,
) {
    let relative = |actual: &[f32], expected: &[f64], tolerance: f32| {
        let expected = narrow(expected);
        let bound = tolerance * largest(&expected) + 1e-7;
        assert_close(what, actual, &expected, |_, _| bound);
    };
    // About thirty layers, each with an error of a few units in the last place.
    relative(&actual.output, output, 2e-5);
    for (actual, expected) in actual.inputs.iter().zip(&gradients.inputs) {
        relative(actual, expected, 1e-4);
    }
    assert_gradients(what, parameters, &actual.parameters, &narrow(&gradients.parameters));
}

/// Generic weights: a last layer of zeros would hide everything before it.
fn draw_weights(parameters: &mut Parameters, seed: u64) {
    let mut random = Random::new(seed);
    let drawn: Vec<f32> =
        (0..parameters.values.len()).map(|_| random.between(-0.3, 0.3) as f32).collect();
    gpu().write(&mut parameters.values, &drawn).unwrap();
}

#[test]
fn in_the_identity_variant_the_output_is_the_render_bit_for_bit_before_training() {
    let (gpu, size) = (gpu(), UVec2::new(21, 9));
    let [first, second, d] = images(size, 9);
    for stages in [1, 2, 3] {
        let settings = DenoiserSettings { stages, repeats: 1, channels: 8, ..Default::default() };
        let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
        let outcome = run_denoiser(&mut denoiser, size, [&second, &second, &d]);
        assert_eq!(outcome.output, second);
        assert!(outcome.parameters.iter().any(|d| *d != 0.0), "nothing would ever be learned");
    }
    let mut tonemapper = Tonemapper::new(&gpu, NetworkVariant::Identity, 1).unwrap();
    let outcome = run_tonemapper(&mut tonemapper, size, [&first, &second, &d]);
    let product: Vec<f32> = first.iter().zip(&second).map(|(l, r)| l * r).collect();
    assert_eq!(outcome.output, product);
    assert!(outcome.parameters.iter().any(|d| *d != 0.0), "nothing would ever be learned");
}

#[test]
fn the_denoiser_matches_its_reference_forward_and_backward() {
    let gpu = gpu();
    let all = [
        (
            DenoiserSettings { stages: 3, repeats: 3, channels: 8, ..Default::default() },
            vec![[1, 1], [3, 1], [5, 7], [33, 17]],
        ),
        (
            DenoiserSettings { stages: 1, repeats: 2, channels: 17, ..Default::default() },
            vec![[8, 8], [2, 19]],
        ),
        (
            DenoiserSettings { stages: 2, repeats: 1, channels: 3, ..Default::default() },
            vec![[5, 7]],
        ),
    ];
    let variants = [NetworkVariant::Identity, NetworkVariant::Paper];
    let all = all.into_iter().flat_map(|(settings, sizes)| {
        variants.map(|variant| (DenoiserSettings { variant, ..settings }, sizes.clone()))
    });
    for (settings, sizes) in all {
        // One network for all sizes: its memory also serves smaller views.
        let mut denoiser = Denoiser::new(&gpu, settings, 7).unwrap();
        assert_eq!(denoiser.margin(), settings.stages * (settings.repeats + 2));
        if settings.variant == NetworkVariant::Identity {
            draw_weights(denoiser.parameters_mut(), 5);
        }
        let values = widen(&gpu.read(&denoiser.parameters().values).unwrap());
        denoiser.reserve(UVec2::new(33, 19)).unwrap();
        for size in sizes.into_iter().map(UVec2::from_array) {
            let [noise, render, d] = images(size, 3);
            let actual = run_denoiser(&mut denoiser, size, [&noise, &render, &d]);
            let model = model::Denoiser { settings, size: size.to_array().map(|n| n as usize) };
            let [noise, render, d] = [noise, render, d].map(|image| widen(&image));
            let output = model.forward(&values, &noise, &render);
            let gradients = model.backward(&values, &noise, &render, &d);
            let what = format!("{settings:?} {size}");
            assert_outcome(&what, denoiser.parameters(), &actual, &output, &gradients);
        }
    }
}

#[test]
fn the_tonemapper_matches_its_reference_forward_and_backward() {
    for variant in [NetworkVariant::Identity, NetworkVariant::Paper] {
        let gpu = gpu();
        let mut tonemapper = Tonemapper::new(&gpu, variant, 7).unwrap();
        assert_eq!(tonemapper.margin(), 3);
        if variant == NetworkVariant::Identity {
            draw_weights(tonemapper.parameters_mut(), 5);
        }
        let values = widen(&gpu.read(&tonemapper.parameters().values).unwrap());
        assert_eq!(values.len(), 3203, "as in the paper");
        for size in [[33, 17], [1, 1], [3, 1], [5, 7]].map(UVec2::from_array) {
            let [illumination, denoised, d] = images(size, 5);
            let actual = run_tonemapper(&mut tonemapper, size, [&illumination, &denoised, &d]);
            let model = model::Tonemapper { variant, size: size.to_array().map(|n| n as usize) };
            let [illumination, denoised, d] =
                [illumination, denoised, d].map(|image| widen(&image));
            let output = model.forward(&values, &illumination, &denoised);
            let gradients = model.backward(&values, &illumination, &denoised, &d);
            let what = format!("{variant:?} {size}");
            assert_outcome(&what, tonemapper.parameters(), &actual, &output, &gradients);
        }
    }
}

/// The loss inspects the output: a `ReLU` or a clamp that removed a NaN would hide it.
#[test]
fn a_nan_reaches_the_output() {
    let gpu = gpu();
    let settings = DenoiserSettings { stages: 2, repeats: 1, channels: 8, ..Default::default() };
    let size = UVec2::new(21, 9);
    let [mut first, second, d] = images(size, 9);
    first[100] = f32::NAN;
    let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
    let outcome = run_denoiser(&mut denoiser, size, [&first, &second, &d]);
    assert!(outcome.output[100].is_nan());
    let mut tonemapper = Tonemapper::new(&gpu, NetworkVariant::Paper, 1).unwrap();
    let outcome = run_tonemapper(&mut tonemapper, size, [&first, &second, &d]);
    assert!(outcome.output[100].is_nan());
}

#[test]
fn two_runs_give_the_same_bits() {
    let gpu = gpu();
    let settings = DenoiserSettings { stages: 2, repeats: 2, channels: 8, ..Default::default() };
    let size = UVec2::new(61, 45);
    let [first, second, d] = images(size, 9);
    let denoise = |_| {
        let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
        run_denoiser(&mut denoiser, size, [&first, &second, &d])
    };
    let tone = |_| {
        let mut tonemapper = Tonemapper::new(&gpu, NetworkVariant::Paper, 1).unwrap();
        run_tonemapper(&mut tonemapper, size, [&first, &second, &d])
    };
    let ([a, b], [c, d]) = ([0, 1].map(denoise), [0, 1].map(tone));
    assert!(a == b && c == d);
}

/// The number of convolutions of a pass.
fn convolutions(report: &CheckReport) -> usize {
    let all = report.kernels().into_iter();
    all.filter(|(kernel, ..)| *kernel == "conv3x3").map(|(_, count, _)| count).sum()
}

#[test]
fn with_kept_activations_no_stage_is_recomputed_and_no_bit_changes() {
    let (gpu, size) = (gpu(), UVec2::new(21, 9));
    let [first, second, d] = images(size, 9);
    let [stages, repeats] = [3, 2];
    let variant = NetworkVariant::Paper;
    let settings = DenoiserSettings { stages, repeats, channels: 8, variant, ..Default::default() };
    let most = Denoiser::kept_bytes(settings, size);
    let run = |kept: UVec2, most| {
        let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
        denoiser.reserve(size).unwrap();
        let are_kept = denoiser.keep_activations(kept, most).unwrap();
        let images = [&first[..], &second, &d];
        let (outcome, report) = agreeing(|| run_denoiser(&mut denoiser, size, images));
        (outcome, are_kept, convolutions(&report))
    };
    let ([once, a_stage], earlier) = ([2 * stages, 1].map(|n| (n * (repeats + 2)) as usize), 2);
    let kept = run(size, most);
    let without_room = run(size, most - 1);
    let for_smaller_views = run(size - 1, most);
    assert_eq!((kept.1, kept.2), (true, once));
    assert_eq!((without_room.1, without_room.2), (false, once + earlier * a_stage));
    assert_eq!((for_smaller_views.1, for_smaller_views.2), (true, once + earlier * a_stage));
    assert!(kept.0 == without_room.0 && kept.0 == for_smaller_views.0);
}

#[test]
fn activations_are_not_kept_without_device_memory_for_them() {
    let gpu = Gpu::new(&DeviceChoice::Best).unwrap();
    let (settings, size) = (DenoiserSettings { stages: 3, ..Default::default() }, UVec2::splat(64));
    let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
    denoiser.reserve(size).unwrap();
    let (before, kept) = (gpu.memory_in_use(), Denoiser::kept_bytes(settings, size));
    gpu.limit_memory(before + kept / 2);
    assert!(!denoiser.keep_activations(size, u64::MAX).unwrap());
    // Memory of the failed attempt is freed, and the estimate suffices.
    gpu.limit_memory(before + kept + kept / 20);
    assert!(denoiser.keep_activations(size, u64::MAX).unwrap());
    assert!(gpu.memory_in_use() >= before + kept / 2);
}

/// Half precision is single precision on a device without 16-bit matrices. Small gradients, as of a mean over a large
/// view, lose no more than large ones.
#[test]
fn half_precision_is_close_to_single_at_every_magnitude() {
    let gpu = gpu();
    let variant = NetworkVariant::Paper;
    let single =
        DenoiserSettings { stages: 2, repeats: 3, channels: 24, variant, ..Default::default() };
    let half = DenoiserSettings { precision: Precision::Half, ..single };
    let size = UVec2::new(37, 26);
    let [first, second, d] = images(size, 4);
    for magnitude in [1.0, 1e-9] {
        let d: Vec<f32> = d.iter().map(|d| d * magnitude).collect();
        let run = |settings| {
            let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
            run_denoiser(&mut denoiser, size, [&first, &second, &d])
        };
        let (expected, actual, again) = (run(single), run(half), run(half));
        assert!(actual == again, "two runs in half precision differ");
        let distance = |actual: &[f32], expected: &[f32]| {
            let square = |x: f32| f64::from(x) * f64::from(x);
            let difference: f64 = actual.iter().zip(expected).map(|(a, e)| square(a - e)).sum();
            (difference / expected.iter().map(|&e| square(e)).sum::<f64>()).sqrt()
        };
        let far = [
            distance(&actual.output, &expected.output),
            distance(&actual.parameters, &expected.parameters),
            distance(&actual.inputs[0], &expected.inputs[0]),
        ];
        // The rounding error of factors is at most 2^-10; a ReLU or a clamp close to its kink may then pass another
        // gradient.
        let bounds = [1e-3, 0.05, 0.05];
        assert!(far.iter().zip(bounds).all(|(far, bound)| *far < bound), "{magnitude}: {far:?}");
        println!("relative distances of output and gradients at {magnitude}: {far:?}");
        let is_half = gpu.properties().cooperative_matrix.is_some();
        assert_eq!(far.iter().any(|&far| far > 0.0), is_half);
    }
    assert_only_the_ends_of_stages_are_packed(half, size, [&first, &second, &d]);
    let mut spoiled = first.clone();
    spoiled[100] = f32::NAN;
    let mut denoiser = Denoiser::new(&gpu, half, 1).unwrap();
    assert!(run_denoiser(&mut denoiser, size, [&spoiled, &second, &d]).output[100].is_nan());
}

/// Weights are packed once per step for each direction, and maps where a stage begins; where it ends they are unpacked.
fn assert_only_the_ends_of_stages_are_packed(
    settings: DenoiserSettings,
    size: UVec2,
    images: [&[f32]; 3],
) {
    let gpu = gpu();
    let mut denoiser = Denoiser::new(&gpu, settings, 1).unwrap();
    denoiser.reserve(size).unwrap();
    assert!(denoiser.keep_activations(size, u64::MAX).unwrap());
    let (_, report) = agreeing(|| run_denoiser(&mut denoiser, size, images));
    let count = |kernel: &str| {
        let found = report.kernels().into_iter().find(|(name, ..)| *name == kernel);
        found.map_or(0, |(_, count, _)| count)
    };
    let DenoiserSettings { stages, repeats, .. } = settings;
    let both_ways = if gpu.properties().cooperative_matrix.is_some() { 2 } else { 0 };
    for once_a_stage in ["pack_weights", "pack_map", "unpack_map"] {
        assert_eq!(count(once_a_stage), both_ways * stages as usize, "{once_a_stage}");
    }
    assert_eq!(count("conv3x3_half"), both_ways * (stages * repeats) as usize);
}

#[test]
fn the_paper_s_denoiser_has_its_parameters_and_fits_a_gigabyte() {
    let settings = DenoiserSettings::paper();
    let denoiser = Denoiser::new(&gpu(), settings, 0).unwrap();
    assert_eq!(denoiser.settings(), settings);
    assert_eq!(denoiser.parameters().values.len(), 121_737);
    assert_eq!(denoiser.margin(), 24);
    let bytes = Denoiser::bytes(settings, UVec2::new(500, 375));
    assert!((700_000_000..1_000_000_000).contains(&bytes), "{bytes}");
}

#[test]
fn initial_weights_are_those_of_pytorch_and_depend_on_the_seed() {
    let gpu = gpu();
    let variant = NetworkVariant::Paper;
    let settings =
        DenoiserSettings { stages: 2, repeats: 1, channels: 16, variant, ..Default::default() };
    let values = |seed| {
        let denoiser = Denoiser::new(&gpu, settings, seed).unwrap();
        (gpu.read(&denoiser.parameters().values).unwrap(), denoiser.parameters().tensors().to_vec())
    };
    let (first, tensors) = values(1);
    assert_eq!(first, values(1).0);
    assert_ne!(first, values(2).0);
    let find = |name: &str| tensors.iter().find(|tensor| tensor.name == name).unwrap();
    assert_eq!(find("1.conv.weight").shape, [16, 16, 3, 3]);
    for (name, bound) in [
        ("0.conv_in.weight", 1.0 / 27.0f32.sqrt()),
        ("1.conv_in.bias", 1.0 / 27.0f32.sqrt()),
        ("1.conv.weight", 1.0 / 12.0),
        ("0.conv_out.weight", 1.0 / 12.0),
    ] {
        let tensor = find(name);
        let values = &first[tensor.offset..][..tensor.element_count()];
        let most = largest(values);
        assert!(most <= bound && most > 0.8 * bound, "{name}: {most} of {bound}");
        assert!(values.iter().any(|x| *x > 0.0) && values.iter().any(|x| *x < 0.0), "{name}");
    }
    let all = |name: &str, value: f32| {
        let tensor = find(name);
        first[tensor.offset..][..tensor.element_count()].iter().all(|x| *x == value)
    };
    assert!(all("0.norm.weight", 1.0) && all("1.norm.bias", 0.0));
}

#[test]
fn misuse_is_refused_in_one_line() {
    let gpu = gpu();
    for settings in [
        DenoiserSettings { stages: 0, ..Default::default() },
        DenoiserSettings { repeats: 65, ..Default::default() },
        DenoiserSettings { channels: 513, ..Default::default() },
    ] {
        let error = Denoiser::new(&gpu, settings, 0).unwrap_err().to_string();
        assert!(error.contains("it must be a whole number, 1 to"), "{error}");
    }
    let settings = DenoiserSettings { stages: 1, repeats: 1, channels: 4, ..Default::default() };
    let mut denoiser = Denoiser::new(&gpu, settings, 0).unwrap();
    let mut tonemapper = Tonemapper::new(&gpu, NetworkVariant::Identity, 0).unwrap();
    let size = UVec2::new(6, 5);
    let (image, short) = (gpu.zeros("image", 90).unwrap(), gpu.zeros("short", 89).unwrap());
    let [mut d_first, mut d_second] = [(); 2].map(|()| gpu.zeros("d", 90).unwrap());
    let told = |what: &str, result: nightsplat::Result<()>| {
        let error = result.unwrap_err().to_string();
        assert!(error.contains(what) && error.lines().count() == 1, "{error}");
    };
    macro_rules! check {
        ($network:ident) => {
            told("reserve", gpu.run("n", |pass| $network.forward(pass, size, &image, &image)));
            $network.reserve(size).unwrap();
            told("`short`", gpu.run("n", |pass| $network.forward(pass, size, &image, &short)));
            told("0 x 5", gpu.run("n", |p| $network.forward(p, UVec2::new(0, 5), &image, &image)));
            told("reserve", gpu.run("n", |p| $network.forward(p, 2 * size, &image, &image)));
            gpu.run("forward", |pass| $network.forward(pass, size, &image, &image)).unwrap();
            let (d_first, d_second) = (&mut d_first, &mut d_second);
            gpu.run("backward", |pass| {
                $network.backward(pass, size, &image, &image, &image, d_first, d_second)
            })
            .unwrap();
            // The backward pass has consumed the results of the forward pass.
            let again = gpu.run("n", |pass| {
                $network.backward(pass, size, &image, &image, &image, d_first, d_second)
            });
            told("its own preceding forward pass", again);
        };
    }
    check!(denoiser);
    check!(tonemapper);
    let far = UVec2::new(60_000, 60_000);
    told("smaller crop or fewer channels", denoiser.reserve(far));
    told("smaller crop or fewer channels", tonemapper.reserve(far));
}
