//! Factors of 16-bit matrices as in `include/packed.glsl`, on the host.

use glam::UVec2;
use half::f16;

use crate::kernels::packed::{PACKED_CHANNELS, PACKED_COLUMNS, PACKED_ROWS};

/// A map's or a layer's halves, eight in sixteen bytes.
pub(super) type Eight = [u32; 4];

pub(super) fn channels(count: u32) -> u32 {
    count.next_multiple_of(PACKED_CHANNELS)
}

pub(super) fn extent(size: UVec2) -> UVec2 {
    let UVec2 { x, y } = size;
    UVec2::new(x.next_multiple_of(PACKED_COLUMNS), y.next_multiple_of(PACKED_ROWS)) + 2
}

fn exponent(largest: u32) -> i32 {
    (largest >> 23).clamp(23, 254) as i32 - 127
}

/// The scale of a factor whose largest magnitude has these bits.
pub(super) fn scale(largest: u32) -> f64 {
    f64::from(14 - exponent(largest)).exp2()
}

/// The bits of the half nearest to a single, including subnormal, infinite and NaN.
pub(super) fn nearest(value: f64) -> u32 {
    f16::from_f32(value as f32).to_bits().into()
}

/// The halves of eight numbers.
pub(super) fn eight(number: impl Fn(u32) -> f64) -> Eight {
    [0, 1, 2, 3].map(|word| nearest(number(2 * word)) | nearest(number(2 * word + 1)) << 16)
}

fn at(packed: &[Eight], index: u32) -> f64 {
    let half = packed[(index / 8) as usize][(index % 8 / 2) as usize] >> (16 * (index % 2));
    f16::from_bits(half as u16).to_f64()
}

/// The values of a packed map, as planes (C, H, W): halves, which single precision represents exactly.
pub(super) fn map(size: UVec2, count: u32, packed: &[Eight]) -> Vec<f32> {
    let (columns, padded) = (extent(size).x, channels(count));
    let pixel = |i: u32| (i / size.x + 1) * columns + i % size.x + 1;
    let plane =
        |c: u32| (0..size.element_product()).map(move |i| at(packed, pixel(i) * padded + c));
    (0..count).flat_map(plane).map(|value| value as f32).collect()
}

/// The values of a layer's packed weights, as (to, from, tap).
pub(super) fn weights([from, to]: [u32; 2], packed: &[Eight]) -> Vec<f32> {
    let [from_padded, to_padded] = [from, to].map(channels);
    let taps = |i: u32| {
        (0..9).map(move |tap| at(packed, (tap * to_padded + i / from) * from_padded + i % from))
    };
    (0..to * from).flat_map(taps).map(|value| value as f32).collect()
}

/// The error of a sum of this many products of packed factors, given the sum of magnitudes of the terms and the largest
/// magnitudes, all scaled. A matrix unit may truncate instead of rounding additions, and flush subnormal numbers.
pub(super) fn sum_error(count: u32, magnitude: f64, largest: [f64; 2]) -> f64 {
    let count = f64::from(count);
    let cut = 4.0 * (count + 2.0) * super::rounding::UNIT * magnitude;
    cut + count * f64::exp2(-14.0) * (largest[0] + largest[1])
}

/// The largest magnitude.
pub(super) fn largest(values: &[f32]) -> f64 {
    values.iter().fold(0.0, |largest: f64, &value| largest.max(value.abs().into()))
}

#[cfg(test)]
mod tests {
    use half::f16;

    use super::nearest;

    #[test]
    fn every_half_is_nearest_to_its_value_and_to_close_values() {
        let value = |half: u32| f16::from_bits(half as u16).to_f64();
        for half in (0..0x1_0000).filter(|half| !value(*half).is_nan()) {
            let value = value(half);
            assert_eq!(nearest(value), half, "{value}");
            assert_eq!(nearest(value * (1.0 + f64::exp2(-14.0))), half, "{value}");
        }
        assert_eq!(nearest(1.0 + f64::exp2(-11.0)), nearest(1.0), "of two the even one");
        assert_eq!(nearest(-f64::exp2(-25.0)), 0x8000);
        assert!(value(nearest(f64::NAN)).is_nan());
    }
}
