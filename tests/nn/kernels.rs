//! Every kernel against its reference, at sizes and channel counts that divide nothing.

use glam::{UVec2, Vec2};
use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{CooperativeMatrix, Threads};
use nightsplat::kernels::*;

use super::common::{Random, assert_close};
use super::{UNIT, largest};

const SIZES: [[u32; 2]; 5] = [[1, 1], [3, 1], [5, 7], [8, 8], [33, 17]];

fn values(random: &mut Random, count: usize, low: f64, high: f64) -> Vec<f32> {
    (0..count).map(|_| random.between(low, high) as f32).collect()
}

fn magnitudes(values: &[f32]) -> Vec<f32> {
    values.iter().map(|x| x.abs()).collect()
}

/// A dot product of n terms rounds by at most n units of the sum of its terms' magnitudes, in whatever order.
fn dot_product_bound(terms: u32, magnitude: f32) -> f32 {
    (terms + 2) as f32 * UNIT * magnitude
}

fn check_conv(constants: conv3x3::Constants, [in_channels, out_channels]: [u32; 2]) {
    let mut random = Random::new(1);
    for size in SIZES.map(UVec2::from_array) {
        let pixels = size.element_product();
        let offset = 5;
        let len = offset + 9 * in_channels * out_channels + out_channels;
        let values_of = |count: u32, random: &mut Random| values(random, count as usize, -1.0, 1.0);
        let values = values_of(len, &mut random);
        let source = values_of(in_channels * pixels, &mut random);
        let target = values_of(out_channels * pixels, &mut random);
        let params = conv3x3::Params { size, in_channels, out_channels, offset };
        let expected = run_reference!(conv3x3, constants, params, [values, source], [target]);
        let plain = conv3x3::Constants { activation: 0, ..constants };
        let sum_of_magnitudes = {
            let (values, source) = (magnitudes(&values), magnitudes(&source));
            let target = magnitudes(&target);
            run_reference!(conv3x3, plain, params, [values, source], [target])
        };
        let lanes = gpu().properties().subgroup_size;
        let across = size.x.div_ceil(constants.columns * lanes);
        let blocks = out_channels.div_ceil(constants.out_block);
        let threads = Threads::Workgroups([blocks, across, size.y.div_ceil(constants.rows)]);
        let actual = run_kernel!(conv3x3, constants, params, threads, [values, source], [target]);
        // ReLU and sigmoid make no error larger; the sigmoid's exponential adds a few units of its own.
        let own = if constants.activation == 2 { 1e-6 } else { 0.0 };
        let bound =
            |i: usize, _| dot_product_bound(9 * in_channels + 1, sum_of_magnitudes[i]) + own;
        let what = format!("{size} {in_channels} to {out_channels} {constants:?}");
        assert_close(&what, &actual, &expected, bound);
    }
}

#[test]
fn conv3x3_matches_its_reference_forward() {
    let base = conv3x3::Constants { columns: 4, rows: 4, ..Default::default() };
    check_conv(conv3x3::Constants { activation: 1, ..base }, [3, 8]);
    check_conv(base, [8, 17]);
    check_conv(conv3x3::Constants { out_block: 3, activation: 2, ..base }, [17, 3]);
    check_conv(conv3x3::Constants { columns: 1, rows: 8, activation: 1, ..base }, [16, 16]);
}

#[test]
fn conv3x3_matches_its_reference_backward() {
    let base = conv3x3::Constants { columns: 4, rows: 4, transposed: true, ..Default::default() };
    check_conv(base, [3, 16]);
    check_conv(conv3x3::Constants { accumulate: true, ..base }, [8, 8]);
    check_conv(conv3x3::Constants { out_block: 3, accumulate: true, ..base }, [17, 3]);
    check_conv(conv3x3::Constants { columns: 1, rows: 8, ..base }, [16, 17]);
}

/// Both factors of a product round by 2^-10 at most, and weights below 2^-22 may vanish; the sum rounds as a plain one.
fn half_bound(terms: u32, magnitude: f32, largest_pixel: f32) -> f32 {
    dot_product_bound(terms, magnitude)
        + magnitude / 512.0
        + terms as f32 * largest_pixel / 4_194_304.0
}

fn check_half(matrix: CooperativeMatrix, transposed: bool, in_out: [u32; 2], magnitude: f32) {
    let mut random = Random::new(1);
    let [in_channels, out_channels] = in_out;
    let accumulate = transposed;
    for size in SIZES.map(UVec2::from_array) {
        let CooperativeMatrix { m, n, k } = matrix;
        let constants =
            conv3x3_half::Constants { m, n, k, blocks: 2, rows: 3, transposed, accumulate };
        let pixels = size.element_product();
        let len = (5 + 9 * in_channels * out_channels + out_channels) as usize;
        let values_in = values(&mut random, len, -0.2, 0.2);
        let values_of = |count: u32, random: &mut Random| -> Vec<f32> {
            values(random, count as usize, -1.0, 1.0).iter().map(|x| x * magnitude).collect()
        };
        let source = values_of(in_channels * pixels, &mut random);
        let target = values_of(out_channels * pixels, &mut random);
        let params = conv3x3_half::Params { size, in_channels, out_channels, offset: 5 };
        let values = values_in;
        let expected = run_reference!(conv3x3_half, constants, params, [values, source], [target]);
        let sum_of_magnitudes = {
            let (values, source) = (magnitudes(&values), magnitudes(&source));
            let target = magnitudes(&target);
            run_reference!(conv3x3_half, constants, params, [values, source], [target])
        };
        let blocks = out_channels.div_ceil(2 * m);
        let threads = Threads::Workgroups([blocks, size.x.div_ceil(n), size.y.div_ceil(3)]);
        let actual =
            run_kernel!(conv3x3_half, constants, params, threads, [values, source], [target]);
        let (terms, largest) = (9 * in_channels + 1, largest(&source));
        let bound = |i: usize, _| half_bound(terms, sum_of_magnitudes[i], largest);
        let what = format!("{size} {in_out:?} times {magnitude:e} {constants:?}");
        assert_close(&what, &actual, &expected, bound);
    }
}

/// Runs where the device has cooperative matrices.
#[test]
fn conv3x3_half_matches_its_reference_at_every_magnitude() {
    let Some(matrix) = gpu().properties().cooperative_matrix else {
        let device = gpu();
        let name = &device.properties().name;
        return super::common::not_run(format_args!("{name} has no cooperative matrices"));
    };
    for magnitude in [1.0, 1e-9, 1e-30, 1e6] {
        check_half(matrix, false, [8, 17], magnitude);
        check_half(matrix, true, [17, 8], magnitude);
    }
    check_half(matrix, false, [64, 64], 1.0);
    check_half(matrix, true, [3, 1], 1.0);
}

#[test]
fn conv3x3_weight_gradient_and_reduce_strips_match_their_references() {
    let mut random = Random::new(2);
    for (rows, out_block, in_channels, out_channels) in
        [(16, 8, 3, 8), (4, 8, 8, 17), (16, 3, 16, 3), (5, 8, 17, 16)]
    {
        for size in SIZES.map(UVec2::from_array) {
            let pixels = size.element_product();
            let constants = conv3x3_weight_gradient::Constants { rows, out_block };
            let params = conv3x3_weight_gradient::Params { size, in_channels, out_channels };
            let source = values(&mut random, (in_channels * pixels) as usize, -1.0, 1.0);
            let d_target = values(&mut random, (out_channels * pixels) as usize, -1.0, 1.0);
            let (strip_count, parameter_count) =
                (size.y.div_ceil(rows), out_channels * (9 * in_channels + 1));
            let partials = vec![f32::NAN; (strip_count * parameter_count) as usize];
            let expected = run_reference!(
                conv3x3_weight_gradient,
                constants,
                params,
                [source, d_target],
                [partials]
            );
            let sum_of_magnitudes = {
                let (source, d_target) = (magnitudes(&source), magnitudes(&d_target));
                run_reference!(
                    conv3x3_weight_gradient,
                    constants,
                    params,
                    [source, d_target],
                    [partials]
                )
            };
            let blocks = out_channels.div_ceil(out_block);
            let partials = run_kernel!(
                conv3x3_weight_gradient,
                constants,
                params,
                Threads::Workgroups([in_channels, blocks, strip_count]),
                [source, d_target],
                [partials]
            );
            let terms = rows * size.x;
            let bound = |i: usize, _| dot_product_bound(terms, sum_of_magnitudes[i]);
            let what = format!("{size} {in_channels} to {out_channels} {constants:?}");
            assert_close(&what, &partials, &expected, bound);

            let params = reduce_strips::Params { parameter_count, strip_count, offset: 7 };
            let constants = reduce_strips::Constants::default();
            let gradients = values(&mut random, parameter_count as usize + 9, -1.0, 1.0);
            let expected =
                run_reference!(reduce_strips, constants, params, [partials], [gradients]);
            let threads = Threads::Exactly([parameter_count, 1, 1]);
            let scale = largest(&partials).max(1.0);
            let gradients =
                run_kernel!(reduce_strips, constants, params, threads, [partials], [gradients]);
            let bound = |_, _| dot_product_bound(strip_count, scale * strip_count as f32);
            assert_close("reduce_strips", &gradients, &expected, bound);
        }
    }
}

/// Runs the six norm kernels one after another, each on what the device made of the one before.
fn check_norm(size: [u32; 2], channel_count: u32, chunk: u32, mean: f64, deviation: f64) {
    let pixel_count = size[0] * size[1];
    let (offset, slot) = (3, 2 * channel_count);
    let chunks = pixel_count.div_ceil(chunk);
    let len = (channel_count * pixel_count) as usize;
    let mut random = Random::new(3);
    let values_of = |low, high, random: &mut Random| values(random, len, low, high);
    let values = values(&mut random, (offset + 2 * channel_count) as usize, -1.0, 1.5);
    let source = values_of(mean - deviation, mean + deviation, &mut random);
    let shortcut = values_of(-1.0, 1.0, &mut random);
    let d_target = values_of(-1.0, 1.0, &mut random);
    let per_chunk = Threads::Workgroups([chunks, channel_count, 1]);
    let per_channel = Threads::Workgroups([1, channel_count, 1]);
    let what = format!("{size:?}, {channel_count} channels, chunks of {chunk}, mean {mean}");
    macro_rules! check {
        ($kernel:ident, $threads:expr, [$($input:ident),*], [$($output:ident),+]) => {{
            let params = $kernel::Params { pixel_count, channel_count, offset, slot };
            let constants = $kernel::Constants { chunk };
            let expected = run_reference!($kernel, constants, params, [$($input),*], [$($output),+]);
            let actual = {
                // The inputs are shadowed by their buffers inside.
                $(let $input = $input.clone();)*
                run_kernel!($kernel, constants, params, $threads, [$($input),*], [$($output),+])
            };
            (actual, expected)
        }};
    }
    let flat = |pairs: &[Vec2]| bytemuck::cast_slice(pairs).to_vec();
    // A lane adds up to chunk / lanes values, then lanes and chunks are added in a tree.
    let chain = (chunk / gpu().properties().subgroup_size + chunks + 8) as f32 * UNIT;

    let partials = vec![Vec2::NAN; (channel_count * chunks) as usize];
    let (partials, expected) = check!(norm_statistics, per_chunk, [source], [partials]);
    let (actual, expected): (Vec<f32>, Vec<f32>) = (flat(&partials), flat(&expected));
    // Means are corrected to the last bit; deviations are exact to the rounding of the mean that they are taken from.
    let mean_error = 2.0 * UNIT * largest(&source);
    assert_close(&what, &actual, &expected, |i, e| {
        let own = if i % 2 == 0 { mean_error } else { chunk as f32 * mean_error * mean_error };
        own + chain * e.abs() + f32::MIN_POSITIVE
    });

    let statistics = vec![ChannelStatistics::default(); (slot + channel_count) as usize];
    let (statistics, expected) = check!(norm_merge, per_channel, [partials], [statistics]);
    let flat_statistics = |s: &[ChannelStatistics]| bytemuck::cast_slice(s).to_vec();
    let (actual, expected): (Vec<f32>, Vec<f32>) =
        (flat_statistics(&statistics), flat_statistics(&expected));
    assert_close(&what, &actual, &expected, |_, e| 2.0 * chain * e.abs());

    let target = vec![f32::NAN; len];
    let (target, expected) =
        check!(norm_forward, per_chunk, [values, statistics, source, shortcut], [target]);
    // Three roundings of values of up to gamma times the largest deviation.
    let inverse = statistics.iter().fold(0.0, |m: f32, s| m.max(s.inverse_deviation));
    let normalised = 2.0 * deviation as f32 * inverse + 2.0;
    let step = 8.0 * UNIT * normalised;
    assert_close(&what, &target, &expected, |_, _| step);

    let partials = vec![Vec2::NAN; (channel_count * chunks) as usize];
    let (partials, expected) =
        check!(norm_backward_sums, per_chunk, [values, statistics, source, d_target], [partials]);
    let (actual, expected): (Vec<f32>, Vec<f32>) = (flat(&partials), flat(&expected));
    let in_chunk = chunk.min(pixel_count) as f32;
    let sum_error = (chain + 8.0 * UNIT) * in_chunk * normalised;
    assert_close(&what, &actual, &expected, |_, _| sum_error);

    let sums = vec![Vec2::NAN; channel_count as usize];
    let gradients = vec![0.5_f32; values.len()];
    let ((sums, gradients), (expected, expected_gradients)) =
        check!(norm_backward_merge, per_channel, [partials], [sums, gradients]);
    let (actual, expected): (Vec<f32>, Vec<f32>) = (flat(&sums), flat(&expected));
    let merge_error = chain * chunks as f32 * in_chunk * normalised;
    assert_close(&what, &actual, &expected, |_, _| merge_error);
    assert_close(&what, &gradients, &expected_gradients, |_, _| merge_error + UNIT);

    let d_source = vec![f32::NAN; len];
    let (d_source, expected) =
        check!(norm_backward, per_chunk, [values, statistics, sums, source, d_target], [d_source]);
    let bound = 32.0 * UNIT * inverse * normalised * normalised;
    assert_close(&what, &d_source, &expected, |_, _| bound);
}

#[test]
fn the_norm_kernels_match_their_references() {
    for size in SIZES {
        check_norm(size, 3, 1024, 0.3, 2.0);
        check_norm(size, 17, 64, -0.2, 0.7);
    }
    check_norm([83, 61], 8, 1024, 0.0, 1.0);
}

/// The mean of the squares minus the square of the mean would lose every digit here.
#[test]
fn a_large_mean_does_not_drown_a_small_deviation() {
    check_norm([83, 61], 3, 1024, 1000.0, 0.1);
}

#[test]
fn the_kernels_without_neighbours_match_their_references() {
    let mut random = Random::new(4);
    for value_count in [0_u32, 1, 255, 256, 257, 1683] {
        let n = value_count as usize;
        let threads = Threads::Exactly([value_count, 1, 1]);
        let mut image = |low: f64| values(&mut random, n, low, 1.0);

        let (activations, gradient) = (image(-1.0), image(-1.0));
        let activations: Vec<f32> = activations.iter().map(|x| x.max(0.0)).collect();
        let (constants, params) =
            (relu_backward::Constants::default(), relu_backward::Params { value_count });
        let expected = run_reference!(relu_backward, constants, params, [activations], [gradient]);
        let actual =
            run_kernel!(relu_backward, constants, params, threads, [activations], [gradient]);
        assert_eq!(actual, expected);

        // On both sides of both bounds, and on the bounds.
        let (mut render, mut stage_input, mut update) = (image(-1.0), image(-1.0), image(0.0));
        for (i, bound) in [0.0, 1.0].into_iter().enumerate().take(n) {
            (render[i], stage_input[i], update[i]) = (bound + 0.75, 0.5, 0.25);
        }
        let denoised = vec![f32::NAN; n];
        let (constants, params) =
            (residual::Constants::default(), residual::Params { value_count });
        let inputs = [&render, &stage_input, &update].map(Clone::clone);
        let expected =
            run_reference!(residual, constants, params, [render, stage_input, update], [denoised]);
        let actual = run_kernel!(
            residual,
            constants,
            params,
            threads,
            [render, stage_input, update],
            [denoised]
        );
        assert_eq!(actual, expected);

        let [render, stage_input, update] = inputs;
        let (d_denoised, d_render) = (image(-1.0), image(-1.0));
        let [d_update, d_stage_input] = [(); 2].map(|()| vec![f32::NAN; n]);
        let (constants, params) =
            (residual_backward::Constants::default(), residual_backward::Params { value_count });
        let expected = run_reference!(
            residual_backward,
            constants,
            params,
            [render, stage_input, update, d_denoised],
            [d_update, d_stage_input, d_render]
        );
        let passes = d_denoised.clone();
        let actual = run_kernel!(
            residual_backward,
            constants,
            params,
            threads,
            [render, stage_input, update, d_denoised],
            [d_update, d_stage_input, d_render]
        );
        // Products of at most four values below one.
        assert_close("d_update", &actual.0, &expected.0, |_, _| 4.0 * UNIT);
        assert_eq!(actual.1, expected.1);
        assert_close("d_render", &actual.2, &expected.2, |_, _| 2.0 * UNIT);
        let passed = actual.1.iter().zip(&passes).take(2).all(|(d, passes)| *d == -passes);
        assert!(passed, "at the bounds the clamp lets the gradient pass");

        let (illumination, denoised, target) = (image(-1.0), image(-1.0), vec![f32::NAN; n]);
        let (constants, params) = (product::Constants::default(), product::Params { value_count });
        let inputs = [&illumination, &denoised].map(Clone::clone);
        let expected =
            run_reference!(product, constants, params, [illumination, denoised], [target]);
        let actual =
            run_kernel!(product, constants, params, threads, [illumination, denoised], [target]);
        assert_eq!(actual, expected);

        let [illumination, denoised] = inputs;
        let (d_target, d_illumination, d_denoised) = (image(-1.0), vec![f32::NAN; n], image(-1.0));
        let (constants, params) =
            (product_backward::Constants::default(), product_backward::Params { value_count });
        let expected = run_reference!(
            product_backward,
            constants,
            params,
            [illumination, denoised, d_target],
            [d_illumination, d_denoised]
        );
        let actual = run_kernel!(
            product_backward,
            constants,
            params,
            threads,
            [illumination, denoised, d_target],
            [d_illumination, d_denoised]
        );
        assert_eq!(actual.0, expected.0);
        // A multiplication may be fused into the addition.
        assert_close("d_denoised", &actual.1, &expected.1, |_, _| 2.0 * UNIT);
    }
}
