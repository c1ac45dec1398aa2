//! The networks: a repeat of the denoiser forward and backward, the ends of a stage, and the tonemapper's product.

use glam::{UVec2, Vec2};

use crate::cli::bench::check::Rule::Close;
use crate::cli::bench::check::check;
use crate::cli::bench::{Bench, Timing};
use crate::gpu::{CooperativeMatrix, Threads};
use crate::kernels::*;
use crate::nn::conv_shape;
use crate::random::Stream;

/// So small that the references keep up.
const SIZE: UVec2 = UVec2::new(125, 94);
const CHANNELS: u32 = 16;

/// Values in [-1, 1); another image for every `stream`.
fn image(channels: u32, stream: u64) -> Vec<f32> {
    let stream = Stream::new(65, 100 + stream);
    let count = u64::from(channels * SIZE.element_product());
    (0..count).map(|i| 2.0 * stream.uniform(i) as f32 - 1.0).collect()
}

/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn repeat_and_ends(bench: &Bench, timings: &mut Vec<Timing>) -> anyhow::Result<()> {
    // The inner convolution, then gamma and beta.
    let norm_offset = CHANNELS * (9 * CHANNELS + 1);
    let mut values = image(CHANNELS, 0);
    values.truncate((norm_offset + 2 * CHANNELS) as usize);
    let features = image(CHANNELS, 1);
    let convolved = convolve(bench, timings, &values, &features)?;
    let d_convolved = norm(bench, timings, &values, norm_offset, &features, &convolved)?;
    weights(bench, timings, &features, &d_convolved)?;
    ends(bench, timings)
}

fn convolve(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    values: &[f32],
    source: &[f32],
) -> anyhow::Result<Vec<f32>> {
    let [columns, rows] = conv_shape(&bench.gpu);
    let constants = conv3x3::Constants { columns, rows, ..Default::default() };
    let (values, source) = (values.to_vec(), source.to_vec());
    let target = vec![0.0_f32; source.len()];
    if let Some(CooperativeMatrix { m, n, k }) = bench.gpu.properties().cooperative_matrix {
        let constants = conv3x3_half::Constants { m, n, k, ..Default::default() };
        let conv3x3_half::Constants { blocks, rows, .. } = constants;
        let (in_channels, out_channels) = (CHANNELS, CHANNELS);
        check!(
            bench,
            timings,
            conv3x3_half,
            constants,
            conv3x3_half::Params { size: SIZE, in_channels, out_channels, offset: 0 },
            Threads::Workgroups([
                CHANNELS.div_ceil(blocks * m),
                SIZE.x.div_ceil(n),
                SIZE.y.div_ceil(rows)
            ]),
            [values, source],
            [target: Close(1e-2)]
        );
    }
    let across = columns * bench.gpu.properties().subgroup_size;
    let (convolved,) = check!(
        bench,
        timings,
        conv3x3,
        constants,
        conv3x3::Params { size: SIZE, in_channels: CHANNELS, out_channels: CHANNELS, offset: 0 },
        Threads::Workgroups([
            CHANNELS.div_ceil(constants.out_block),
            SIZE.x.div_ceil(across),
            SIZE.y.div_ceil(rows)
        ]),
        [values, source],
        [target: Close(1e-5)]
    );
    Ok(convolved)
}

/// Norm, activation and shortcut, and back; gives the gradient of what was convolved.
fn norm(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    values: &[f32],
    offset: u32,
    shortcut: &[f32],
    source: &[f32],
) -> anyhow::Result<Vec<f32>> {
    let (pixel_count, channel_count, slot) = (SIZE.element_product(), CHANNELS, 0);
    let (values, shortcut, source) = (values.to_vec(), shortcut.to_vec(), source.to_vec());
    let chunk = norm_statistics::Constants::default().chunk;
    let chunks = pixel_count.div_ceil(chunk);
    let per_chunk = Threads::Workgroups([chunks, CHANNELS, 1]);
    let per_channel = Threads::Workgroups([1, CHANNELS, 1]);
    macro_rules! check_norm {
        ($kernel:ident, $threads:expr, $inputs:tt, $outputs:tt) => {
            check!(
                bench,
                timings,
                $kernel,
                $kernel::Constants { chunk },
                $kernel::Params { pixel_count, channel_count, offset, slot },
                $threads,
                $inputs,
                $outputs
            )
        };
    }
    let partials = vec![Vec2::ZERO; (chunks * CHANNELS) as usize];
    let statistics = vec![ChannelStatistics::default(); CHANNELS as usize];
    let [target, d_source] = [(); 2].map(|()| vec![0.0_f32; source.len()]);
    let (partials,) = check_norm!(norm_statistics, per_chunk, [source], [partials: Close(1e-4)]);
    let (statistics,) = check_norm!(norm_merge, per_channel, [partials], [statistics: Close(1e-5)]);
    let (d_target,) = check_norm!(
        norm_forward,
        per_chunk,
        [values, statistics, source, shortcut],
        [target: Close(1e-5)]
    );
    let (partials,) = check_norm!(
        norm_backward_sums,
        per_chunk,
        [values, statistics, source, d_target],
        [partials: Close(1e-4)]
    );
    let (sums, gradients) = (vec![Vec2::ZERO; CHANNELS as usize], vec![0.0_f32; values.len()]);
    let (sums, _) = check_norm!(
        norm_backward_merge,
        per_channel,
        [partials],
        [sums: Close(1e-5), gradients: Close(1e-5)]
    );
    let (d_source,) = check_norm!(
        norm_backward,
        per_chunk,
        [values, statistics, sums, source, d_target],
        [d_source: Close(1e-4)]
    );
    Ok(d_source)
}

fn weights(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    source: &[f32],
    d_target: &[f32],
) -> anyhow::Result<()> {
    let constants = conv3x3_weight_gradient::Constants::default();
    let (source, d_target) = (source.to_vec(), d_target.to_vec());
    let parameter_count = CHANNELS * (9 * CHANNELS + 1);
    let strip_count = SIZE.y.div_ceil(constants.rows);
    let partials = vec![0.0_f32; (strip_count * parameter_count) as usize];
    let (partials,) = check!(
        bench,
        timings,
        conv3x3_weight_gradient,
        constants,
        conv3x3_weight_gradient::Params {
            size: SIZE,
            in_channels: CHANNELS,
            out_channels: CHANNELS
        },
        Threads::Workgroups([CHANNELS, CHANNELS.div_ceil(constants.out_block), strip_count]),
        [source, d_target],
        [partials: Close(1e-4)]
    );
    let gradients = vec![0.0_f32; parameter_count as usize];
    check!(
        bench,
        timings,
        reduce_strips,
        reduce_strips::Constants::default(),
        reduce_strips::Params { parameter_count, strip_count, offset: 0 },
        Threads::Exactly([parameter_count, 1, 1]),
        [partials],
        [gradients: Close(1e-4)]
    );
    Ok(())
}

/// What happens to each value on its own.
fn ends(bench: &Bench, timings: &mut Vec<Timing>) -> anyhow::Result<()> {
    let value_count = 3 * SIZE.element_product();
    let threads = Threads::Exactly([value_count, 1, 1]);
    let of = |stream| image(3, stream);
    let (activations, gradient) = (of(2), of(3));
    check!(
        bench,
        timings,
        relu_backward,
        relu_backward::Constants::default(),
        relu_backward::Params { value_count },
        threads,
        [activations],
        [gradient: Close(0.0)]
    );
    let (render, stage_input, update, d_denoised) = (of(4), of(5), of(6), of(7));
    let denoised = vec![0.0_f32; value_count as usize];
    let (denoised,) = check!(
        bench,
        timings,
        residual,
        residual::Constants::default(),
        residual::Params { value_count },
        threads,
        [render, stage_input, update],
        [denoised: Close(1e-6)]
    );
    let [d_update, d_stage_input] = [(); 2].map(|()| vec![0.0_f32; value_count as usize]);
    let d_render = of(8);
    check!(
        bench,
        timings,
        residual_backward,
        residual_backward::Constants::default(),
        residual_backward::Params { value_count },
        threads,
        [render, stage_input, update, d_denoised],
        [d_update: Close(1e-6), d_stage_input: Close(1e-6), d_render: Close(1e-6)]
    );
    let illumination = of(9);
    let target = vec![0.0_f32; value_count as usize];
    let (d_target,) = check!(
        bench,
        timings,
        product,
        product::Constants::default(),
        product::Params { value_count },
        threads,
        [illumination, denoised],
        [target: Close(1e-6)]
    );
    let (d_illumination, d_denoised) = (vec![0.0_f32; value_count as usize], of(10));
    check!(
        bench,
        timings,
        product_backward,
        product_backward::Constants::default(),
        product_backward::Params { value_count },
        threads,
        [illumination, denoised, d_target],
        [d_illumination: Close(1e-6), d_denoised: Close(1e-6)]
    );
    Ok(())
}
