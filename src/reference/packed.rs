//! Factors of 16-bit matrices as in `include/packed.glsl`, on the host.

use glam::UVec2;
use half::f16;

use super::rounding::{Rounded, UNIT};
use crate::gpu::Tolerance;
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

fn exponent(bound: u32) -> i32 {
    (bound >> 23).clamp(23, 254) as i32 - 127
}

/// The scale of a factor whose bound has these bits.
pub(super) fn scale(bound: u32) -> f64 {
    f64::from(14 - exponent(bound)).exp2()
}

/// The value of a half.
pub(super) fn half(bits: u16) -> f64 {
    f16::from_bits(bits).to_f64()
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
    half((packed[(index / 8) as usize][(index % 8 / 2) as usize] >> (16 * (index % 2))) as u16)
}

/// The values of a packed map, as planes (C, H, W): halves, which single precision represents exactly.
pub(super) fn map(size: UVec2, count: u32, packed: &[Eight]) -> Vec<f32> {
    let (columns, padded) = (extent(size).x, channels(count));
    let pixel = |i: u32| (i / size.x + 1) * columns + i % size.x + 1;
    let plane =
        |c: u32| (0..size.element_product()).map(move |i| at(packed, pixel(i) * padded + c));
    (0..count).flat_map(plane).map(|value| value as f32).collect()
}

/// A packed map with this bound, as planes (C, H, W).
pub(super) fn unpacked(size: UVec2, count: u32, packed: &[Eight], bound: u32) -> Vec<f32> {
    let scale = scale(bound);
    map(size, count, packed).into_iter().map(|value| (f64::from(value) / scale) as f32).collect()
}

/// Calls `visit(half, value)` for every half of a packed map, or of its pixels alone: with its index, and that among
/// planes (C, H, W), which halves around the map and beyond its channels do not have.
fn for_each_half(
    size: UVec2,
    count: u32,
    pixels_alone: bool,
    mut visit: impl FnMut(usize, Option<usize>),
) {
    let (extent, padded) = (extent(size), channels(count));
    for i in 0..extent.element_product() * padded {
        let (channel, pixel) = (i % padded, i / padded);
        let at = UVec2::new(pixel % extent.x, pixel / extent.x).wrapping_sub(UVec2::ONE);
        let is_pixel = at.x < size.x && at.y < size.y;
        if is_pixel || !pixels_alone {
            let value = || ((channel * size.y + at.y) * size.x + at.x) as usize;
            visit(i as usize, (is_pixel && channel < count).then(value));
        }
    }
}

/// A packed map that a kernel writes.
pub(super) struct PackedOutput {
    pub(super) size: UVec2,
    pub(super) channels: u32,
    /// Its numbers, (C, H, W).
    pub(super) planes: Vec<Rounded>,
    /// The bits of its bound.
    pub(super) bound: u32,
    /// Whether nothing around the map is written; else zeros.
    pub(super) pixels_alone: bool,
}

impl PackedOutput {
    pub(super) fn write(&self, packed: &mut [Eight]) {
        let (scale, words) = (scale(self.bound), packed.as_flattened_mut());
        for_each_half(self.size, self.channels, self.pixels_alone, |half, value| {
            let (word, shift) = (&mut words[half / 2], 16 * (half as u32 % 2));
            let bits = nearest(value.map_or(0.0, |value| scale * self.planes[value].value));
            *word = *word & !(0xffff << shift) | bits << shift;
        });
    }

    /// The error of the numbers, and that of the nearest halves above and below, for this many eights.
    pub(super) fn tolerance(&self, len: usize) -> Tolerance {
        let (scale, mut pairs) = (scale(self.bound), vec![[0.0; 2]; 4 * len]);
        for_each_half(self.size, self.channels, true, |half, value| {
            pairs[half / 2][half % 2] = value.map_or(0.0, |value| {
                let Rounded { value, error } = self.planes[value];
                scale * error + (scale * value.abs() * f64::exp2(-10.0)).max(f64::exp2(-14.0))
            });
        });
        Tolerance::Packed { numbers: vec![], format: half, pairs }
    }
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
    let cut = 4.0 * (count + 2.0) * UNIT * magnitude;
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
