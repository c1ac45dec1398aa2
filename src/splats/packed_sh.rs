//! SH coefficients above degree 0 in 16 bits, two per word of the planes, as in include/half.glsl.

use nightsplat_models::attributes::PlaneCounts;
use serde::{Deserialize, Serialize};

use crate::kernels::half::{LARGEST_HALF, SMALLEST_HALF};

/// Storage format of trained numbers; arithmetic is in 32 bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum StorageFormat {
    /// 32-bit float.
    #[default]
    #[serde(rename = "32")]
    Single,
    /// 16-bit float, rounded stochastically by a hash: the same in every run.
    #[serde(rename = "16")]
    Half,
}

impl StorageFormat {
    /// Words per Gaussian whose SH coefficients above degree 0 have this format.
    pub(crate) fn words(self, planes: PlaneCounts) -> usize {
        match self {
            Self::Single => planes.columns,
            Self::Half => PackedSh::new(planes).columns(),
        }
    }
}

/// Layout of Gaussians with packed SH coefficients.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PackedSh {
    count: usize,
    /// Words per Gaussian before the packed ones.
    before: usize,
    /// SH coefficients above degree 0 per Gaussian.
    rest: usize,
}

impl PackedSh {
    /// The packed form of planes of floats.
    pub(crate) fn new(planes: PlaneCounts) -> Self {
        Self { count: planes.gaussians, before: planes.before_rest(), rest: planes.rest() }
    }

    /// Words per Gaussian.
    pub(crate) fn columns(self) -> usize {
        self.before + self.rest.div_ceil(2)
    }

    /// Packs the coefficients of planes of floats, each rounded to nearest.
    pub(crate) fn pack(self, floats: &[f32]) -> Vec<f32> {
        let word = |pair: &[f32]| {
            let halves = [0, 1].map(|k| u32::from(pair.get(k).map_or(0, |&value| nearest(value))));
            f32::from_bits(halves[0] | halves[1] << 16)
        };
        let (planes, rest) = floats.split_at(self.before * self.count);
        let words = rest.chunks_exact(self.rest.max(1)).flat_map(|row| row.chunks(2).map(word));
        planes.iter().copied().chain(words).collect()
    }

    /// Unpacks planes to floats.
    pub(crate) fn unpack(self, words: &[f32]) -> Vec<f32> {
        let (planes, rest) = words.split_at(self.before * self.count);
        let floats = rest.chunks_exact(self.rest.div_ceil(2).max(1)).flat_map(|row| {
            let bits = row.iter().map(|word| word.to_bits());
            bits.flat_map(|bits| [bits, bits >> 16].map(|half| value(half as u16))).take(self.rest)
        });
        planes.iter().copied().chain(floats).collect()
    }
}

/// The value of a half, which must not be subnormal, infinite or NaN.
pub(crate) fn value(half: u16) -> f32 {
    let (sign, magnitude) = (u32::from(half >> 15), u32::from(half & 0x7fff));
    let shifted = if magnitude == 0 { 0 } else { (magnitude << 13) + ((127 - 15) << 23) };
    f32::from_bits(sign << 31 | shifted)
}

/// Rounds to the nearest half, ties to even.
pub(crate) fn nearest(value: f32) -> u16 {
    let (smallest, largest) = (SMALLEST_HALF as f32, LARGEST_HALF as f32);
    let magnitude = value.abs().min(largest);
    let sign = u16::from(value.is_sign_negative()) << 15;
    if magnitude < smallest {
        // Zero or the smallest half.
        return sign | if magnitude > smallest / 2.0 { 1 << 10 } else { 0 };
    }
    let bits = magnitude.to_bits() - ((127 - 15) << 23);
    let rounded = (bits + 0x0fff + (bits >> 13 & 1)) >> 13;
    sign | rounded as u16
}

#[cfg(test)]
mod tests {
    use super::{PackedSh, nearest, value};
    use nightsplat_models::attributes::{PlaneCounts, column_count};

    #[test]
    fn every_half_is_restored_and_numbers_round_to_the_nearest() {
        for half in (0..=u16::MAX).filter(|half| matches!(half & 0x7fff, 0 | 0x0400..=0x7bff)) {
            assert_eq!(nearest(value(half)), half, "{half:#x}");
            let next = half + 1;
            if (0x0400..0x7bff).contains(&half) {
                let (a, b) = (value(half), value(next));
                assert_eq!(nearest(a + 0.499 * (b - a)), half);
                assert_eq!(nearest(a + 0.501 * (b - a)), next);
                assert_eq!(nearest(-(a + 0.501 * (b - a))), next | 0x8000);
            }
        }
        assert_eq!(value(0x3c00), 1.0);
        assert_eq!(value(0xc000), -2.0);
        assert_eq!(value(nearest(1e9)), 65504.0);
        assert_eq!(value(nearest(2e-5)), 0.0);
    }

    #[test]
    fn planes_of_every_degree_are_restored() {
        for (degree, words) in (0..=3).zip([16, 21, 28, 39]) {
            for count in [0, 1, 5] {
                let columns = column_count(2, degree);
                let halves = PackedSh::new(PlaneCounts { gaussians: count, columns, features: 2 });
                assert_eq!(halves.columns(), words);
                let planes: Vec<f32> =
                    (0..count * columns).map(|i| value(nearest(i as f32 * 0.25))).collect();
                let packed = halves.pack(&planes);
                assert_eq!(packed.len(), count * words);
                assert_eq!(halves.unpack(&packed), planes);
            }
        }
    }
}
