//! The kernels of 16-bit matrices: packing and products, against their references and single precision.

use nightsplat::gpu::CooperativeMatrix;
use nightsplat::kernels::packed::{PACKED_CHANNELS, PACKED_COLUMNS, PACKED_ROWS};
use nightsplat::kernels::*;

use super::kernels::{SIZES, values};
use crate::common::not_run;
use crate::common::prelude::*;

/// The matrices of the device; without them the test does not run.
fn matrix() -> Option<CooperativeMatrix> {
    let gpu = gpu();
    let matrix = gpu.properties().cooperative_matrix;
    if matrix.is_none() {
        let name = &gpu.properties().name;
        not_run("cooperative-matrices", format_args!("{name} has none"));
    }
    matrix
}

/// The bits of the largest magnitude of this many values from `offset` on.
fn largest(values: &[f32], [offset, value_count]: [u32; 2]) -> Vec<u32> {
    let (chunk, values, largest) = (64, values.to_vec(), vec![0_u32]);
    run_kernel!(
        largest_magnitude,
        largest_magnitude::Constants { chunk },
        largest_magnitude::Params { offset, value_count },
        Threads::Workgroups([value_count.div_ceil(chunk), 1, 1]),
        [values],
        [largest]
    )
}

/// A value that no kernel writes.
const UNWRITTEN: [u32; 4] = [u32::MAX; 4];

/// A feature map as a factor, with the bits of its bound: its largest magnitude.
fn packed(size: UVec2, channels: u32, source: &[f32]) -> (Vec<u32>, Vec<[u32; 4]>) {
    let bits = largest(source, [0, channels * size.element_product()]);
    let columns = size.x.next_multiple_of(PACKED_COLUMNS) + 2;
    let rows = size.y.next_multiple_of(PACKED_ROWS) + 2;
    let blocks = columns * rows * channels.div_ceil(PACKED_CHANNELS);
    let (source, packed) = (source.to_vec(), vec![UNWRITTEN; 2 * blocks as usize]);
    let packed = {
        let bound = bits.clone();
        run_kernel!(
            pack_map,
            pack_map::Constants::default(),
            pack_map::Params { size, channels },
            Threads::Exactly([blocks, 1, 1]),
            [bound, source],
            [packed]
        )
    };
    (bits, packed)
}

/// The inverse of [`packed`].
fn unpacked(size: UVec2, channels: u32, bound: &[u32], packed: &[[u32; 4]]) -> Vec<f32> {
    let (bound, packed) = (bound.to_vec(), packed.to_vec());
    let target = vec![f32::NAN; (channels * size.element_product()) as usize];
    run_kernel!(
        unpack_map,
        unpack_map::Constants::default(),
        unpack_map::Params { size, channels },
        Threads::Exactly([size.element_product() * channels.div_ceil(PACKED_CHANNELS), 1, 1]),
        [bound, packed],
        [target]
    )
}

/// The weights of a layer at `offset` as a factor, with the bits of their bound.
fn packed_weights(
    transposed: bool,
    [in_channels, out_channels]: [u32; 2],
    offset: u32,
    values: &[f32],
) -> (Vec<u32>, Vec<[u32; 4]>) {
    let bits = largest(values, [offset, 9 * in_channels * out_channels]);
    let padded = [in_channels, out_channels].map(|count| count.next_multiple_of(PACKED_CHANNELS));
    let eights = 9 * padded[0] * padded[1] / 8;
    let (values, packed) = (values.to_vec(), vec![UNWRITTEN; eights as usize]);
    let packed = {
        let bound = bits.clone();
        run_kernel!(
            pack_weights,
            pack_weights::Constants { transposed },
            pack_weights::Params { in_channels, out_channels, offset },
            Threads::Exactly([eights, 1, 1]),
            [bound, values],
            [packed]
        )
    };
    (bits, packed)
}

#[test]
fn the_largest_magnitude_is_found_anywhere_and_a_nan_is_larger() {
    for value_count in [0_u32, 1, 63, 64, 65, 1000] {
        let mut values = values(&mut Random::new(1), value_count + 9, -1.0, 1.0);
        largest(&values, [5, value_count]);
        for (at, value) in [(0, -3.0), (value_count / 2, f32::INFINITY), (value_count, f32::NAN)] {
            // The first and the last are outside the range.
            values[4] = f32::MAX;
            values[5 + value_count as usize] = f32::MAX;
            values[5 + at as usize] = value;
            let found = largest(&values, [5, value_count]);
            if at < value_count {
                assert_eq!(found, [value.abs().to_bits()], "{at} of {value_count}");
            }
        }
    }
}

#[test]
fn a_map_is_packed_with_zeros_around_it_at_every_magnitude() {
    let mut random = Random::new(1);
    for size in SIZES.map(UVec2::from_array) {
        for channels in [1, 16, 17] {
            for most in [1.0, 1e-30, 1e30, 0.0] {
                let source = values(&mut random, channels * size.element_product(), -most, most);
                let (bound, packed) = packed(size, channels, &source);
                let unpacked = unpacked(size, channels, &bound, &packed);
                assert_close("there and back", &unpacked, &source, |_, x| {
                    x.abs() / 1024.0 + most as f32 * (-28f32).exp2()
                });
            }
        }
    }
    // Every power of two until they become 0: the largest is 1, the last 2^-45.
    let source: Vec<f32> = (0..46).map(|k| (-1.0f32).powi(k) * (-k as f32).exp2()).collect();
    packed(UVec2::new(46, 1), 1, &source);
}

#[test]
fn nan_and_infinity_are_kept_when_packed() {
    let source = [1.0, f32::NAN, f32::INFINITY, -f32::INFINITY];
    let (largest, packed) = packed(UVec2::new(4, 1), 1, &source[..]);
    assert!(f32::from_bits(largest[0]).is_nan());
    let halves = [1, 2, 3, 4].map(|column| {
        let pixel = (PACKED_COLUMNS as usize + 2) + column;
        packed[2 * pixel][0] & 0xffff
    });
    assert!(halves[1] & 0x7c00 == 0x7c00 && halves[1] & 0x3ff != 0, "{halves:x?}");
    assert_eq!(halves[2..], [0x7c00, 0xfc00]);
}

#[test]
fn weights_are_packed_for_both_directions() {
    let mut random = Random::new(1);
    for channels in [[1, 1], [8, 17], [17, 8], [16, 32]] {
        for (most, transposed) in [(0.2, false), (0.2, true), (1e4, false), (1e-20, true)] {
            let count = 5 + 9 * channels[0] * channels[1] + 3;
            let values = values(&mut random, count, -most, most);
            packed_weights(transposed, channels, 5, &values);
        }
    }
}

/// Compares the products of packed factors with those of the factors themselves: rounding the factors adds an error of
/// 2^-9 of the terms' magnitudes, and rounding the sum half of that of its own; values below 2^-28 of a bound may
/// become 0, and the bound of the sum is that of its terms times their number.
fn check_product(
    matrix: CooperativeMatrix,
    [subgroups, blocks]: [u32; 2],
    transposed: bool,
    in_out: [u32; 2],
    [weight, magnitude]: [f64; 2],
) {
    let mut random = Random::new(1);
    let ([in_channels, out_channels], CooperativeMatrix { m, n, k }) = (in_out, matrix);
    let (offset, weight_count) = (5, 9 * in_channels * out_channels);
    let constants = conv3x3_half::Constants { m, n, k, blocks, subgroups, accumulate: transposed };
    for size in SIZES.map(UVec2::from_array) {
        let pixels = size.element_product();
        let mut image = |count, most: f64| values(&mut random, count, -most, most);
        let mut values = image(offset + weight_count, weight);
        // No biases.
        values.resize(values.len() + out_channels as usize, 0.0);
        let [source, target] = in_out.map(|of| image(of * pixels, magnitude));
        let layer = if transposed { [out_channels, in_channels] } else { in_out };
        let (weight_bound, weights) = packed_weights(transposed, layer, offset, &values);
        let (source_bound, packed_source) = packed(size, in_channels, &source);
        let (shortcut_bound, shortcut) = packed(size, out_channels, &target);
        let threads = Threads::Workgroups([
            out_channels.next_multiple_of(PACKED_CHANNELS).div_ceil(blocks * m),
            size.x.div_ceil(n),
            size.y.div_ceil(subgroups * PACKED_ROWS),
        ]);
        let params = conv3x3_half::Params { size, in_channels, out_channels, largest_index: 1 };
        let (target_bound, packed_target) = {
            let (shortcut_largest, source) = (vec![0, shortcut_bound[0]], packed_source);
            let (target_bound, target) = (vec![0_u32], vec![UNWRITTEN; shortcut.len()]);
            run_kernel!(
                conv3x3_half,
                constants,
                params,
                threads,
                [
                    weight_bound,
                    source_bound,
                    shortcut_largest,
                    shortcut_bound,
                    weights,
                    source,
                    shortcut
                ],
                [target_bound, target]
            )
        };
        let actual = unpacked(size, out_channels, &target_bound, &packed_target);
        let single = |values: &[f32], source: &[f32], target: &[f32]| {
            let constants =
                conv3x3::Constants { transposed, accumulate: transposed, ..Default::default() };
            let params = conv3x3::Params { size, in_channels, out_channels, offset };
            let (values, source, target) = (values.to_vec(), source.to_vec(), target.to_vec());
            run_reference!(conv3x3, constants, params, [values, source], [target])
        };
        let abs = |values: &[f32]| values.iter().map(|value| value.abs()).collect::<Vec<_>>();
        let magnitudes = single(&abs(&values), &abs(&source), &abs(&target));
        let terms = (9 * in_channels) as f32;
        let vanished = terms * (-27f32).exp2() * (weight * magnitude) as f32
            + f32::from_bits(target_bound[0]) * (-28f32).exp2();
        let what = format!("{in_out:?} {size} {weight} {magnitude}");
        assert_close(&what, &actual, &single(&values, &source, &target), |i, expected| {
            1.01 / 512.0 * magnitudes[i] + expected.abs() / 1000.0 + vanished
        });
    }
}

/// Requires a device with cooperative matrices.
#[test]
fn conv3x3_half_matches_its_reference_and_single_precision_at_every_magnitude() {
    let Some(matrix) = matrix() else { return };
    for magnitudes in [[0.2, 1.0], [0.2, 1e-9], [0.2, 1e-30], [1e3, 1e6], [1e-6, 1e30]] {
        check_product(matrix, [4, 2], false, [8, 17], magnitudes);
        check_product(matrix, [2, 2], true, [17, 8], magnitudes);
    }
    check_product(matrix, [4, 4], false, [64, 72], [0.2, 1.0]);
    check_product(matrix, [1, 1], true, [3, 1], [0.2, 1.0]);
}

/// Requires a device with cooperative matrices.
#[test]
fn conv3x3_weight_gradient_half_matches_its_reference_at_every_magnitude() {
    let Some(CooperativeMatrix { m, n, k }) = matrix() else { return };
    let mut random = Random::new(2);
    for (rows, subgroups, in_channels, out_channels, magnitudes) in [
        (4, 1, 8, 17, [1.0, 1.0]),
        (3, 2, 17, 8, [1e6, 1e-9]),
        (4, 1, 3, 1, [1e-30, 1e30]),
        (1, 4, 24, 24, [1e-15, 1e-15]),
        (16, 4, 64, 40, [1e-3, 1e-3]),
    ] {
        for size in SIZES.map(UVec2::from_array) {
            let pixels = size.element_product();
            let mut image = |count, most: f64| values(&mut random, count * pixels, -most, most);
            let source = image(in_channels, magnitudes[0]);
            let d_target = image(out_channels, magnitudes[1]);
            let (source_bound, source) = packed(size, in_channels, &source);
            let (d_target_bound, d_target) = packed(size, out_channels, &d_target);
            let strips = size.y.div_ceil(rows);
            let tap_columns = if subgroups == 1 { 3 } else { 1 };
            let across = in_channels.next_multiple_of(PACKED_CHANNELS).div_ceil(n * subgroups);
            let partials = vec![f32::NAN; (strips * out_channels * 9 * in_channels) as usize];
            run_kernel!(
                conv3x3_weight_gradient_half,
                conv3x3_weight_gradient_half::Constants { m, n, k, rows, subgroups, tap_columns },
                conv3x3_weight_gradient_half::Params { size, in_channels, out_channels },
                Threads::Workgroups([across, out_channels.div_ceil(m), strips]),
                [source_bound, d_target_bound, source, d_target],
                [partials]
            );
        }
    }
}

fn check_norm(size: UVec2, channel_count: u32, chunk: u32, mean: f32, deviation: f32) {
    let (offset, slot, pixels) = (3, 2 * channel_count, size.element_product());
    let around =
        (size.x.next_multiple_of(PACKED_COLUMNS) + 2) * (size.y.next_multiple_of(PACKED_ROWS) + 2);
    let (channels, mut random) = (channel_count as usize, Random::new(3));
    let mut map = |low: f32, high: f32| {
        let source = values(&mut random, channel_count * pixels, low.into(), high.into());
        packed(size, channel_count, &source)
    };
    let (source_bound, source) = map(mean - deviation, mean + deviation);
    let (shortcut_bound, shortcut) = map(-1.0, 1.0);
    let (d_target_bound, d_target) = map(-1e-7, 1e-7);
    let values = values(&mut random, offset + 2 * channel_count, -1.0, 1.5);
    let inverse_deviation = 1.5 / deviation;
    let statistics = vec![ChannelStatistics { mean, inverse_deviation }; slot as usize + channels];
    let sums = vec![Vec2::new(-3e-8, 5e-8) * pixels as f32; channels];
    macro_rules! check {
        ($kernel:ident, $count:expr, [$($input:ident),*], [$($output:ident),+]) => {{
            $(let $input = $input.clone();)*
            let most_normalised = (pixels as f32).sqrt();
            let params = $kernel::Params { size, channel_count, offset, slot, most_normalised };
            let blocks = channel_count.div_ceil(PACKED_CHANNELS);
            let threads = Threads::Workgroups([u32::div_ceil($count, chunk), blocks, 1]);
            let constants = $kernel::Constants { chunk };
            run_kernel!($kernel, constants, params, threads, [$($input),*], [$($output),+])
        }};
    }
    let partials = vec![Vec2::NAN; channels * pixels.div_ceil(chunk) as usize];
    check!(norm_statistics_half, pixels, [source_bound, source], [partials]);
    let (target_bound, target) = (vec![0_u32], vec![UNWRITTEN; source.len()]);
    check!(
        norm_forward_half,
        around,
        [values, statistics, source_bound, source, shortcut_bound, shortcut],
        [target_bound, target]
    );
    let largest = vec![0_u32; 3];
    let (_, largest) = check!(
        norm_backward_sums_half,
        pixels,
        [values, statistics, source_bound, source, d_target_bound, d_target],
        [partials, largest]
    );
    let (d_source_bound, d_source) = (target_bound, target);
    check!(
        norm_backward_half,
        around,
        [values, statistics, source_bound, source, sums, largest, d_target_bound, d_target],
        [d_source_bound, d_source]
    );
}

#[test]
fn the_norm_kernels_match_their_references_on_packed_maps() {
    for size in SIZES.map(UVec2::from_array) {
        check_norm(size, 3, 128, 0.3, 2.0);
        check_norm(size, 17, 64, -0.2, 0.7);
    }
    check_norm(UVec2::new(83, 61), 40, 128, 0.0, 1e3);
}
