//! Every kernel on the data of a training step: checked against its CPU reference, then timed.
//!
//! Each kernel works on what the device made of the one before it, so an error shows where it arises. The strict
//! bounds are those of the tests; here a kernel passes when it does the same work.

use bytemuck::Pod;
use glam::{UVec2, Vec2, Vec3};

use super::scene::{self, Scene};
use super::{Bench, Timing, total};
use crate::gpu::{Kernel as _, Reference, Threads};
use crate::kernels::*;
use crate::loss::strip;
use crate::optimizer::Schedule;
use crate::random::Stream;
use crate::render::RenderSettings;
use crate::tone::{ToneCurve, ToneSettings};

/// How an output must agree with the reference's.
#[derive(Clone, Copy, Debug)]
enum Rule {
    /// In every bit.
    Exact,
    /// Within this fraction of its magnitude, or of the mean magnitude of all; one value in a thousand may lie on the
    /// other side of a cutoff.
    Close(f64),
    /// As `Close`, but only the sum of all values: how it is parted is the device's choice.
    Sum(f64),
}
use Rule::{Close, Exact, Sum};

/// An element of a buffer, as numbers.
trait Element: Pod {
    fn numbers(values: &[Self]) -> Vec<f64>;
}

macro_rules! elements {
    ($number:ty: $($element:ty),+) => {$(
        impl Element for $element {
            fn numbers(values: &[Self]) -> Vec<f64> {
                bytemuck::cast_slice(values).iter().map(|&x: &$number| f64::from(x)).collect()
            }
        }
    )+};
}
elements!(u32: u32, UVec2, [u32; 3], RankSearch);
elements!(f32: f32, Vec2, Vec3, ProjectedSplat, StepLoss, ToneStatistics, ToneParameters);

/// Runs a kernel and its reference on copies of the same host data, compares the outputs, times the kernel, and
/// gives the device's outputs as a tuple. Inputs and outputs are variables named as the kernel's buffers.
macro_rules! check {
    ($bench:ident, $timings:ident, $kernel:ident, $constants:expr, $params:expr, $threads:expr,
     [$($input:ident),*], [$($output:ident: $rule:expr),+]) => {{
        let (constants, params, threads) = ($constants, $params, $threads);
        let expected = {
            $(let mut $output = $output.clone();)+
            let slices = $kernel::Slices { $($input: &$input,)* $($output: &mut $output,)+ };
            <$kernel::Kernel as Reference>::run(&params, &constants, slices);
            [$(Element::numbers(&$output)),+]
        };
        let pipeline = $bench.gpu.pipeline::<$kernel::Kernel>(&constants)?;
        $(let $input = $bench.gpu.buffer(stringify!($input), &$input)?;)*
        $(let mut $output = $bench.gpu.buffer(stringify!($output), &$output)?;)+
        macro_rules! dispatch {
            () => {
                $bench.gpu.profile(stringify!($kernel), |pass| {
                    let buffers =
                        $kernel::Buffers { $($input: &$input,)* $($output: &mut $output,)+ };
                    pass.dispatch(&pipeline, &params, buffers, threads)
                })
            };
        }
        dispatch!()?;
        let outputs = ($($bench.gpu.read(&$output)?,)+);
        let actual = {
            let ($($output,)+) = &outputs;
            [$(Element::numbers($output)),+]
        };
        for (i, rule) in [$($rule),+].into_iter().enumerate() {
            let name = [$(stringify!($output)),+][i];
            agree(stringify!($kernel), name, rule, &actual[i], &expected[i])?;
        }
        let milliseconds = $bench.median(|| Ok(total(&dispatch!()?)))?;
        push($timings, stringify!($kernel), milliseconds);
        outputs
    }};
}

/// A kernel that is used more than once is listed once.
fn push(timings: &mut Vec<Timing>, name: &'static str, milliseconds: f64) {
    if timings.iter().all(|timing| timing.name != name) {
        timings.push(Timing { name, milliseconds, bound: None });
    }
}

/// # Errors
/// The values disagree, in one line with the worst.
fn agree(
    kernel: &str,
    buffer: &str,
    rule: Rule,
    actual: &[f64],
    expected: &[f64],
) -> anyhow::Result<()> {
    let (tolerance, allowed) = match rule {
        Exact => (0.0, 0),
        Close(tolerance) => (tolerance, expected.len() / 1000),
        Sum(tolerance) => {
            let sum = |values: &[f64]| [values.iter().sum::<f64>()];
            return agree(kernel, buffer, Close(tolerance), &sum(actual), &sum(expected));
        }
    };
    let mean = expected.iter().map(|e| e.abs()).sum::<f64>() / expected.len().max(1) as f64;
    // Positive phrasing: a NaN disagrees.
    let is_close = |&(a, e): &(&f64, &f64)| (a - e).abs() <= tolerance * (e.abs() + mean);
    let wrong: Vec<_> = actual.iter().zip(expected).filter(|pair| !is_close(pair)).collect();
    if wrong.len() <= allowed && actual.len() == expected.len() {
        return Ok(());
    }
    let (a, e) = wrong.first().copied().unwrap_or((&0.0, &0.0));
    anyhow::bail!(
        "{kernel} disagrees with its CPU reference: {} of {} values of `{buffer}`, the first is {a} instead of {e}; \
         update the driver or report this with the output of `nightsplat doctor`",
        wrong.len(),
        expected.len()
    )
}

/// Every kernel, in the order of a training step.
///
/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn check_and_time(bench: &Bench, scene: &Scene) -> anyhow::Result<Vec<Timing>> {
    let mut timings = vec![];
    let tone = statistics(bench, &mut timings)?;
    let frame = project_and_bin(bench, &mut timings, scene)?;
    blend_and_back(bench, &mut timings, scene, &frame, tone)?;
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
    let sums = vec![Vec2::ZERO; THREADS as usize];
    let (searches, histograms) = (vec![RankSearch::default(); 4], vec![0_u32; 4096]);
    let (luminances, sums, searches, histograms) = check!(
        bench,
        timings,
        luminance,
        luminance::Constants::default(),
        luminance::Params {
            ranks: [p10, p10 + 1, p90, p90 + 1],
            pixel_count,
            thread_count: THREADS
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
        percentile_select::Params { digit_bits: 11 },
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
            luminance_histogram::Params { pixel_count, thread_count: THREADS, shift },
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
            percentile_select::Params { digit_bits: 10 },
            Threads::Workgroups([1, 1, 1]),
            [],
            [searches: Exact, histograms: Exact]
        );
    }
    let weight = |tenths: u32| (last % 10 * tenths % 10) as f32 / 10.0;
    let tone_curve = ToneCurve::Ap3.constant();
    let (statistics, parameters) =
        (vec![ToneStatistics::default()], vec![ToneParameters::default()]);
    let (_, parameters) = check!(
        bench,
        timings,
        tone_statistics,
        tone_statistics::Constants { tone_curve },
        tone_statistics::Params {
            view: 0,
            pixel_count,
            thread_count: THREADS,
            weights: Vec2::new(weight(1), weight(9)),
            gain_c: settings.gain_c as f32,
            theta: settings.theta as f32,
            alpha: settings.alpha as f32,
            beta: settings.beta as f32,
            base_gain: settings.base_gain as f32,
        },
        Threads::Workgroups([1, 1, 1]),
        [searches, sums],
        [statistics: Close(1e-5), parameters: Close(1e-5)]
    );
    let target = vec![0.0_f32; image.len()];
    check!(
        bench,
        timings,
        tone_map,
        tone_map::Constants { tone_curve },
        tone_map::Params { value_count: image.len() as u32, view: 0 },
        Threads::Exactly([image.len() as u32, 1, 1]),
        [image, parameters],
        [target: Close(1e-5)]
    );
    Ok(parameters[0])
}

/// What the passes before the blending leave.
struct Frame {
    camera: project::Params,
    tile_columns: u32,
    tile_count: u32,
    splats: Vec<ProjectedSplat>,
    colors: Vec<f32>,
    tile_counts: Vec<u32>,
    sorted_ids: Vec<u32>,
    ordered_counts: Vec<u32>,
    offsets: Vec<u32>,
    counts: Vec<u32>,
    sorted_slots: Vec<u32>,
    owners: Vec<u32>,
    tile_ranges: Vec<UVec2>,
}

/// The constants that the kernels of the rasteriser share.
macro_rules! constants {
    ($kernel:ident $(, $field:ident: $value:expr)*) => {{
        let RenderSettings { max_alpha: alpha_max, tile: [tile_width, tile_height], .. } =
            RenderSettings::default();
        $kernel::Constants { alpha_max, channels: 3, tile_width, tile_height, $($field: $value,)* }
    }};
}

fn project_and_bin(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
) -> anyhow::Result<Frame> {
    let RenderSettings { near, tile: [tile_width, tile_height], .. } = RenderSettings::default();
    let Scene { camera, gaussians, .. } = scene;
    let (size, n) = (UVec2::new(camera.width, camera.height), gaussians.count);
    let gaussian_count = n as u32;
    let per_gaussian = Threads::Exactly([gaussian_count, 1, 1]);
    let (tile_columns, tile_rows) = (size.x.div_ceil(tile_width), size.y.div_ceil(tile_height));
    let tile_count = tile_columns * tile_rows;
    let parameters = &gaussians.parameters;
    let (splats, colors) = (vec![ProjectedSplat::default(); n], vec![0.0_f32; 3 * n]);
    let [depth_keys, ids, tile_counts] = [0; 3].map(|_| vec![0_u32; n]);
    let camera = project::Params {
        view_from_world: kernel_transform(scene),
        focal: camera.focal.as_vec2(),
        principal_point: camera.principal_point.as_vec2(),
        size,
        near,
        gaussian_count,
        sh_degree: gaussians.sh_degree,
    };
    let (splats, colors, depth_keys, _, tile_counts) = check!(
        bench,
        timings,
        project,
        constants!(project, sh_degree: gaussians.sh_degree),
        camera,
        per_gaussian,
        [parameters],
        [
            splats: Close(1e-4), colors: Close(1e-4), depth_keys: Close(1e-5), ids: Exact,
            tile_counts: Close(0.0)
        ]
    );
    let sorted_ids = stably_sorted(&depth_keys);
    let ordered_counts = vec![0_u32; n];
    let (ordered_counts,) = check!(
        bench,
        timings,
        order_counts,
        order_counts::Constants::default(),
        order_counts::Params { gaussian_count },
        per_gaussian,
        [sorted_ids, tile_counts],
        [ordered_counts: Exact]
    );
    let (offsets, total) = scan(bench, timings, &ordered_counts)?;
    let capacity = total[0];
    let (counts, status) = (vec![0_u32], vec![0_u32; 2]);
    let (counts, _) = check!(
        bench,
        timings,
        check_capacity,
        check_capacity::Constants::default(),
        check_capacity::Params { gaussian_count, capacity },
        Threads::Exactly([1, 1, 1]),
        [total],
        [counts: Exact, status: Exact]
    );
    let [tiles, slots, owners] = [0; 3].map(|_| vec![0_u32; capacity as usize]);
    let (tiles, _, owners) = check!(
        bench,
        timings,
        emit,
        constants!(emit),
        emit::Params { size, gaussian_count, tile_columns },
        per_gaussian,
        [counts, sorted_ids, ordered_counts, offsets, splats],
        [tiles: Close(0.0), slots: Exact, owners: Exact]
    );
    sort(bench, timings, &tiles)?;
    let sorted_slots = stably_sorted(&tiles);
    let sorted_tiles: Vec<u32> = sorted_slots.iter().map(|&slot| tiles[slot as usize]).collect();
    let tile_ranges = vec![UVec2::ZERO; tile_count as usize];
    let (tile_ranges,) = check!(
        bench,
        timings,
        tile_ranges,
        tile_ranges::Constants::default(),
        tile_ranges::Params { tile_count },
        Threads::Exactly([capacity, 1, 1]),
        [counts, sorted_tiles],
        [tile_ranges: Exact]
    );
    Ok(Frame {
        camera,
        tile_columns,
        tile_count,
        splats,
        colors,
        tile_counts,
        sorted_ids,
        ordered_counts,
        offsets,
        counts,
        sorted_slots,
        owners,
        tile_ranges,
    })
}

/// The columns of the rotation, then the translation.
fn kernel_transform(scene: &Scene) -> [[f32; 3]; 4] {
    let pose = &scene.camera.view_from_world;
    let rotation = pose.matrix3;
    [rotation.x_axis, rotation.y_axis, rotation.z_axis, pose.translation]
        .map(|column| column.as_vec3().to_array())
}

/// The indices in the order of their keys, equal ones as they were.
fn stably_sorted(keys: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..keys.len() as u32).collect();
    order.sort_by_key(|&i| keys[i as usize]);
    order
}

fn scan(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    values: &[u32],
) -> anyhow::Result<(Vec<u32>, Vec<u32>)> {
    let constants = scan_upsweep::Constants::default();
    let partition_size = constants.partition_size;
    let capacity = values.len() as u32;
    let counts = vec![capacity];
    let partitions = capacity.div_ceil(partition_size);
    let sums = vec![0_u32; partitions as usize];
    let (sums,) = check!(
        bench,
        timings,
        scan_upsweep,
        constants,
        scan_upsweep::Params { count_index: 0, capacity },
        Threads::Workgroups([partitions, 1, 1]),
        [counts, values],
        [sums: Exact]
    );
    let total = vec![0_u32];
    let (sums, total) = check!(
        bench,
        timings,
        scan_spine,
        scan_spine::Constants { partition_size },
        scan_spine::Params { count_index: 0, capacity },
        Threads::Workgroups([1, 1, 1]),
        [counts],
        [sums: Exact, total: Exact]
    );
    let offsets = vec![0_u32; values.len()];
    let (offsets,) = check!(
        bench,
        timings,
        scan_downsweep,
        scan_downsweep::Constants { partition_size },
        scan_downsweep::Params { count_index: 0, capacity },
        Threads::Workgroups([partitions, 1, 1]),
        [counts, values, sums],
        [offsets: Exact]
    );
    Ok((offsets, total))
}

/// One digit of the sort of the intersections by tile.
fn sort(bench: &Bench, timings: &mut Vec<Timing>, keys: &[u32]) -> anyhow::Result<()> {
    const DIGIT_BITS: u32 = 5;
    let constants = sort_upsweep::Constants::default();
    let partition_size = constants.partition_size;
    let (capacity, count_index, shift, digit_bits) = (keys.len() as u32, 0, 0, DIGIT_BITS);
    let counts = vec![capacity];
    let partitions = capacity.div_ceil(partition_size);
    let per_partition = Threads::Workgroups([partitions, 1, 1]);
    let arguments = vec![[0_u32; 3]];
    check!(
        bench,
        timings,
        dispatch_arguments,
        dispatch_arguments::Constants::default(),
        dispatch_arguments::Params { items_per_workgroup: partition_size, count_index, capacity },
        Threads::Workgroups([1, 1, 1]),
        [counts],
        [arguments: Exact]
    );
    let table = vec![0_u32; (partitions << DIGIT_BITS) as usize];
    let (table,) = check!(
        bench,
        timings,
        sort_upsweep,
        constants,
        sort_upsweep::Params { count_index, capacity, shift, digit_bits },
        per_partition,
        [counts, keys],
        [table: Exact]
    );
    let digit_totals = vec![0_u32; 1 << DIGIT_BITS];
    let (table, digit_totals) = check!(
        bench,
        timings,
        sort_spine,
        sort_spine::Constants { partition_size },
        sort_spine::Params { count_index, capacity },
        Threads::Workgroups([1 << DIGIT_BITS, 1, 1]),
        [counts],
        [table: Exact, digit_totals: Exact]
    );
    let values: Vec<u32> = (0..capacity).collect();
    let [sorted_keys, sorted_values] = [0; 2].map(|_| vec![0_u32; keys.len()]);
    let rank_by_ballot = bench.gpu.properties().subgroup_size > 8;
    check!(
        bench,
        timings,
        sort_downsweep,
        sort_downsweep::Constants { partition_size, rank_by_ballot },
        sort_downsweep::Params { count_index, capacity, shift, digit_bits },
        per_partition,
        [counts, table, digit_totals, keys, values],
        [sorted_keys: Exact, sorted_values: Exact]
    );
    Ok(())
}

/// The render, its loss, and the way back to the parameters.
fn blend_and_back(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    frame: &Frame,
    tone: ToneParameters,
) -> anyhow::Result<()> {
    let Frame { tile_columns, tile_count, splats, colors, sorted_slots, owners, .. } = frame;
    let Frame { tile_ranges, counts, sorted_ids, ordered_counts, offsets, .. } = frame;
    let Frame { tile_counts, camera, .. } = frame;
    let (tile_columns, size) = (*tile_columns, camera.size);
    let pixels = (size.x * size.y) as usize;
    let per_tile = Threads::Workgroups([*tile_count, 1, 1]);
    let (render, transmittances) = (vec![0.0_f32; 3 * pixels], vec![0.0_f32; pixels]);
    let (render, _) = check!(
        bench,
        timings,
        blend_forward,
        constants!(blend_forward),
        blend_forward::Params { size, tile_columns, background: [0.0; 11] },
        per_tile,
        [tile_ranges, sorted_slots, owners, splats, colors],
        [render: Close(1e-3), transmittances: Close(1e-3)]
    );
    let d_render = loss(bench, timings, scene, &render, tone)?;
    let records = vec![0.0_f32; 9 * owners.len()];
    let (records,) = check!(
        bench,
        timings,
        blend_backward,
        constants!(blend_backward),
        blend_backward::Params { size, tile_columns },
        per_tile,
        [tile_ranges, sorted_slots, owners, splats, colors, render, d_render],
        [records: Close(1e-2)]
    );
    let gaussian_count = camera.gaussian_count;
    let per_gaussian = Threads::Exactly([gaussian_count, 1, 1]);
    let d_splats = vec![0.0_f32; 9 * scene.gaussians.count];
    let (d_splats,) = check!(
        bench,
        timings,
        reduce_records,
        constants!(reduce_records),
        reduce_records::Params { gaussian_count },
        per_gaussian,
        [counts, sorted_ids, ordered_counts, offsets, records],
        [d_splats: Close(1e-4)]
    );
    let parameters = &scene.gaussians.parameters;
    let status = vec![0_u32; 2];
    let gradients = vec![0.0_f32; parameters.len()];
    let grad_norm_sums = vec![0.0_f32; scene.gaussians.count];
    let visit_counts = vec![0_u32; scene.gaussians.count];
    let (gradients, ..) = check!(
        bench,
        timings,
        project_backward,
        constants!(project_backward, sh_degree: scene.gaussians.sh_degree),
        project_backward::Params {
            view_from_world: camera.view_from_world,
            focal: camera.focal,
            principal_point: camera.principal_point,
            size,
            gaussian_count,
            sh_degree: camera.sh_degree,
            damping_weight: 1.0,
            damping_depth: 4.0,
        },
        per_gaussian,
        [parameters, splats, colors, tile_counts, d_splats, status],
        [gradients: Close(1e-2), grad_norm_sums: Close(1e-3), visit_counts: Exact]
    );
    adam_step(bench, timings, scene, &gradients)
}

/// Both terms, as one kernel pair and as L1 alone; gives the gradient of the render.
fn loss(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    render: &[f32],
    tone: ToneParameters,
) -> anyhow::Result<Vec<f32>> {
    let (low, tone) = (&scene.low.data, vec![tone]);
    let (width, height) = (scene.low.width, scene.low.height);
    let tone_curve = ToneCurve::Ap3.constant();
    let lanes = bench.gpu.properties().subgroup_size;
    let mean_scale = 1.0 / render.len() as f32;
    let [columns, rows] = strip(&bench.gpu);
    let strips = 3 * width.div_ceil(columns) * height.div_ceil(rows);
    let workgroups = strips.div_ceil(lanes);
    let threads = Threads::Workgroups([workgroups, 1, 1]);
    let d_moments = vec![Vec3::ZERO; render.len()];
    let partials = vec![0.0_f32; workgroups as usize];
    let (d_moments, ssim_partials) = check!(
        bench,
        timings,
        ssim_forward,
        ssim_forward::Constants { columns, rows, tone_curve },
        ssim_forward::Params { width, height },
        threads,
        [render, low, tone],
        [d_moments: Close(1e-2), partials: Sum(1e-3)]
    );
    let d_render = vec![0.0_f32; render.len()];
    let (d_render, l1_partials) = check!(
        bench,
        timings,
        ssim_backward,
        ssim_backward::Constants { columns, rows, tone_curve },
        ssim_backward::Params {
            width,
            height,
            l1_scale: 0.8 * mean_scale,
            ssim_scale: 0.2 * mean_scale
        },
        threads,
        [render, low, tone, d_moments],
        [d_render: Close(1e-2), partials: Sum(1e-4)]
    );
    let (log, status) = (vec![StepLoss::default()], vec![0_u32]);
    check!(
        bench,
        timings,
        loss_log,
        loss_log::Constants::default(),
        loss_log::Params {
            slot: 0,
            l1_partial_count: workgroups,
            ssim_partial_count: workgroups,
            mean_scale,
            not_finite_flag: 2,
        },
        Threads::Workgroups([1, 1, 1]),
        [l1_partials, ssim_partials],
        [log: Close(1e-5), status: Exact]
    );
    let constants = l1::Constants { tone_curve, ..Default::default() };
    let value_count = render.len() as u32;
    let workgroups = value_count.div_ceil(lanes * constants.values_per_thread);
    let partials = vec![0.0_f32; workgroups as usize];
    let ssim_gradient = d_render.clone();
    check!(
        bench,
        timings,
        l1,
        constants,
        l1::Params { value_count, l1_scale: mean_scale },
        Threads::Workgroups([workgroups, 1, 1]),
        [render, low, tone],
        [d_render: Close(1e-5), partials: Sum(1e-4)]
    );
    Ok(ssim_gradient)
}

fn adam_step(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    gradients: &[f32],
) -> anyhow::Result<()> {
    let parameters = scene.gaussians.parameters.clone();
    let gaussian_count = scene.gaussians.count as u32;
    let column_count = parameters.len() as u32 / gaussian_count;
    let rates = Schedule::default().initial_rates;
    let (stream, scale) = (Stream::new(65, 4), 1e-6);
    let first_moments: Vec<f32> =
        (0..parameters.len() as u64).map(|i| scale * stream.normal(i) as f32).collect();
    let second_moments: Vec<f32> = first_moments.iter().map(|m| m * m + scale * scale).collect();
    let status = vec![0_u32; 2];
    let constants = adam::Constants::default();
    let per_workgroup = adam::Kernel::WORKGROUP_SIZE[0] * constants.floats_per_thread;
    check!(
        bench,
        timings,
        adam,
        constants,
        adam::Params {
            gaussian_count,
            column_count,
            second_correction: 1.0,
            means_rate: rates.means as f32,
            quats_rate: rates.quats as f32,
            log_scales_rate: rates.log_scales as f32,
            raw_opacities_rate: rates.raw_opacities as f32,
            dc_rate: rates.dc as f32,
            rest_rate: rates.rest as f32,
        },
        Threads::Workgroups([gaussian_count.div_ceil(per_workgroup), column_count, 1]),
        [gradients, status],
        [parameters: Close(1e-4), first_moments: Close(1e-4), second_moments: Close(1e-4)]
    );
    Ok(())
}
