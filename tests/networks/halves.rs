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

/// A feature map as a factor, with the bits of its largest magnitude.
fn packed(size: UVec2, channels: u32, source: &[f32]) -> (Vec<u32>, Vec<[u32; 4]>) {
    let bits = largest(source, [0, channels * size.element_product()]);
    let columns = size.x.next_multiple_of(PACKED_COLUMNS) + 2;
    let rows = size.y.next_multiple_of(PACKED_ROWS) + 2;
    let blocks = columns * rows * channels.div_ceil(PACKED_CHANNELS);
    let (source, packed) = (source.to_vec(), vec![UNWRITTEN; 2 * blocks as usize]);
    let packed = {
        let largest = bits.clone();
        run_kernel!(
            pack_map,
            pack_map::Constants::default(),
            pack_map::Params { size, channels },
            Threads::Exactly([blocks, 1, 1]),
            [largest, source],
            [packed]
        )
    };
    (bits, packed)
}

/// The weights of a layer at `offset` as a factor, with the bits of their largest magnitude.
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
        let largest = bits.clone();
        run_kernel!(
            pack_weights,
            pack_weights::Constants { transposed },
            pack_weights::Params { in_channels, out_channels, offset },
            Threads::Exactly([eights, 1, 1]),
            [largest, values],
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
                packed(size, channels, &source);
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
/// 2^-9 of the terms' magnitudes, and values below 2^-28 of the largest may become 0.
fn check_product(
    matrix: CooperativeMatrix,
    transposed: bool,
    in_out: [u32; 2],
    [weight, magnitude]: [f64; 2],
) {
    let mut random = Random::new(1);
    let ([in_channels, out_channels], CooperativeMatrix { m, n, k }) = (in_out, matrix);
    let (offset, weight_count) = (5, 9 * in_channels * out_channels);
    let constants =
        conv3x3_half::Constants { m, n, k, blocks: 2, biased: !transposed, accumulate: transposed };
    for size in SIZES.map(UVec2::from_array) {
        let pixels = size.element_product();
        let mut image = |count, most: f64| values(&mut random, count, -most, most);
        let values = image(offset + weight_count + out_channels, weight);
        let [source, target] = in_out.map(|of| image(of * pixels, magnitude));
        let layer = if transposed { [out_channels, in_channels] } else { in_out };
        let (largest_weight, weights) = packed_weights(transposed, layer, offset, &values);
        let (largest_source, packed) = packed(size, in_channels, &source);
        let threads = Threads::Workgroups([
            out_channels.div_ceil(2 * m),
            size.x.div_ceil(n),
            size.y.div_ceil(PACKED_ROWS),
        ]);
        let biases = offset + weight_count;
        let params = conv3x3_half::Params { size, in_channels, out_channels, biases };
        let actual = {
            let (values, source, target) = (values.clone(), packed, target.clone());
            run_kernel!(
                conv3x3_half,
                constants,
                params,
                threads,
                [largest_weight, largest_source, values, weights, source],
                [target]
            )
        };
        let single = |values: &[f32], source: &[f32], target: &[f32]| {
            let constants =
                conv3x3::Constants { transposed, accumulate: transposed, ..Default::default() };
            let params = conv3x3::Params { size, in_channels, out_channels, offset };
            let (values, source, target) = (values.to_vec(), source.to_vec(), target.to_vec());
            run_reference!(conv3x3, constants, params, [values, source], [target])
        };
        let abs = |values: &[f32]| values.iter().map(|value| value.abs()).collect::<Vec<_>>();
        let magnitudes = single(&abs(&values), &abs(&source), &abs(&target));
        let vanished = (9 * in_channels) as f32 * (-27f32).exp2() * (weight * magnitude) as f32;
        let what = format!("{in_out:?} {size} {weight} {magnitude}");
        assert_close(&what, &actual, &single(&values, &source, &target), |i, _| {
            1.01 / 512.0 * magnitudes[i] + vanished
        });
    }
}

/// Requires a device with cooperative matrices.
#[test]
fn conv3x3_half_matches_its_reference_and_single_precision_at_every_magnitude() {
    let Some(matrix) = matrix() else { return };
    for magnitudes in [[0.2, 1.0], [0.2, 1e-9], [0.2, 1e-30], [1e3, 1e6], [1e-6, 1e30]] {
        check_product(matrix, false, [8, 17], magnitudes);
        check_product(matrix, true, [17, 8], magnitudes);
    }
    check_product(matrix, false, [64, 72], [0.2, 1.0]);
    check_product(matrix, true, [3, 1], [0.2, 1.0]);
}

/// Requires a device with cooperative matrices.
#[test]
fn conv3x3_weight_gradient_half_matches_its_reference_at_every_magnitude() {
    let Some(CooperativeMatrix { m, n, k }) = matrix() else { return };
    let mut random = Random::new(2);
    for (rows, in_channels, out_channels, magnitudes) in [
        (4, 8, 17, [1.0, 1.0]),
        (3, 17, 8, [1e6, 1e-9]),
        (4, 3, 1, [1e-30, 1e30]),
        (1, 24, 24, [1e-15, 1e-15]),
        (16, 64, 40, [1e-3, 1e-3]),
    ] {
        for size in SIZES.map(UVec2::from_array) {
            let pixels = size.element_product();
            let mut image = |count, most: f64| values(&mut random, count * pixels, -most, most);
            let source = image(in_channels, magnitudes[0]);
            let d_target_single = image(out_channels, magnitudes[1]);
            let (largest_source, source) = packed(size, in_channels, &source);
            let (largest_d_target, d_target) = packed(size, out_channels, &d_target_single);
            let strips = size.y.div_ceil(rows);
            let partials = vec![f32::NAN; (strips * out_channels * (9 * in_channels + 1)) as usize];
            run_kernel!(
                conv3x3_weight_gradient_half,
                conv3x3_weight_gradient_half::Constants { m, n, k, rows },
                conv3x3_weight_gradient_half::Params { size, in_channels, out_channels },
                Threads::Workgroups([in_channels.div_ceil(n), out_channels.div_ceil(m), strips]),
                [largest_source, largest_d_target, source, d_target, d_target_single],
                [partials]
            );
        }
    }
}
