//! Every kernel on the data of a training step.
//!
//! Each works on what the device made of the one before it, so an error shows where it arises. The strict bounds are
//! those of the tests; here a kernel passes when it does the same work.

mod bin;
mod learn;
mod losses;
mod nn;
mod window;

use glam::Vec3;

use super::check::Rule::{Close, Exact};
use super::check::check;
use super::scene::{self, Scene};
use super::{Bench, Timing};
use crate::gpu::Threads;
use crate::kernels::*;
use crate::tone::{Table, ToneCurve, ToneSettings};

/// The constants that the kernels of the rasteriser share.
macro_rules! constants {
    ($bench:expr, $kernel:ident $(, $field:ident: $value:expr)*) => {{
        let settings = $crate::render::RenderSettings::default();
        let ([tile_width, tile_height], alpha_max) = (settings.tile_on(&$bench.gpu), settings.max_alpha);
        $kernel::Constants { alpha_max, channels: 3, tile_width, tile_height, $($field: $value,)* }
    }};
}

use constants;

/// Every kernel, in the order of a training step.
///
/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn check_and_time(bench: &Bench, scene: &Scene) -> anyhow::Result<Vec<Timing>> {
    let mut timings = vec![];
    let tone = statistics(bench, &mut timings)?;
    let frame = bin::project_and_bin(bench, &mut timings, scene)?;
    learn::blend_and_back(bench, &mut timings, scene, &frame, tone)?;
    window::copy(bench, &mut timings)?;
    nn::repeat_and_ends(bench, &mut timings)?;
    Ok(timings)
}

/// The pseudo-GT of a Full-HD photograph; gives the curve.
fn statistics(bench: &Bench, timings: &mut Vec<Timing>) -> anyhow::Result<ToneParameters> {
    const THREADS: u32 = 128 * 256;
    let photograph = scene::dark(1920, 1080);
    let (pixel_count, image) = (photograph.pixel_count() as u32, photograph.data);
    let settings = ToneSettings::default();
    let last = pixel_count - 1;
    let [p10, p90] = [1, 9].map(|tenths| last / 10 * tenths + last % 10 * tenths / 10);
    let luminances = vec![0.0_f32; pixel_count as usize];
    let sums = vec![Vec3::ZERO; THREADS as usize];
    let (searches, histograms) = (vec![RankSearch::default(); 4], vec![0_u32; 4096]);
    let (luminances, sums, searches, histograms) = check!(
        bench,
        timings,
        luminance,
        luminance::Constants::default(),
        luminance::Params {
            ranks: [p10, p10 + 1, p90, p90 + 1],
            pixel_count,
            thread_count: THREADS,
            first_search: 0,
            first_sum: 0,
        },
        Threads::Exactly([THREADS, 1, 1]),
        [image],
        [luminances: Close(1e-6), sums: Close(1e-5), searches: Exact, histograms: Close(0.0)]
    );
    let (mut searches, mut histograms) = check!(
        bench,
        timings,
        percentile_select,
        percentile_select::Constants::default(),
        percentile_select::Params { digit_bits: 11, first_search: 0 },
        Threads::Workgroups([1, 1, 1]),
        [],
        [searches: Exact, histograms: Exact]
    );
    for shift in [10, 0] {
        let (found,) = check!(
            bench,
            timings,
            luminance_histogram,
            luminance_histogram::Constants::default(),
            luminance_histogram::Params { pixel_count, thread_count: THREADS, shift, first_search: 0 },
            Threads::Exactly([THREADS, 1, 1]),
            [luminances, searches],
            [histograms: Exact]
        );
        histograms = found;
        (searches, histograms) = check!(
            bench,
            timings,
            percentile_select,
            percentile_select::Constants::default(),
            percentile_select::Params { digit_bits: 10, first_search: 0 },
            Threads::Workgroups([1, 1, 1]),
            [],
            [searches: Exact, histograms: Exact]
        );
    }
    let weight = |tenths: u32| (last % 10 * tenths % 10) as f32 / 10.0;
    let tone_curve = ToneCurve::Ap3.constant();
    let statistics = vec![ToneStatistics::default()];
    let (statistics,) = check!(
        bench,
        timings,
        tone_statistics,
        tone_statistics::Constants::default(),
        tone_statistics::Params {
            weights: Vec3::new(weight(1), weight(9), weight(8)),
            pixel_count,
            sum_count: THREADS,
        },
        Threads::Workgroups([1, 1, 1]),
        [searches, sums],
        [statistics: Close(1e-5)]
    );
    let parameters = vec![settings.parameters(&statistics[0].into())];
    let target = vec![0.0_f32; image.len()];
    let map_constants = tone_map::Constants { tone_curve, ..Default::default() };
    let threads = (image.len() as u32).div_ceil(4 * map_constants.quads_per_thread);
    check!(
        bench,
        timings,
        tone_map,
        map_constants,
        tone_map::Params { value_count: image.len() as u32, view: 0 },
        Threads::Exactly([threads, 1, 1]),
        [image, parameters],
        [target: Close(1e-5)]
    );
    check!(
        bench,
        timings,
        tone_mix,
        tone_mix::Constants { tone_curve: ToneCurve::LumPreserve.constant() },
        tone_mix::Params { pixel_count, view: 0 },
        Threads::Exactly([pixel_count, 1, 1]),
        [image, parameters],
        [target: Close(1e-5)]
    );
    let knots = Table {
        x: (0..64).map(|i| f64::from(i) / 16.0).collect(),
        y: vec![(0..64).map(|i| 1.0 - (-f64::from(i) / 16.0).exp()).collect()],
        ..Table::default()
    }
    .knots();
    check!(
        bench,
        timings,
        tone_table,
        tone_table::Constants::default(),
        tone_table::Params { pixel_count, view: 0, knot_count: 64 },
        Threads::Exactly([image.len() as u32, 1, 1]),
        [image, parameters, knots],
        [target: Close(1e-5)]
    );
    Ok(parameters[0])
}
