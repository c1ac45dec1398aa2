//! Curves on the device against the host.

use nightsplat::kernels::curves::{
    CURVE_ASE, CURVE_AUTO, CURVE_LUM_PRESERVE, CURVE_PER_CHANNEL, CURVE_PROFILE, CURVE_TABLE,
};
use nightsplat::kernels::{ToneParameters, pseudo_gt};
use nightsplat_photographs::tone::{FAMILIES, Family, Table};

use crate::common::grid::grid;
use crate::common::prelude::*;

/// The target of a planar photograph on the device, checked against the kernel's reference; `numbers` are those of a
/// table with `knot_count` knots, or of a profile.
fn mapped(
    curve: u32,
    image: &[f32],
    tone: ToneParameters,
    (numbers, knot_count): (&[f32], u32),
) -> Vec<f32> {
    let pixel_count = (image.len() / 3) as u32;
    let (codes, values, numbers) = (Vec::<u32>::new(), image.to_vec(), numbers.to_vec());
    let (parameters, target) = (vec![tone], vec![0.0_f32; image.len()]);
    run_kernel!(
        pseudo_gt,
        pseudo_gt::Constants { tone_curve: curve, ..Default::default() },
        pseudo_gt::Params { pixel_count, view: 0, knot_count },
        Threads::Exactly([pixel_count, 1, 1]),
        [codes, values, parameters, numbers],
        [target]
    )
}

/// The device's values of a curve on a grid of t, with the reference's.
fn on_device(curve: ToneCurve, grid: &[f32], tone: ToneParameters) -> [Vec<f32>; 2] {
    // Whole pixels.
    let mut values = grid.to_vec();
    values.resize(grid.len().next_multiple_of(3), 0.0);
    let gpu = gpu();
    let pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(curve)).unwrap();
    let image = gpu.buffer("image", &values).unwrap();
    let parameters = gpu.buffer("parameters", &[tone]).unwrap();
    let mut target = gpu.zeros("target", values.len()).unwrap();
    gpu.run("pseudo-GT", |pass| pseudo_gt.map(pass, &image, &parameters, 0, &mut target)).unwrap();
    let mut found = gpu.read(&target).unwrap();
    found.truncate(grid.len());
    [found, grid.iter().map(|&t| curve.apply(t, &tone)).collect()]
}

/// Distance in ulps, at least 2^-24 of the exact value each.
fn ulps(found: f32, exact: f64) -> f64 {
    let ulp = f64::from((exact as f32).next_up()) - f64::from(exact as f32);
    (f64::from(found) - exact).abs() / ulp
}

/// The error of exp, pow and cancellation beyond 4 ulp: 4 ulp of one, and a few parts per million for tiny values,
/// which the series compute. The terms of the polynomial of degree 5 reach 30 while their sum is 1.
fn bound(family: &Family, t: f32, exact: f64) -> f64 {
    match family.curve {
        ToneCurve::Poly5Origin => 4e-6,
        _ if t < 0.001 => 4e-6 * exact,
        _ => 4.8e-7,
    }
}

#[test]
fn the_device_agrees_with_every_family_in_double_precision() {
    let grid: Vec<f32> = grid().into_iter().map(|t| t as f32).collect();
    let is_of_one_value =
        |family: &&Family| !matches!(family.curve, ToneCurve::PerChannel | ToneCurve::LumPreserve);
    for family in FAMILIES.iter().filter(is_of_one_value) {
        let constants = ToneSettings::new(family.curve).constants;
        let mut padded = [0.0; 8];
        for (padded, constant) in padded.iter_mut().zip(&constants) {
            *padded = *constant as f32;
        }
        let rounded: Vec<f64> = padded.iter().map(|&constant| constant.into()).collect();
        for (offset, gain) in [(0.0, 1.0), (0.0754, 1.16)] {
            let tone = ToneParameters { white: 1.0, offset, gain, weight: 1.0, constants: padded };
            let [found, host] = on_device(family.curve, &grid, tone);
            let mut worst = 0.0_f64;
            for ((&t, found), host) in grid.iter().zip(found).zip(host) {
                let exact = family.curve.value(t.into(), offset.into(), gain.into(), &rounded);
                for found in [found, host] {
                    let error = (f64::from(found) - exact).abs();
                    worst = worst.max(error);
                    assert!(
                        ulps(found, exact) <= 4.0 || error <= bound(family, t, exact),
                        "{}({t}) = {found}, not {exact}",
                        family.name
                    );
                }
            }
            println!("{}: off by {worst:.1e} at most", family.name);
        }
    }
}

/// A photograph of 8-bit noise close to black.
fn photograph(pixels: usize) -> Vec<f32> {
    let mut state = 5_u64;
    let mut noise = move || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32
    };
    (0..3 * pixels).map(|_| (noise().powi(3) * 255.0).round() / 255.0).collect()
}

#[test]
fn curves_that_mix_channels_match_their_reference() {
    for pixels in [1, 255, 1001] {
        let mut image = photograph(pixels);
        image[0] = f32::NAN;
        image[pixels - 1] = 0.0;
        // Below black, in one channel and in all.
        for (at, value) in image[1..].iter_mut().enumerate().filter(|(at, _)| at % 5 == 0) {
            *value *= if at % 3 == 0 { -1.0 } else { -0.01 };
        }
        let constants = [0.2, 0.3, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0];
        let plain = ToneParameters { white: 1.0, offset: 0.0, gain: 3.0, weight: 1.0, constants };
        let automatic = ToneParameters { white: 0.07, offset: 0.075, gain: 1.0, ..plain };
        for (curve, tone) in [
            (CURVE_LUM_PRESERVE, plain),
            (CURVE_PER_CHANNEL, plain),
            (CURVE_AUTO, automatic),
            (CURVE_AUTO, ToneParameters { white: 1.0 / 128.0, ..automatic }),
            (
                CURVE_AUTO,
                ToneParameters { constants: [0.2, 1.5, 0.4, 0.7, 0.0, 0.0, 0.0, 0.0], ..automatic },
            ),
        ] {
            mapped(curve, &image, tone, (&[], 0));
        }
    }
}

/// With its slope at black, where the photographs' noise is on both sides.
#[test]
fn every_curve_goes_on_below_black_as_its_mirror_image() {
    let above = [1e-6_f32, 1e-3, 0.01, 0.05, 0.3, 0.9];
    let grid = [&above.map(|x| -x)[..], &[0.0], &above].concat();
    let is_of_one_value =
        |family: &&Family| !matches!(family.curve, ToneCurve::PerChannel | ToneCurve::LumPreserve);
    for family in FAMILIES.iter().filter(is_of_one_value) {
        let mut tone = ToneParameters { white: 0.4, offset: 0.1, gain: 0.8, ..Default::default() };
        (tone.weight, tone.constants[0]) = (1.0, 0.0);
        for (padded, constant) in tone.constants.iter_mut().zip(family.defaults()) {
            *padded = constant as f32;
        }
        for found in on_device(family.curve, &grid, tone) {
            for (at, _) in above.iter().enumerate() {
                let mirrored = 2.0 * found[6] - found[7 + at];
                assert!((found[at] - mirrored).abs() < 1e-6, "{}: {found:?}", family.name);
            }
        }
    }
    let colours = photograph(100);
    let below: Vec<f32> = colours.iter().map(|x| -x).collect();
    let (table, profile) = (table(), crate::common::setup::profile());
    let knots: Vec<f32> = table.knots().iter().flat_map(|knot| knot.to_array()).collect();
    for (curve, numbers, count) in [
        (CURVE_AUTO, vec![], 0),
        (CURVE_LUM_PRESERVE, vec![], 0),
        (CURVE_PER_CHANNEL, vec![], 0),
        (CURVE_TABLE, knots, 6),
        (CURVE_PROFILE, profile.rows(), 0),
    ] {
        let constants = [0.3, 1.5, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        for weight in [1.0, 0.6] {
            let tone = ToneParameters { white: 1.5, offset: 0.07, gain: 0.9, weight, constants };
            let of = |image: &[f32]| mapped(curve, image, tone, (&numbers, count));
            let (lit, dark, black) = (of(&colours), of(&below), of(&[0.0; 300]));
            for i in 0..colours.len() {
                let mirrored = 2.0 * black[i] - lit[i];
                // A profile, which mixes channels, goes on with the slope of its first segment.
                let is_mirrored = (dark[i] - mirrored).abs() < 1e-6;
                assert!(is_mirrored || curve == CURVE_PROFILE, "curve {curve}, {i}");
            }
        }
    }
}

#[test]
fn a_partial_curve_is_between_the_photograph_and_the_whole_curve() {
    let mut image = photograph(100);
    image[7] = 1.5;
    let constants = [1.0 / 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let whole = ToneParameters { white: 0.3, offset: 0.075, gain: 1.0, weight: 1.0, constants };
    let of = |weight| mapped(CURVE_AUTO, &image, ToneParameters { weight, ..whole }, (&[], 0));
    let [none, half, all] = [0.0, 0.5, 1.0].map(of);
    for i in 0..image.len() {
        assert_eq!(none[i], image[i].min(1.0), "{i}");
        assert!((half[i] - 0.5 * (none[i] + all[i])).abs() < 1e-6, "{i}");
    }
}

#[test]
fn decoding_restores_the_stored_bits_also_under_a_curve() {
    let image = photograph(333);
    let tone = ToneParameters { white: 0.2, gain: 1.0, weight: 1.0, ..Default::default() };
    let expected = mapped(CURVE_ASE, &image, tone, (&[], 0));
    for code_bits in [8, 16] {
        let of_byte = |code: u32| code as f32 / 255.0;
        let values: Vec<f32> = (0..1 << code_bits.min(8)).map(of_byte).collect();
        let code = |x: &f32| (x * 255.0).round() as u32;
        let per_word = 32 / code_bits as usize;
        let word = |codes: &[f32]| {
            let codes = codes.iter().zip((0..).step_by(code_bits as usize));
            codes.fold(0, |word, (x, shift)| word | code(x) << shift)
        };
        for with_curve in [false, true] {
            let codes: Vec<u32> = image.chunks(per_word).map(word).collect();
            let (values, parameters, numbers) = (values.clone(), vec![tone], Vec::<f32>::new());
            let target = vec![0.0_f32; image.len()];
            let tone_curve = ToneCurve::Ase.constant();
            let found = run_kernel!(
                pseudo_gt,
                pseudo_gt::Constants { code_bits, with_curve, tone_curve },
                pseudo_gt::Params { pixel_count: 333, view: 0, knot_count: 0 },
                Threads::Exactly([333, 1, 1]),
                [codes, values, parameters, numbers],
                [target]
            );
            assert_eq!(found, if with_curve { expected.clone() } else { image.clone() });
        }
    }
}

fn table() -> Table {
    Table {
        is_of_stored: false,
        x: vec![0.0, 0.1, 0.5, 0.6, 1.0, 2.5],
        y: vec![
            vec![0.0, 0.3, 0.5, 0.5, 0.8, 1.0],
            vec![0.1; 6],
            vec![1.0, 0.9, 0.3, 0.2, 0.1, 0.0],
        ],
    }
}

#[test]
fn a_table_on_the_device_matches_its_reference_and_double_precision() {
    let (table, pixels) = (table(), 1003);
    let mut image = photograph(pixels);
    image[..6].copy_from_slice(&[f32::NAN, -1.0, 0.0, 0.4, f32::INFINITY, 0.04]);
    let tone = ToneParameters { white: 0.4, gain: 1.0, weight: 1.0, ..Default::default() };
    let knots: Vec<f32> = table.knots().iter().flat_map(|knot| knot.to_array()).collect();
    let found = mapped(CURVE_TABLE, &image, tone, (&knots, 6));
    for (i, found) in found.into_iter().enumerate() {
        let exact = table.value(f64::from(image[i]) / 0.4, i / pixels);
        assert!((f64::from(found) - exact).abs() <= 1e-6, "{i}: {found}, not {exact}");
    }
}

#[test]
fn a_profile_on_the_device_matches_its_reference_and_double_precision() {
    let made = crate::common::setup::profile();
    made.check().unwrap();
    for pixels in [1, 255, 256, 257, 1001] {
        let mut photograph = photograph(pixels);
        photograph[0] = f32::NAN;
        photograph[pixels] = f32::INFINITY;
        photograph[2 * pixels] = -1.0;
        let white = 0.07;
        let tone = ToneParameters { white, gain: 1.0, weight: 1.0, ..Default::default() };
        let found = mapped(CURVE_PROFILE, &photograph, tone, (&made.rows(), 0));
        for (i, found) in found.into_iter().enumerate() {
            let t = [0, 1, 2].map(|channel| match photograph[channel * pixels + i % pixels] {
                x if x.is_nan() => 0.0,
                x => f64::from(x.clamp(-65504.0, 65504.0)) / f64::from(white),
            });
            let exact = made.value(t)[i / pixels];
            assert!((f64::from(found) - exact).abs() <= 3e-6, "{i}: {found}, not {exact}");
        }
    }
}

/// Grey follows the curve of one value for any lambda, and colours keep their ratios for lambda 1.
#[test]
fn the_automatic_curve_is_one_curve_for_grey_and_keeps_the_ratios_of_colours() {
    for share in [0.0, 1.0 / 3.0, 1.0] {
        let mut constants = [0.0; 8];
        constants[0] = share;
        let tone = ToneParameters { white: 0.1, offset: 0.075, gain: 1.0, weight: 1.0, constants };
        let grey: Vec<f32> = (0..600).map(|i| i as f32 / 600.0).collect();
        let colour = [0.01, 0.02, 0.005];
        let image: Vec<f32> =
            colour.iter().flat_map(|&c| [grey.as_slice(), &[c]].concat()).collect();
        let target = mapped(CURVE_AUTO, &image, tone, (&[], 0));
        for (i, &x) in grey.iter().enumerate() {
            let exact = ToneCurve::Ase.value(f64::from(x) / 0.1, 0.075, 1.0, &[]);
            for channel in 0..3 {
                let found = f64::from(target[601 * channel + i]);
                assert!((found - exact).abs() < 1e-6, "{x}: {found}, not {exact}");
            }
        }
        let above_black = |channel: usize| f64::from(target[601 * channel + 600]) - 0.075;
        let ratio = above_black(1) / above_black(0);
        let kept = (ratio - 2.0).abs() < 1e-4;
        assert_eq!(kept, share == 1.0, "lambda {share}: a ratio of 2 became {ratio}");
    }
}
