//! The render, its loss, the way back to the parameters, and their update.

use super::bin::Frame;
use super::{constants, losses};
use crate::cli::bench::check::Rule::{Close, Exact};
use crate::cli::bench::check::check;
use crate::cli::bench::scene::Scene;
use crate::cli::bench::{Bench, Timing};
use crate::gpu::{Kernel as _, Threads};
use crate::kernels::*;
use crate::optimizer::Schedule;
use crate::random::Stream;

/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn blend_and_back(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    frame: &Frame,
    tone: ToneParameters,
) -> anyhow::Result<()> {
    let Frame { tile_columns, tile_count, splats, colors, sorted_slots, owners, .. } = frame;
    let Frame { tile_ranges, counts, sorted_ids, ordered_counts, offsets, .. } = frame;
    let Frame { tile_counts, camera, .. } = frame;
    let (tile_columns, size) = (*tile_columns, camera.camera.size);
    let pixels = (size.x * size.y) as usize;
    let per_tile = Threads::Workgroups([*tile_count, 1, 1]);
    let (render, transmittances) = (vec![0.0_f32; 3 * pixels], vec![0.0_f32; pixels]);
    let (render, _) = check!(
        bench,
        timings,
        blend_forward,
        constants!(bench, blend_forward),
        blend_forward::Params { size, tile_columns, background: [0.0; 11] },
        per_tile,
        [tile_ranges, sorted_slots, owners, splats, colors],
        [render: Close(1e-3), transmittances: Close(1e-3)]
    );
    let d_render = losses::image(bench, timings, scene, &render, tone)?;
    losses::others(bench, timings, scene, &render)?;
    let records = vec![0.0_f32; 9 * owners.len()];
    let (records,) = check!(
        bench,
        timings,
        blend_backward,
        constants!(bench, blend_backward),
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
        constants!(bench, reduce_records),
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
    let (gradients, grad_norm_sums, visit_counts) = check!(
        bench,
        timings,
        project_backward,
        constants!(bench, project_backward, sh_degree: scene.gaussians.shape.sh_degree, raw_colors: false),
        project_backward::Params {
            camera: camera.camera,
            gaussian_count,
            sh_degree: camera.sh_degree,
            damping_weight: 1.0,
            damping_depth: 4.0,
        },
        per_gaussian,
        [parameters, splats, colors, tile_counts, d_splats, status],
        [gradients: Close(1e-2), grad_norm_sums: Close(1e-3), visit_counts: Exact]
    );
    let moments = adam_step(bench, timings, scene, &gradients)?;
    densify(bench, timings, scene, &moments, &grad_norm_sums, &visit_counts)
}

/// Updates the parameters; gives the moments.
fn adam_step(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    gradients: &[f32],
) -> anyhow::Result<[Vec<f32>; 2]> {
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
    let (_, first_moments, second_moments) = check!(
        bench,
        timings,
        adam,
        constants,
        adam::Params {
            gaussian_count,
            column_count,
            second_correction: 1.0,
            feature_count: 0,
            rates: rates.0.map(|rate| rate as f32),
        },
        Threads::Workgroups([gaussian_count.div_ceil(per_workgroup), column_count, 1]),
        [gradients, status],
        [parameters: Close(1e-4), first_moments: Close(1e-4), second_moments: Close(1e-4)]
    );
    Ok([first_moments, second_moments])
}

/// Density control: every fate occurs.
fn densify(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
    [first_moments, second_moments]: &[Vec<f32>; 2],
    grad_norm_sums: &[f32],
    visit_counts: &[u32],
) -> anyhow::Result<()> {
    let (n, parameters) = (scene.gaussians.count, &scene.gaussians.parameters);
    let (gaussian_count, column_count) = (n as u32, (parameters.len() / n) as u32);
    let per_gaussian = Threads::Exactly([gaussian_count, 1, 1]);
    let mean_gradients = vec![0.0_f32; n];
    let [fates, offspring_counts] = [0; 2].map(|_| vec![0_u32; n]);
    let (_, fates, offspring_counts) = check!(
        bench,
        timings,
        densify_count,
        densify_count::Constants::default(),
        densify_count::Params {
            gaussian_count,
            column_count,
            feature_count: 0,
            gradient_threshold: grad_norm_sums.iter().sum::<f32>() / n as f32,
            split_log_scale: -4.5,
            min_raw_opacity: -3.0,
        },
        per_gaussian,
        [parameters, grad_norm_sums, visit_counts],
        [mean_gradients: Close(1e-6), fates: Close(0.0), offspring_counts: Close(0.0)]
    );
    let mut new_gaussian_count = 0;
    let place = |count: &u32| {
        new_gaussian_count += count;
        new_gaussian_count - count
    };
    let offsets: Vec<u32> = offspring_counts.iter().map(place).collect();
    let new_len = (new_gaussian_count * column_count) as usize;
    let [new_parameters, new_first_moments, new_second_moments] =
        [0; 3].map(|_| vec![0.0_f32; new_len]);
    check!(
        bench,
        timings,
        densify_scatter,
        densify_scatter::Constants::default(),
        densify_scatter::Params {
            gaussian_count,
            new_gaussian_count,
            column_count,
            feature_count: 0,
            seed: 65,
            step: 1
        },
        per_gaussian,
        [parameters, first_moments, second_moments, fates, offsets],
        [
            new_parameters: Close(1e-4), new_first_moments: Close(0.0),
            new_second_moments: Close(0.0)
        ]
    );
    Ok(())
}
