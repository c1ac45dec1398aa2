//! The loss terms: of an image, of structure, of depth, of a denoised image.

use glam::{UVec2, Vec2, Vec3};

use crate::cli::bench::check::Rule::{Close, Exact, Sum};
use crate::cli::bench::check::check;
use crate::cli::bench::scene::Scene;
use crate::cli::bench::{Bench, Timing};
use crate::gpu::Threads;
use crate::kernels::*;
use crate::loss::{DepthBoxes, DepthSettings, Term, strip};
use crate::tone::ToneCurve;

/// L1 and SSIM, as one kernel pair and as L1 alone; gives the gradient of the render.
///
/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn image(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    render: &[f32],
    tone: ToneParameters,
) -> anyhow::Result<Vec<f32>> {
    let (low, tone) = (&scene.low.data, vec![tone]);
    let (width, height) = (scene.low.width, scene.low.height);
    let (interior_begin, interior_end) = (UVec2::ZERO, UVec2::new(width, height));
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
        ssim_forward::Params { width, height, interior_begin, interior_end },
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
            interior_begin,
            interior_end,
            l1_scale: 0.8 * mean_scale,
            ssim_scale: 0.2 * mean_scale
        },
        threads,
        [render, low, tone, d_moments],
        [d_render: Close(1e-2), partials: Sum(1e-4)]
    );
    let (first_partials, second_partials) = (l1_partials, ssim_partials);
    let (log, statuses, status) = (vec![0.0_f32; Term::all().count()], vec![0_u32], vec![0_u32]);
    check!(
        bench,
        timings,
        loss_log,
        loss_log::Constants::default(),
        loss_log::Params {
            slot: 0,
            term_count: Term::all().count() as u32,
            terms: UVec2::new(Term::L1.index() as u32, Term::SSIM.index() as u32),
            partial_counts: UVec2::splat(workgroups),
            mean_scales: Vec2::splat(mean_scale),
        },
        Threads::Workgroups([1, 1, 1]),
        [first_partials, second_partials],
        [log: Close(1e-5), statuses: Exact, status: Exact]
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
        l1::Params {
            value_count,
            l1_scale: mean_scale,
            width,
            height,
            interior_begin,
            interior_end,
        },
        Threads::Workgroups([workgroups, 1, 1]),
        [render, low, tone],
        [d_render: Close(1e-5), partials: Sum(1e-4)]
    );
    Ok(ssim_gradient)
}

/// The terms that a model with more than colours has; the render's planes stand in for structure and depth.
///
/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn others(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    render: &[f32],
) -> anyhow::Result<()> {
    let size = UVec2::new(scene.low.width, scene.low.height);
    structure(bench, timings, size, &scene.low.data, render)?;
    depth(bench, timings, size, &scene.low.data, render)?;
    denoise(bench, timings, size, render, &scene.low.data)
}

fn structure(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    UVec2 { x: width, y: height }: UVec2,
    image: &[f32],
    render: &[f32],
) -> anyhow::Result<()> {
    let (pixel_count, lanes) = (width * height, bench.gpu.properties().subgroup_size);
    let per_pixel = Threads::Exactly([pixel_count, 1, 1]);
    let [smooth_rows, slope_rows] = [0; 2].map(|_| vec![Vec3::ZERO; pixel_count as usize]);
    let (smooth_rows, slope_rows) = check!(
        bench,
        timings,
        ciconv_rows,
        ciconv_rows::Constants::default(),
        ciconv_rows::Params { width, height },
        per_pixel,
        [image],
        [smooth_rows: Close(1e-5), slope_rows: Close(1e-5)]
    );
    let logs = vec![0.0_f32; pixel_count as usize];
    let moments = vec![Vec2::ZERO; pixel_count.div_ceil(lanes) as usize];
    let (logs, moments) = check!(
        bench,
        timings,
        ciconv_columns,
        ciconv_columns::Constants::default(),
        ciconv_columns::Params { width, height, pixels_per_moment: lanes },
        per_pixel,
        [smooth_rows, slope_rows],
        [logs: Close(1e-3), moments: Close(1e-2)]
    );
    let norm = vec![Vec2::ZERO];
    let (norm,) = check!(
        bench,
        timings,
        ciconv_moments,
        ciconv_moments::Constants::default(),
        ciconv_moments::Params { pixel_count, pixels_per_moment: lanes },
        Threads::Workgroups([1, 1, 1]),
        [moments],
        [norm: Close(1e-5)]
    );
    let structure = vec![0.0_f32; pixel_count as usize];
    let (structure,) = check!(
        bench,
        timings,
        ciconv_normalize,
        ciconv_normalize::Constants::default(),
        ciconv_normalize::Params { pixel_count },
        per_pixel,
        [logs, norm],
        [structure: Close(1e-5)]
    );
    let constants = structure_l1::Constants::default();
    let workgroups = pixel_count.div_ceil(lanes * constants.values_per_thread);
    let partials = vec![0.0_f32; workgroups as usize];
    let d_render = vec![0.0_f32; render.len()];
    check!(
        bench,
        timings,
        structure_l1,
        constants,
        structure_l1::Params { pixel_count, first: pixel_count, scale: 1.0 / pixel_count as f32 },
        Threads::Workgroups([workgroups, 1, 1]),
        [render, structure],
        [d_render: Close(1e-5), partials: Sum(1e-4)]
    );
    Ok(())
}

fn depth(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    size: UVec2,
    depth: &[f32],
    render: &[f32],
) -> anyhow::Result<()> {
    let (width, pixel_count) = (size.x, size.element_product());
    let boxes = DepthBoxes::new(size, DepthSettings::default().box_side);
    let region_count = boxes.count + 1;
    let regions = vec![[0_u32; 4]; region_count as usize];
    let (regions,) = check!(
        bench,
        timings,
        depth_boxes,
        depth_boxes::Constants::default(),
        depth_boxes::Params { size, side: boxes.side, box_count: boxes.count, key: 65 },
        Threads::Exactly([region_count, 1, 1]),
        [],
        [regions: Exact]
    );
    let constants = depth_moments::Constants::default();
    let chunk_size = bench.gpu.properties().subgroup_size * constants.values_per_thread;
    let view_chunks = pixel_count.div_ceil(chunk_size);
    let box_chunks = (boxes.side * boxes.side).div_ceil(chunk_size);
    let chunk_count = view_chunks + boxes.count * box_chunks;
    let moments = vec![DepthMoments::default(); chunk_count as usize];
    let (moments,) = check!(
        bench,
        timings,
        depth_moments,
        constants,
        depth_moments::Params { width, first: 0, view_chunks, box_chunks, chunk_count, chunk_size },
        Threads::Workgroups([chunk_count, 1, 1]),
        [render, depth, regions],
        [moments: Close(1e-3)]
    );
    let gradients = vec![DepthGradient::default(); region_count as usize];
    let (view_values, box_values) = (vec![0.0_f32], vec![0.0_f32; boxes.count as usize]);
    let (gradients, _, _) = check!(
        bench,
        timings,
        depth_correlation,
        depth_correlation::Constants::default(),
        depth_correlation::Params {
            width,
            first: 0,
            view_chunks,
            box_chunks,
            chunk_size,
            view_weight: 0.1,
            box_weight: 0.1 / boxes.count.max(1) as f32,
        },
        Threads::Workgroups([region_count, 1, 1]),
        [render, depth, regions, moments],
        [gradients: Close(1e-3), view_values: Close(1e-4), box_values: Close(1e-4)]
    );
    let d_render = vec![0.0_f32; render.len()];
    check!(
        bench,
        timings,
        depth_gradient,
        depth_gradient::Constants::default(),
        depth_gradient::Params { size, first: 0, region_count },
        Threads::Exactly([pixel_count, 1, 1]),
        [render, depth, regions, gradients],
        [d_render: Close(1e-3)]
    );
    Ok(())
}

fn denoise(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    size: UVec2,
    denoised: &[f32],
    render: &[f32],
) -> anyhow::Result<()> {
    let UVec2 { x: width, y: height } = size;
    let constants = denoising::Constants::default();
    let threads = 3 * width * height.div_ceil(constants.rows);
    let workgroups = threads.div_ceil(bench.gpu.properties().subgroup_size);
    let [d_denoised, d_render] = [0; 2].map(|_| vec![0.0_f32; render.len()]);
    let [mse_partials, tv_partials] = [0; 2].map(|_| vec![0.0_f32; workgroups as usize]);
    check!(
        bench,
        timings,
        denoising,
        constants,
        denoising::Params {
            width,
            height,
            interior_begin: UVec2::ZERO,
            interior_end: size,
            mse_weight: 1.0,
            tv_weight: 1.0,
            mean_scale: 1.0 / render.len() as f32,
            x_scale: 2.0 / (3 * (width - 1) * height) as f32,
            y_scale: 2.0 / (3 * width * (height - 1)) as f32,
        },
        Threads::Workgroups([workgroups, 1, 1]),
        [denoised, render],
        [
            d_denoised: Close(1e-4), d_render: Close(1e-5), mse_partials: Sum(1e-4),
            tv_partials: Sum(1e-4)
        ]
    );
    Ok(())
}
