//! Every kernel against its reference, at sizes and channel counts that divide no block size.

use nightsplat::kernels::*;

use crate::common::prelude::*;

pub(crate) const SIZES: [[u32; 2]; 5] = [[1, 1], [3, 1], [5, 7], [8, 8], [33, 17]];

pub(crate) fn values(random: &mut Random, count: u32, low: f64, high: f64) -> Vec<f32> {
    (0..count).map(|_| random.between(low, high) as f32).collect()
}

fn check_conv(constants: conv3x3::Constants, [in_channels, out_channels]: [u32; 2]) {
    let mut random = Random::new(1);
    for size in SIZES.map(UVec2::from_array) {
        let (pixels, offset) = (size.element_product(), 5);
        let mut image = |count| values(&mut random, count, -1.0, 1.0);
        let values = image(offset + 9 * in_channels * out_channels + out_channels);
        let [source, target] = [in_channels, out_channels].map(|of| image(of * pixels));
        let params = conv3x3::Params { size, in_channels, out_channels, offset };
        let across = size.x.div_ceil(constants.columns * gpu().properties().subgroup_size);
        let blocks = out_channels.div_ceil(constants.out_block * constants.subgroups);
        let threads = Threads::Workgroups([blocks, across, size.y.div_ceil(constants.rows)]);
        run_kernel!(conv3x3, constants, params, threads, [values, source], [target]);
    }
}

#[test]
fn conv3x3_matches_its_reference_forward() {
    let base = conv3x3::Constants { columns: 4, rows: 4, ..Default::default() };
    check_conv(conv3x3::Constants { activation: 1, ..base }, [3, 8]);
    check_conv(conv3x3::Constants { subgroups: 2, ..base }, [8, 17]);
    check_conv(conv3x3::Constants { out_block: 3, activation: 2, ..base }, [17, 3]);
    check_conv(conv3x3::Constants { columns: 1, rows: 8, activation: 1, ..base }, [16, 16]);
}

#[test]
fn conv3x3_matches_its_reference_backward() {
    let base = conv3x3::Constants { columns: 4, rows: 4, transposed: true, ..Default::default() };
    check_conv(base, [3, 16]);
    check_conv(conv3x3::Constants { accumulate: true, ..base }, [8, 8]);
    check_conv(conv3x3::Constants { out_block: 3, accumulate: true, ..base }, [17, 3]);
    check_conv(conv3x3::Constants { columns: 1, rows: 8, subgroups: 3, ..base }, [16, 17]);
}

#[test]
fn conv3x3_weight_gradient_and_reduce_strips_match_their_references() {
    let mut random = Random::new(2);
    for (rows, out_block, subgroups, in_channels, out_channels) in
        [(16, 8, 1, 3, 8), (4, 8, 8, 8, 17), (16, 3, 4, 16, 3), (5, 8, 3, 17, 16)]
    {
        for size in SIZES.map(UVec2::from_array) {
            let pixels = size.element_product();
            let mut image = |count| values(&mut random, count, -1.0, 1.0);
            let [source, d_target] = [in_channels, out_channels].map(|of| image(of * pixels));
            let (strip_count, parameter_count) =
                (size.y.div_ceil(rows), out_channels * (9 * in_channels + 1));
            let partials = vec![f32::NAN; (strip_count * parameter_count) as usize];
            let gradients = image(parameter_count + 9);
            let partials = run_kernel!(
                conv3x3_weight_gradient,
                conv3x3_weight_gradient::Constants { rows, out_block, subgroups },
                conv3x3_weight_gradient::Params { size, in_channels, out_channels },
                Threads::Workgroups([
                    in_channels.div_ceil(subgroups),
                    out_channels.div_ceil(out_block),
                    strip_count
                ]),
                [source, d_target],
                [partials]
            );
            run_kernel!(
                reduce_strips,
                reduce_strips::Constants::default(),
                reduce_strips::Params { parameter_count, strip_count, offset: 7 },
                Threads::Exactly([parameter_count, 1, 1]),
                [partials],
                [gradients]
            );
        }
    }
}

/// Runs the six norm kernels in order, each on the device's results of the previous one.
fn check_norm(size: [u32; 2], channel_count: u32, chunk: u32, mean: f64, deviation: f64) {
    let pixel_count = size[0] * size[1];
    let (offset, slot) = (3, 2 * channel_count);
    let chunks = pixel_count.div_ceil(chunk);
    let mut random = Random::new(3);
    let mut image = |low, high| values(&mut random, channel_count * pixel_count, low, high);
    let source = image(mean - deviation, mean + deviation);
    let (shortcut, d_target) = (image(-1.0, 1.0), image(-1.0, 1.0));
    let values = values(&mut random, offset + 2 * channel_count, -1.0, 1.5);
    let per_chunk = Threads::Workgroups([chunks, channel_count, 1]);
    let per_channel = Threads::Workgroups([1, channel_count, 1]);
    macro_rules! check {
        ($kernel:ident, $threads:expr, [$($input:ident),*], [$($output:ident),+]) => {{
            // The inputs are shadowed by their buffers inside.
            $(let $input = $input.clone();)*
            let params = $kernel::Params { pixel_count, channel_count, offset, slot };
            let constants = $kernel::Constants { chunk };
            run_kernel!($kernel, constants, params, $threads, [$($input),*], [$($output),+])
        }};
    }
    let unwritten = || vec![Vec2::NAN; (channel_count * chunks) as usize];
    let partials = unwritten();
    let partials = check!(norm_statistics, per_chunk, [source], [partials]);
    let statistics = vec![ChannelStatistics::default(); (slot + channel_count) as usize];
    let statistics = check!(norm_merge, per_channel, [partials], [statistics]);
    let target = vec![f32::NAN; source.len()];
    check!(norm_forward, per_chunk, [values, statistics, source, shortcut], [target]);
    let partials = unwritten();
    let partials =
        check!(norm_backward_sums, per_chunk, [values, statistics, source, d_target], [partials]);
    let (sums, gradients) = (vec![Vec2::NAN; channel_count as usize], vec![0.5_f32; values.len()]);
    let (sums, _) = check!(norm_backward_merge, per_channel, [partials], [sums, gradients]);
    let d_source = vec![f32::NAN; source.len()];
    check!(norm_backward, per_chunk, [values, statistics, sums, source, d_target], [d_source]);
}

#[test]
fn the_norm_kernels_match_their_references() {
    for size in SIZES {
        check_norm(size, 3, 1024, 0.3, 2.0);
        check_norm(size, 17, 64, -0.2, 0.7);
    }
    check_norm([83, 61], 8, 1024, 0.0, 1.0);
}

/// The mean of the squares minus the square of the mean would lose all digits here.
#[test]
fn a_small_deviation_is_exact_despite_a_large_mean() {
    check_norm([83, 61], 3, 1024, 1000.0, 0.1);
}

#[test]
fn the_kernels_without_neighbours_match_their_references() {
    let mut random = Random::new(4);
    for value_count in [0_u32, 1, 255, 256, 257, 1683] {
        let threads = Threads::Exactly([value_count, 1, 1]);
        let unwritten = || vec![f32::NAN; value_count as usize];
        let mut image = |low: f64| values(&mut random, value_count, low, 1.0);
        macro_rules! check {
            ($kernel:ident, [$($input:ident),*], [$($output:ident),+]) => {{
                $(let $input = $input.clone();)*
                let params = $kernel::Params { value_count };
                run_kernel!($kernel, Default::default(), params, threads, [$($input),*], [$($output),+])
            }};
        }
        let (gradient, activations): (_, Vec<f32>) =
            (image(-1.0), image(-1.0).iter().map(|x| x.max(0.0)).collect());
        check!(relu_backward, [activations], [gradient]);

        // On both sides of both bounds, and on the bounds.
        let (mut render, mut stage_input, mut update) = (image(-1.0), image(-1.0), image(0.0));
        for (i, bound) in [0.0, 1.0].into_iter().enumerate().take(value_count as usize) {
            (render[i], stage_input[i], update[i]) = (bound + 0.75, 0.5, 0.25);
        }
        let denoised = unwritten();
        check!(residual, [render, stage_input, update], [denoised]);
        let (d_denoised, d_render) = (image(-1.0), image(-1.0));
        let [d_update, d_stage_input] = [(); 2].map(|()| unwritten());
        let (_, d_stage_input, _) = check!(
            residual_backward,
            [render, stage_input, update, d_denoised],
            [d_update, d_stage_input, d_render]
        );
        let passed = d_stage_input.iter().zip(&d_denoised).take(2).all(|(d, passes)| *d == -passes);
        assert!(passed, "at the bounds the clamp lets the gradient pass");

        let (illumination, denoised, target) = (image(-1.0), image(-1.0), unwritten());
        check!(product, [illumination, denoised], [target]);
        let (d_target, d_illumination, d_denoised) = (image(-1.0), unwritten(), image(-1.0));
        check!(product_backward, [illumination, denoised, d_target], [d_illumination, d_denoised]);
    }
}
