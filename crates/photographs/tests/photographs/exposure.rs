//! The brightness of automatic targets: the rule against a slow one over pixels, and unusual datasets.

use glam::{DAffine3, DVec2, DVec3};
use nightsplat_core::camera::{Camera, CameraModel};
use nightsplat_core::image::srgb_from_linear;
use nightsplat_core::random::Stream;
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::{
    CurveEnds, Exposure, LuminanceHistogram, MeasuredPhotograph, NEAR_WHITE, Statistics,
    ToneSettings, exposure_knots, soft,
};

/// A reproducible photograph with luminance close to black, planar; `contrast` is the exponent of its distribution.
fn photograph(pixels: usize, brightness: f32, contrast: i32, seed: u64) -> Vec<f32> {
    let mut state = seed;
    let mut noise = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    (0..3 * pixels).map(|_| (brightness * noise().powi(contrast)).min(1.0)).collect()
}

fn scaled(planes: &[f32], factor: f32) -> Vec<f32> {
    planes.iter().map(|x| (x * factor).min(1.0)).collect()
}

fn luminances(planes: &[f32]) -> Vec<f64> {
    let n = planes.len() / 3;
    let of = |i| {
        [0.299, 0.587, 0.114]
            .iter()
            .zip([i, n + i, 2 * n + i])
            .map(|(w, at)| w * f64::from(planes[at]))
    };
    (0..n).map(|i| of(i).sum()).collect()
}

/// The rule by testing gains, a thousandth apart, on every pixel.
fn slow_gain(luminances: &[f64], saturation: f64) -> f64 {
    let mut sorted = luminances.to_vec();
    sorted.sort_by(f64::total_cmp);
    let quantile = |fraction: f64| sorted[(fraction * (sorted.len() - 1) as f64) as usize];
    let limit = quantile(0.999).min(2.5 * quantile(0.9));
    let n = sorted.len() as f64;
    let cubes: f64 = sorted.iter().map(|y| y.min(limit).powf(3.0)).sum();
    let mut gain = 0.9 / (cubes / n).powf(1.0 / 3.0);
    let mean =
        |k: f64| sorted.iter().map(|y| 0.075 + 0.925 * (1.0 - (-k * y).exp())).sum::<f64>() / n;
    while mean(gain) < 0.42 {
        gain *= 1.001;
    }
    while mean(gain) > 0.54 {
        gain /= 1.001;
    }
    (gain / colourful(saturation)).min(128.0)
}

/// What the rule divides the gain by.
fn colourful(saturation: f64) -> f64 {
    (0.6 * (saturation.clamp(0.175, 0.65) - 0.3)).exp()
}

fn saturation(planes: &[f32]) -> f64 {
    let n = planes.len() / 3;
    let pixel = |at: usize| [0, 1, 2].map(|channel| f64::from(planes[channel * n + at]));
    let largest = |rgb: [f64; 3]| rgb.into_iter().fold(0.0, f64::max);
    let chroma = |rgb: [f64; 3]| largest(rgb) - rgb.into_iter().fold(1.0, f64::min);
    (0..n).map(|at| chroma(pixel(at))).sum::<f64>()
        / (0..n).map(|at| largest(pixel(at))).sum::<f64>()
}

fn exposure(views: &[Vec<f32>]) -> Option<Exposure> {
    let views: Vec<_> = views.iter().map(|view| LuminanceHistogram::new(view)).collect();
    Exposure::measure(&views, None)
}

#[test]
fn the_gain_agrees_with_a_search_over_all_pixels() {
    let mut bounded = [0; 3];
    for (seed, brightness) in [(1, 0.05), (2, 0.1), (3, 0.3), (4, 1.0)] {
        for contrast in [1, 2, 4, 12] {
            let planes = photograph(20_000, brightness, contrast, seed);
            let (luminances, saturation) = (luminances(&planes), saturation(&planes));
            let Some(exposure) = exposure(&[planes]) else { continue };
            if exposure.ends.toe_weight > 0.0 {
                continue;
            }
            let slow = slow_gain(&luminances, saturation);
            assert!((exposure.gain / slow - 1.0).abs() < 3e-3, "{}, not {slow}", exposure.gain);
            let gain = exposure.gain * colourful(saturation);
            let mean = luminances.iter().map(|&y| soft(y, gain)).sum::<f64>() / 20_000.0;
            bounded[usize::from(mean > 0.4205) + usize::from(mean > 0.5395)] += 1;
        }
    }
    assert!(bounded.iter().all(|&count| count > 0), "bounds were not met: {bounded:?}");
}

#[test]
fn the_mean_rises_with_the_gain_and_with_the_requested_brightness() {
    let views = [1, 2, 3].map(|seed| LuminanceHistogram::new(&photograph(5000, 0.2, 3, seed)));
    let mut last = 0.0;
    for gain in (-20..=20).map(|step| f64::from(step).exp2().powf(0.35)) {
        let mean = views[0].mean_of(|y| soft(y, gain));
        assert!(mean > last, "{gain}");
        last = mean;
    }
    let mut last = 0.0;
    for brightness in [0.2, 0.4, 0.5, 0.7, 0.9] {
        let exposure = Exposure::measure(&views, Some(brightness)).unwrap();
        assert!((exposure.target - brightness).abs() < 1e-9);
        assert_eq!(exposure.weight(), 1.0);
        assert!(exposure.gain > last);
        last = exposure.gain;
    }
}

#[test]
fn darker_views_have_a_higher_gain_and_equal_ones_the_scene_s() {
    let view = photograph(20_000, 0.1, 2, 7);
    let histogram = LuminanceHistogram::new(&view);
    let equal = exposure(&vec![view.clone(); 3]).unwrap();
    assert!(equal.spread < 1e-12);
    assert!((equal.gain_of(&histogram, None) / equal.gain - 1.0).abs() < 1e-9);
    let single = exposure(std::slice::from_ref(&view)).unwrap();
    assert!((single.gain / equal.gain - 1.0).abs() < 1e-12);

    let factors = [1.0, 0.5, 0.25, 2.0];
    let views = factors.map(|factor| scaled(&view, factor));
    let varied = exposure(&views).unwrap();
    assert!((varied.spread / 2f64.ln() - 1.118).abs() < 0.02, "{}", varied.spread);
    assert!(varied.share > 0.95 && varied.share < 1.0);
    // Almost all of the difference is compensated: the targets are equally bright.
    let means = views.each_ref().map(|view| {
        let histogram = LuminanceHistogram::new(view);
        histogram.mean_of(|y| soft(y, varied.gain_of(&histogram, None)))
    });
    let [low, high] = [f64::min, f64::max].map(|of| means.into_iter().reduce(of).unwrap());
    assert!(high - low < 0.03, "{means:?}");
    let shared = varied.clone().shared();
    assert!((shared.gain_of(&histogram, None) / varied.gain - 1.0).abs() < 1e-12);
}

/// Cameras along a path, one step apart, that look ahead.
fn camera(step: usize) -> Camera {
    Camera {
        width: 8,
        height: 8,
        focal: DVec2::splat(8.0),
        principal_point: DVec2::splat(4.0),
        model: CameraModel::Pinhole,
        view_from_world: DAffine3::from_translation(-(step as f64) * DVec3::X),
    }
}

/// The gains of views along a path that are scaled by factors, and the share of the differences that remains.
fn gains_along(factors: &[f32]) -> (Vec<f64>, f64) {
    let view = photograph(20_000, 0.1, 2, 7);
    let views: Vec<_> =
        factors.iter().map(|&factor| LuminanceHistogram::new(&scaled(&view, factor))).collect();
    let seen = views.iter().enumerate().map(|(i, view)| (view, camera(i)));
    let exposure = Exposure::measure(&views, None).unwrap().seen_by(seen);
    let gain = |(i, view)| exposure.gain_of(view, Some(&camera(i)));
    (views.iter().enumerate().map(gain).collect(), exposure.share)
}

#[test]
fn neighbouring_views_have_similar_gains_unless_their_exposures_differ() {
    let spread = |gains: &[f64]| {
        let [low, high] = [f64::min, f64::max].map(|of| gains.iter().copied().reduce(of).unwrap());
        (high / low).log2()
    };
    // Small differences between views are attributed to their content: the targets agree.
    let flicker: Vec<f32> = (0..40).map(|i| if i % 2 == 0 { 1.0 } else { 1.1 }).collect();
    let (gains, share) = gains_along(&flicker);
    assert!(spread(&gains[5..35]) < 0.3 * 1.1_f64.log2(), "{}", spread(&gains[5..35]));
    assert!(share < 0.3, "{share}");
    // A change along the path is followed.
    let drift: Vec<f32> = (0..40).map(|i| 1.02_f32.powi(i)).collect();
    let (gains, share) = gains_along(&drift);
    assert!(share > 0.8 && spread(&gains) > 0.8 * 39.0 * 1.02_f64.log2(), "{share}");
    // Photographs a stop apart are compensated individually.
    let stops: Vec<f32> = (0..40).map(|i| if i % 2 == 0 { 1.0 } else { 0.5 }).collect();
    let (gains, share) = gains_along(&stops);
    assert!(share > 0.9 && spread(&gains) > 0.9, "{share}");
}

#[test]
fn a_view_beyond_all_others_has_the_gain_of_the_nearest() {
    let views: Vec<_> = [1.0, 0.8]
        .map(|factor| LuminanceHistogram::new(&scaled(&photograph(20_000, 0.1, 2, 7), factor)))
        .into();
    let seen = views.iter().enumerate().map(|(i, view)| (view, camera(100 * i)));
    let exposure = Exposure::measure(&views, None).unwrap().seen_by(seen);
    let [near, far] = [0, 1].map(|i| exposure.gain_of(&views[i], Some(&camera(100 * i))));
    let beyond = exposure.gain_of(&views[1], Some(&camera(100_000)));
    assert!(far > near && (beyond / far - 1.0).abs() < 1e-9, "{beyond}, not {far}");
    let shared = exposure.clone().shared().gain_of(&views[1], Some(&camera(0)));
    assert!((shared / exposure.gain - 1.0).abs() < 1e-12);
}

#[test]
fn an_image_at_one_gain_is_converted_to_another() {
    for gains in [[10.0, 14.0], [14.0, 10.0], [3.0, 60.0], [8.0, 8.0]] {
        for weight in [1.0, 0.4] {
            let knots = exposure_knots(&CurveEnds::default(), gains, weight);
            assert!(knots.is_sorted_by(|a, b| a[0] <= b[0] && a[1] <= b[1]), "{gains:?}");
            for x in [0.0, 0.001, 0.02, 0.1, 0.3] {
                let [from, to] =
                    gains.map(|gain| ((1.0 - weight) * x + weight * soft(x, gain)) as f32);
                let above = knots.partition_point(|knot| knot[0] <= from).clamp(1, knots.len() - 1);
                let [[x0, y0], [x1, y1]] = [knots[above - 1], knots[above]];
                let found = y0 + (from - x0) / (x1 - x0).max(f32::MIN_POSITIVE) * (y1 - y0);
                assert!((found - to).abs() < 2e-3, "{gains:?} at {x}: {found}, not {to}");
            }
        }
    }
}

#[test]
fn a_thousandth_of_hot_pixels_hardly_changes_the_gain() {
    let clean = photograph(40_000, 0.08, 2, 5);
    let mut hot = clean.clone();
    for plane in hot.chunks_mut(40_000) {
        plane.iter_mut().step_by(1250).for_each(|x| *x = 1.0);
    }
    let [clean, hot] = [clean, hot].map(|planes| exposure(&[planes]).unwrap().gain);
    assert!((hot / clean - 1.0).abs() < 0.02, "{hot}, not {clean}");
}

#[test]
fn black_views_are_left_out_and_a_black_set_has_no_exposure() {
    let good = photograph(20_000, 0.1, 2, 7);
    let black = scaled(&good, 0.05);
    let with = exposure(&[good.clone(), black.clone(), vec![0.0; 3000]]).unwrap();
    let without = exposure(&[good]).unwrap();
    assert_eq!((with.gain, with.black), (without.gain, 2));
    assert_eq!(with.gain_of(&LuminanceHistogram::new(&black), None), with.gain);
    assert!(with.reason().contains("2 almost black"), "{}", with.reason());
    assert_eq!(exposure(&[black, vec![0.0; 3000]]), None);
    assert_eq!(exposure(&[]), None);
}

#[test]
fn a_well_lit_set_has_no_curve_and_one_between_a_blend() {
    let bright = photograph(20_000, 0.8, 1, 3);
    let [well_lit, between, dark] =
        [1.0, 0.77, 0.2].map(|factor| exposure(&[scaled(&bright, factor)]).unwrap());
    assert_eq!(well_lit.weight(), 0.0, "{well_lit:?}");
    assert!(between.weight() > 0.0 && between.weight() < 1.0, "{between:?}");
    assert_eq!(dark.weight(), 1.0, "{dark:?}");
    for (exposure, part) in [(well_lit, "no curve"), (between, "% of a curve"), (dark, "gain")] {
        assert!(exposure.reason().contains(part), "{}", exposure.reason());
    }
    // One view has no spread; if one of two is half as bright as the other, each is half a stop from their mean.
    let stops = |views: &[Vec<f32>]| exposure(views).unwrap().reason();
    let view = scaled(&bright, 0.2);
    assert!(!stops(std::slice::from_ref(&view)).contains("give or take"));
    let two = stops(&[view.clone(), scaled(&view, 0.5)]);
    assert!(two.contains("give or take 0.5 stops between the views"), "{two}");
    // Half of the views are well lit: the set is dark on average, and every view gets the same brightness.
    let half = exposure(&[bright.clone(), scaled(&bright, 0.05)]).unwrap();
    assert!(half.weight() > 0.0 && half.share > 0.95, "{half:?}");
}

#[test]
fn the_histogram_has_the_mean_of_the_statistics() {
    for (brightness, contrast) in [(0.05, 2), (0.3, 4), (1.0, 1)] {
        let planes = photograph(30_000, brightness, contrast, 11);
        let mean = f64::from(Statistics::new(&planes).mean_luminance);
        let found = LuminanceHistogram::new(&planes).mean();
        assert!((found / mean - 1.0).abs() < 3e-4, "{found}, not {mean}");
    }
}

/// A grey photograph of a dark scene: a third each dark, middle and bright.
fn evenly_lit(pixels: usize) -> Vec<f32> {
    let level = |i: usize| [0.02, 0.04, 0.08][i % 3] * (1.0 + 0.1 * (i % 7) as f32);
    (0..3 * pixels).map(|i| level(i % pixels)).collect()
}

/// With a share of its pixels at this level, from the first on.
fn with_share(planes: &[f32], share: f64, level: f32) -> Vec<f32> {
    let pixels = planes.len() / 3;
    let covered = (share * pixels as f64) as usize;
    let pixel = |(i, &x): (usize, &f32)| if i % pixels < covered { level } else { x };
    planes.iter().enumerate().map(pixel).collect()
}

#[test]
fn a_night_sky_stays_black_and_does_not_whiten_the_ground() {
    let ground = evenly_lit(30_000);
    let plain = exposure(std::slice::from_ref(&ground)).unwrap();
    assert_eq!(plain.ends, CurveEnds::default());
    let night = exposure(&[with_share(&ground, 0.6, 1.0 / 255.0)]).unwrap();
    assert!(night.ends.toe_weight == 1.0 && night.has_black_sky(), "{night:?}");
    assert!((night.sky - 0.6).abs() < 0.02 && plain.sky < 0.1, "{} {}", night.sky, plain.sky);
    let target = |x: f32| night.ends.soft(x.into(), night.gain);
    let ground_mean = luminances(&ground).iter().map(|&y| target(y as f32)).sum::<f64>() / 30_000.0;
    assert!((0.40..=0.50).contains(&ground_mean), "{ground_mean}");
    assert!(target(0.0) == 0.0 && target(1.0 / 255.0) < 0.08, "{}", target(1.0 / 255.0));
    // A share between is left out in part.
    let half = exposure(&[with_share(&ground, 0.38, 1.0 / 255.0)]).unwrap();
    assert!((0.2..0.8).contains(&half.ends.toe_weight), "{:?}", half.ends);
}

#[test]
fn lamps_hardly_change_the_gain_and_a_window_bends_the_shoulder() {
    let dark = evenly_lit(30_000);
    let plain = exposure(std::slice::from_ref(&dark)).unwrap();
    for (share, least) in [(0.002, 0.95), (0.02, 0.75)] {
        let lamp = exposure(&[with_share(&dark, share, 1.0)]).unwrap();
        assert!(lamp.gain / plain.gain > least, "{share}: {} for {}", lamp.gain, plain.gain);
    }
    let window = with_share(&dark, 0.09, 0.6);
    let found = exposure(std::slice::from_ref(&window)).unwrap();
    assert!(found.ends.shoulder > 0.0);
    let near_white = |ends: CurveEnds| {
        let values = luminances(&window).into_iter().map(|y| ends.soft(y, found.gain));
        values.filter(|&value| value > NEAR_WHITE + 1e-3).count()
    };
    assert!(near_white(CurveEnds::default()) > 2600);
    assert!(near_white(found.ends) <= 600, "{}", near_white(found.ends));
}

#[test]
fn lit_photographs_among_dark_ones_are_targets_and_set_the_brightness_of_the_others() {
    let dark = evenly_lit(30_000);
    let lit = scaled(&dark, 10.0);
    let views = [&dark, &lit, &dark, &lit, &dark].map(|view| LuminanceHistogram::new(view));
    let found = Exposure::measure(&views, None).unwrap();
    assert_eq!(found.lit, 2);
    assert!(found.reason().contains("2 well lit"), "{}", found.reason());
    let mean = views[0].mean_of(|y| soft(y, found.gain_of(&views[0], None)));
    assert!((mean / views[1].mean() - 1.0).abs() < 0.02, "{mean}, not {}", views[1].mean());
    let settings = ToneSettings::default();
    let measured = [&dark, &lit].map(|view| MeasuredPhotograph::measure(view));
    let all = [0, 1, 0, 1, 0].map(|at: usize| measured[at].clone());
    let scene = SceneTone::from_photographs(&settings, &all).unwrap();
    let [dark, lit] = measured.each_ref().map(|one| scene.curve_of(one));
    assert_eq!([dark.weight, lit.weight], [1.0, 0.0]);
    assert_eq!(scene.gain_of(&measured[1]), None);
    // Neither one of a kind, nor a narrow gap, nor a requested brightness separates them.
    for views in [&views[..2], &[views[0].clone(), views[2].clone()]] {
        assert_eq!(Exposure::measure(views, None).unwrap().lit, 0);
    }
    assert_eq!(Exposure::measure(&views, Some(0.5)).unwrap().lit, 0);
}

#[test]
fn a_photograph_of_one_channel_has_the_brightness_of_that_channel() {
    let grey = evenly_lit(30_000);
    let mut green = vec![0.0; grey.len()];
    green[30_000..60_000].copy_from_slice(&grey[30_000..60_000]);
    let [grey, green] = [grey, green].map(|planes| exposure(&[planes]).unwrap());
    assert!((green.gain / grey.gain - 1.0).abs() < 1e-9, "{}, not {}", green.gain, grey.gain);
}

#[test]
fn noise_that_reaches_below_black_hardly_changes_the_gain() {
    // Light that changes slowly, in three colours, with a fine texture.
    let light = |i: usize| {
        let slow = 0.002 + 0.01 * (i % 4096) as f32 / 4096.0 * (1.0 - 0.2 * (i / 20_000) as f32);
        slow * if i % 8 < 4 { 1.4 } else { 0.6 }
    };
    let clean: Vec<f32> = (0..60_000).map(light).collect();
    let median = 0.006;
    let stream = Stream::new(1, 1);
    let gain = |decibels: Option<f32>| {
        let sigma = decibels.map_or(0.0, |decibels| median * 10.0_f32.powf(-decibels / 20.0));
        let noisy = (0..)
            .zip(&clean)
            .map(|(i, light)| srgb_from_linear(light + sigma * stream.normal(i) as f32));
        let measured = MeasuredPhotograph::measure(&noisy.collect::<Vec<_>>());
        Exposure::measure([&measured.luminance], None).unwrap().gain
    };
    let right = gain(None);
    for decibels in [10.0, 6.0, 3.0, 0.0, -4.0] {
        let found = gain(Some(decibels));
        assert!((found / right).log2().abs() < 0.15, "{decibels} dB: {found} for {right}");
    }
}
