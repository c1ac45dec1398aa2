//! The pseudo-GT kernels against their references, and the whole against the statistics on the host.

use glam::Vec3;
use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{Gpu, Reference, Threads};
use nightsplat::kernels::{
    RankSearch, ToneParameters, ToneStatistics, luminance, luminance_histogram, percentile_select,
    tone_statistics,
};
use nightsplat::photographs::image::Image;
use nightsplat::photographs::pseudo_gt::PseudoGt;
use nightsplat::photographs::tone::{LuminanceHistogram, Statistics, ToneCurve, ToneSettings};
use nightsplat::{Error, Result};

use crate::common::{assert_close, fixture, shared};

/// One curve for every way to find white, gain and black level.
const CURVES: [ToneCurve; 8] = [
    ToneCurve::None,
    ToneCurve::Linear,
    ToneCurve::Ase,
    ToneCurve::Ap3,
    ToneCurve::Gamma,
    ToneCurve::P80,
    ToneCurve::LumPreserve,
    ToneCurve::PerChannel,
];

/// A reproducible value in [0, 1).
fn noise(state: &mut u64) -> f32 {
    *state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
    (*state >> 40) as f32 / (1u64 << 24) as f32
}

/// Planar noise that crowds near black, as dark photographs do.
fn dark(pixels: usize, seed: u64) -> Vec<f32> {
    let mut state = seed;
    (0..3 * pixels).map(|_| noise(&mut state).powi(4) * 0.4).collect()
}

/// The same, as an 8-bit file stores it.
fn dark_8_bit(pixels: usize, seed: u64) -> Vec<f32> {
    dark(pixels, seed).into_iter().map(|x| (x * 255.0).round() / 255.0).collect()
}

/// Distance in representable values.
fn ulps(a: f32, b: f32) -> u32 {
    a.to_bits().abs_diff(b.to_bits())
}

/// The curve and the statistics that the device finds, and the mapped image.
fn on_device(
    gpu: &Gpu,
    settings: ToneSettings,
    image: &[f32],
) -> Result<(ToneParameters, Statistics, Vec<f32>)> {
    let mut pseudo_gt = PseudoGt::new(gpu, &settings)?;
    let image = gpu.buffer("image", image)?;
    let mut target = gpu.zeros("target", image.len())?;
    let size = [image.len() as u32 / 3, 1];
    gpu.run("statistics", |pass| pseudo_gt.statistics(pass, &image, size))?;
    let measured = pseudo_gt.measured()?;
    assert_eq!(pseudo_gt.luminance_histogram()?, LuminanceHistogram::of(&gpu.read(&image)?));
    let parameters = settings.parameters(&measured);
    let uploaded = gpu.buffer("tone parameters", &[parameters])?;
    gpu.run("target", |pass| pseudo_gt.map(pass, &image, &uploaded, 0, &mut target))?;
    Ok((parameters, measured, gpu.read(&target)?))
}

const SIZES: [usize; 6] = [1, 1023, 1024, 1025, 4097, 50_021];

#[test]
fn luminance_matches_the_reference() {
    for pixels in SIZES {
        let mut image = dark(pixels, 3);
        image[0] = f32::NAN;
        image[pixels / 2] = -0.5;
        image[2 * pixels] = f32::INFINITY;
        for thread_count in [1024, 2048] {
            let params = luminance::Params {
                ranks: [0, 1, 2, 3],
                pixel_count: pixels as u32,
                thread_count,
                first_search: 4,
                first_sum: 7,
            };
            let constants = luminance::Constants {};
            let luminances = vec![0.0; pixels];
            let sums = vec![Vec3::ZERO; thread_count as usize + 7];
            let searches = vec![RankSearch::default(); 8];
            let histograms = vec![9; 4096];
            let expected = run_reference!(
                luminance,
                constants,
                params,
                [image],
                [luminances, sums, searches, histograms]
            );
            let threads = Threads::Exactly([thread_count, 1, 1]);
            let actual = run_kernel!(
                luminance,
                constants,
                params,
                threads,
                [image],
                [luminances, sums, searches, histograms]
            );
            assert_eq!(actual, expected, "{pixels} pixels");
        }
    }
}

#[test]
fn luminance_histogram_and_percentile_select_match_their_references() {
    for pixels in SIZES {
        let luminances = dark(pixels, 5)[..pixels].to_vec();
        let last = pixels as u32 - 1;
        let ranks = [last / 10, last.min(last / 10 + 1), last / 2, last];
        let mut searches = ranks.map(|rank| RankSearch { prefix: 0, rank, histogram: 0 }).to_vec();
        let mut histograms = vec![0; 4096];
        // Below 2 the first digit has no more than ten bits, so one kernel counts all three.
        for (shift, digit_bits) in [(20, 11), (10, 10), (0, 10)] {
            let params = luminance_histogram::Params {
                pixel_count: pixels as u32,
                thread_count: 1024,
                shift,
                first_search: 0,
            };
            let constants = luminance_histogram::Constants {};
            let threads = Threads::Exactly([1024, 1, 1]);
            let expected = run_reference!(
                luminance_histogram,
                constants,
                params,
                [luminances, searches],
                [histograms]
            );
            histograms = run_kernel!(
                luminance_histogram,
                constants,
                params,
                threads,
                [luminances, searches],
                [histograms]
            );
            assert_eq!(histograms, expected, "{pixels} pixels, shift {shift}");

            let params = percentile_select::Params { digit_bits, first_search: 0 };
            let constants = percentile_select::Constants {};
            let threads = Threads::Workgroups([1, 1, 1]);
            let expected =
                run_reference!(percentile_select, constants, params, [], [searches, histograms]);
            (searches, histograms) = run_kernel!(
                percentile_select,
                constants,
                params,
                threads,
                [],
                [searches, histograms]
            );
            assert_eq!((&searches, &histograms), (&expected.0, &expected.1), "shift {shift}");
            assert_eq!(histograms, vec![0; 4096]);
        }
        let mut sorted = luminances;
        sorted.sort_by(f32::total_cmp);
        let found: Vec<f32> = searches.iter().map(|found| f32::from_bits(found.prefix)).collect();
        assert_eq!(found, ranks.map(|rank| sorted[rank as usize]), "{pixels} pixels");
    }
}

#[test]
fn tone_statistics_matches_the_reference() {
    let gpu = gpu();
    let mut state = 11;
    let sums: Vec<Vec3> =
        (0..2048).map(|_| Vec3::from_array([0; 3].map(|_| noise(&mut state)))).collect();
    let searches = [0.01, 0.012, 0.2, 0.22, 0.15, 0.16, 0.15, 0.16f32].map(|x| RankSearch {
        prefix: x.to_bits(),
        rank: 0,
        histogram: 0,
    });
    for takes_p80 in [false, true] {
        let constants = tone_statistics::Constants { takes_p80 };
        let pipeline = gpu.pipeline::<tone_statistics::Kernel>(&constants).unwrap();
        for sum_count in [1, 255, 256, 257, 2048] {
            let weights = Vec3::new(0.3, 0.7, 0.4);
            let params = tone_statistics::Params { weights, pixel_count: 9999, sum_count };
            let mut statistics = vec![ToneStatistics::default()];
            let slices = tone_statistics::Slices {
                searches: &searches,
                sums: &sums,
                statistics: &mut statistics,
            };
            tone_statistics::Kernel::run(&params, &constants, slices);
            let mut device_statistics = gpu.zeros("statistics", 1).unwrap();
            let device_searches = gpu.buffer("searches", &searches).unwrap();
            let device_sums = gpu.buffer("sums", &sums).unwrap();
            let bound = tone_statistics::Buffers {
                searches: device_searches.slice(),
                sums: device_sums.slice(),
                statistics: device_statistics.slice_mut(),
            };
            gpu.run("tone_statistics", |pass| {
                pass.dispatch(&pipeline, &params, bound, Threads::Workgroups([1, 1, 1]))
            })
            .unwrap();
            let found = gpu.read(&device_statistics).unwrap()[0];
            let percentiles = |of: &ToneStatistics| [of.p10, of.p80, of.p90];
            assert_eq!(percentiles(&found), percentiles(&statistics[0]));
            assert_eq!(found.p80 > 0.0, takes_p80);
            // The sums are the same bits; a division may be off by 2.5 ulp.
            assert!(ulps(found.mean_luminance, statistics[0].mean_luminance) <= 3, "{found:?}");
            assert!(ulps(found.mean, statistics[0].mean) <= 6, "{found:?}");
            for (found, expected) in found
                .channel_means
                .to_array()
                .into_iter()
                .zip(statistics[0].channel_means.to_array())
            {
                assert!(ulps(found, expected) <= 3, "{found}, not {expected}");
            }
        }
    }
}

/// Equal but for what the device's means, which are sums in f32, make of the curve.
fn near(a: &ToneParameters, b: &ToneParameters) -> bool {
    let close = |a: f32, b: f32, bound: f32| (a - b).abs() <= bound * b.abs();
    close(a.white, b.white, 1e-6)
        && close(a.offset, b.offset, 5e-6)
        && close(a.gain, b.gain, 1e-6)
        && a.constants.iter().zip(b.constants).all(|(&a, b)| close(a, b, 1e-6))
}

#[test]
fn a_curve_follows_the_host_from_tiny_to_huge_values() {
    let gpu = gpu();
    let mut grid: Vec<f32> = (0..=20_000).map(|i| i as f32 / 5000.0).collect();
    grid.extend([0.0, 1e-12, 1e-9, 1e-6, 0.009_999, 0.01, 0.010_001, 65.0, 1e6, f32::MAX]);
    grid.extend([f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, -1e-9]);
    grid.resize(grid.len().next_multiple_of(3), 0.0);
    for curve in [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::None] {
        let pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(curve)).unwrap();
        let image = gpu.buffer("image", &grid).unwrap();
        for (white, offset, gain) in [(1.0, 0.0, 1.0), (0.0816, 0.0754, 1.16), (1e-6, 0.12, 4.0)] {
            let tone = ToneParameters { white, offset, gain, weight: 1.0, constants: [0.0; 8] };
            let parameters = [ToneParameters::default(), tone];
            let parameters = gpu.buffer("parameters", &parameters).unwrap();
            let mut target = gpu.zeros("target", grid.len()).unwrap();
            gpu.run("target", |pass| pseudo_gt.map(pass, &image, &parameters, 1, &mut target))
                .unwrap();
            for (&x, found) in grid.iter().zip(gpu.read(&target).unwrap()) {
                let expected = curve.apply(x, &tone);
                // exp may be off by 3 + 2 |x| ulp; tiny values keep their relative precision.
                let bound = if offset == 0.0 && x / white < 1e-3 { 4e-7 * expected } else { 5e-7 };
                assert!(
                    (found - expected).abs() <= bound,
                    "{curve}({x}) = {found}, not {expected}"
                );
            }
        }
    }
}

#[test]
fn device_statistics_equal_the_host_s() {
    let gpu = gpu();
    let mut state = 17;
    let photographs = [
        ("one black pixel", vec![0.0; 3]),
        ("one white pixel", vec![1.0; 3]),
        ("two pixels", vec![0.1, 0.7, 0.2, 0.3, 0.0, 0.9]),
        ("black", vec![0.0; 30_000]),
        ("white", vec![1.0; 30_000]),
        ("constant", vec![0.03; 3 * 4001]),
        (
            "one dot in the dark",
            (0..30_000).map(|i| f32::from(u8::from(i % 10_000 == 0))).collect(),
        ),
        ("not finite", vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.5, 1e30]),
        ("float noise", dark(70_001, 1)),
        ("8-bit noise", dark_8_bit(187_500, 2)),
        (
            "every magnitude",
            (0..30_000).map(|_| 10f32.powf(noise(&mut state) * 16.0 - 12.0)).collect(),
        ),
    ];
    for (name, image) in &photographs {
        let host = Statistics::of(image);
        for curve in CURVES {
            let settings = ToneSettings::new(curve);
            let (found, device, target) = on_device(&gpu, settings.clone(), image).unwrap();
            assert_eq!([device.p10, device.p90], [host.p10, host.p90], "{name}");
            if curve == ToneCurve::P80 {
                assert_eq!(device.p80, host.p80, "{name}");
            }
            for (device, host) in
                [(device.mean_luminance, host.mean_luminance), (device.mean, host.mean)]
            {
                assert!((device - host).abs() <= 1e-6 * host, "{name}: mean {device}, not {host}");
            }
            let expected = settings.parameters(&host);
            assert!(near(&found, &expected), "{name}, {curve}: {found:?}, not {expected:?}");
            assert!(target.iter().all(|y| (0.0..=1.0).contains(y)), "{name}, {curve}");
        }
    }
}

#[test]
fn photographs_of_different_sizes_share_one_recording() {
    let gpu = gpu();
    let mut pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(ToneCurve::Ap3)).unwrap();
    let images = [(40, 30, 1), (200, 100, 2), (7, 3, 3)]
        .map(|(w, h, seed)| ([w, h], dark((w * h) as usize, seed)));
    let buffers =
        images.each_ref().map(|(size, image)| (*size, gpu.buffer("image", image).unwrap()));
    for count in 1..=buffers.len() {
        gpu.run("statistics", |pass| {
            let mut photographs = buffers[..count].iter();
            photographs.try_for_each(|(size, image)| pseudo_gt.statistics(pass, image, *size))
        })
        .unwrap();
        let settings = pseudo_gt.settings();
        let found = settings.parameters(&pseudo_gt.measured().unwrap());
        let expected = settings.parameters(&Statistics::of(&images[count - 1].1));
        assert!(near(&found, &expected), "{found:?}, not {expected:?}");
    }
}

#[test]
fn a_photograph_in_tiles_has_the_statistics_of_the_whole() {
    let gpu = gpu();
    let pixels = 10_007;
    let image = dark_8_bit(pixels, 9);
    let host = Statistics::of(&image);
    for curve in [ToneCurve::Ap3, ToneCurve::P80] {
        for tile_pixels in [1000, 3333, 10_006] {
            let tiles = (0..pixels).step_by(tile_pixels).map(|first| {
                let last = pixels.min(first + tile_pixels);
                let planes = [0, 1, 2].map(|plane| &image[plane * pixels..][first..last]);
                gpu.buffer("tile", &planes.concat()).unwrap()
            });
            let tiles: Vec<_> = tiles.collect();
            let tiles: Vec<_> = tiles.iter().collect();
            let mut pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(curve)).unwrap();
            gpu.run("tiles", |pass| pseudo_gt.statistics_of_tiles(pass, &tiles)).unwrap();
            let found = pseudo_gt.measured().unwrap();
            let luminance = pseudo_gt.luminance_histogram().unwrap();
            assert_eq!(luminance, LuminanceHistogram::of(&image), "tiles of {tile_pixels}");
            assert_eq!([found.p10, found.p90], [host.p10, host.p90], "tiles of {tile_pixels}");
            assert!((found.mean_luminance - host.mean_luminance).abs() <= 1e-6 * host.mean);
            let [found, expected] =
                [found, host].map(|statistics| ToneSettings::new(curve).parameters(&statistics));
            assert!(near(&found, &expected), "{found:?}, not {expected:?}");
        }
    }
}

#[test]
fn the_same_photograph_gives_the_same_bits() {
    let gpu = gpu();
    let image = dark(50_000, 4);
    let first = on_device(&gpu, ToneSettings::new(ToneCurve::Ap3), &image).unwrap();
    for _ in 0..24 {
        assert_eq!(on_device(&gpu, ToneSettings::new(ToneCurve::Ap3), &image).unwrap(), first);
    }
}

#[test]
fn what_cannot_be_measured_or_mapped_is_refused() {
    let gpu = gpu();
    let mut pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::new(ToneCurve::Ap3)).unwrap();
    let image = gpu.zeros("image", 36).unwrap();
    let empty = gpu.zeros("image", 0).unwrap();
    let parameters = gpu.zeros("tone parameters", 1).unwrap();
    let mut short = gpu.zeros("target", 35).unwrap();
    let refused =
        |what: &str, record: &mut dyn FnMut(&mut nightsplat::gpu::Recorder<'_>) -> Result<()>| {
            let result = gpu.run("refused", |pass| record(pass));
            assert!(matches!(result, Err(Error::Usage(_))), "{what}: {result:?}");
        };
    refused("another size", &mut |pass| pseudo_gt.statistics(pass, &image, [4, 4]));
    refused("no pixels", &mut |pass| pseudo_gt.statistics(pass, &empty, [0, 4]));
    refused("no such view", &mut |pass| pseudo_gt.map(pass, &image, &parameters, 1, &mut short));
    refused("short target", &mut |pass| pseudo_gt.map(pass, &image, &parameters, 0, &mut short));
    let bad = ToneSettings { theta: 0.0, ..ToneSettings::new(ToneCurve::Ap3) };
    assert!(matches!(PseudoGt::new(&gpu, &bad), Err(Error::Setting { .. })));
}

#[test]
fn a_photograph_maps_on_the_device_as_on_the_host() {
    let committed = ["000", "001", "002"].map(|name| fixture(&format!("lom/low/{name}.png")));
    for path in committed.into_iter().chain(shared("data/lom/chair/low/1.JPG")) {
        let image = Image::load(path).unwrap().data;
        for curve in [ToneCurve::Linear, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::Hybrid] {
            let settings = ToneSettings::new(curve);
            let (_, _, target) = on_device(&gpu(), settings.clone(), &image).unwrap();
            let parameters = settings.parameters(&Statistics::of(&image));
            let mapped: Vec<f32> = image.iter().map(|&x| curve.apply(x, &parameters)).collect();
            assert_close(curve.name(), &target, &mapped, |_, _| 5e-6);
        }
    }
}

#[test]
fn a_fixed_offset_is_that_of_every_photograph() {
    let gpu = gpu();
    let settings = ToneSettings { alpha: 0.07, beta: 0.0, ..ToneSettings::new(ToneCurve::Ap3) };
    for image in [dark(400, 5), vec![0.0; 300], vec![0.2; 300]] {
        let expected = settings.parameters(&Statistics::of(&image));
        assert_eq!(expected.offset, 0.07);
        let (found, ..) = on_device(&gpu, settings.clone(), &image).unwrap();
        assert!(near(&found, &expected), "{found:?}, not {expected:?}");
    }
}
