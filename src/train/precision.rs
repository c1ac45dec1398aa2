//! Storage precision on the device; arithmetic is always in 32 bits.

use std::sync::Arc;

use nightsplat_core::settings;
use nightsplat_core::settings::Rule;
use rayon::iter::{IndexedParallelIterator, ParallelIterator};
use rayon::slice::ParallelSlice;
use rustc_hash::{FxBuildHasher, FxHashMap, FxHashSet};
use serde::{Deserialize, Serialize};

use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::splats::packed_sh::StorageFormat;
use crate::targets::pseudo_gt::EncodedPlanes;

settings! {
"precision."
/// Storage precision of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PrecisionConfig {
    /// Bits of the stored training photographs, or of targets that are made once. exact: the fewest that restore every
    /// value.
    photographs: PhotographBits = PhotographBits::Exact => Rule::OneOf(&["exact", "32", "16", "8"]);
    /// Bits of the SH coefficients above degree 0.
    rest: StorageFormat = StorageFormat::Half => Rule::OneOf(&["32", "16"]);
    /// Bits of Adam's moments of the Gaussians.
    moments: StorageFormat = StorageFormat::Half => Rule::OneOf(&["32", "16"]);
}
}

/// Bits of a photograph, or of a target, on the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum PhotographBits {
    /// The fewest that restore every value bit for bit: 8 or 16 for photographs with few different values, such as
    /// those of 8-bit files, else 32.
    #[default]
    #[serde(rename = "exact")]
    Exact,
    /// 32.
    #[serde(rename = "32")]
    Single,
    /// At most 16: multiples of 1/65535 unless the values are exact in fewer bits.
    #[serde(rename = "16")]
    Sixteen,
    /// 8: multiples of 1/255 unless the values are exact.
    #[serde(rename = "8")]
    Eight,
}

/// Uploads photographs with the requested bits.
#[derive(Debug)]
pub(super) struct Encoder {
    gpu: Gpu,
    bits: PhotographBits,
    /// The multiples of 1/255 and of 1/65535, created when needed.
    grids: [Option<Arc<Buffer<f32>>>; 2],
}

/// The possible bits of a code.
const CODE_BITS: [u32; 2] = [8, 16];

/// Words of codes that a thread packs at once.
const WORDS_AT_ONCE: usize = 1 << 12;

/// Codes are used if they and their table take at most this share of the values' memory.
const WORTH: f64 = 0.75;

impl Encoder {
    pub(super) fn new(gpu: &Gpu, bits: PhotographBits) -> Self {
        Self { gpu: gpu.clone(), bits, grids: [None, None] }
    }

    pub(super) fn upload(&mut self, name: &str, values: &[f32]) -> Result<EncodedPlanes> {
        let plain = |gpu: &Gpu| EncodedPlanes::plain(gpu, Arc::new(gpu.buffer(name, values)?));
        if self.bits == PhotographBits::Single {
            return plain(&self.gpu);
        }
        if let Some(palette) = palette(values, self.bits) {
            let which = usize::from(palette.len() > 1 << CODE_BITS[0]);
            let codes: FxHashMap<u32, usize> = palette.iter().copied().zip(0..).collect();
            let code = |value: f32| codes.get(&value.to_bits()).copied().unwrap_or_default();
            let palette: Vec<f32> = palette.iter().map(|&bits| f32::from_bits(bits)).collect();
            let palette = Arc::new(self.gpu.buffer("palette", &palette)?);
            return self.coded(name, values, which, palette, code);
        }
        let which = match self.bits {
            PhotographBits::Eight => 0,
            PhotographBits::Sixteen => 1,
            _ => return plain(&self.gpu),
        };
        // A grid from 0 to 1 cannot represent values beyond it, nor NaN.
        if !values.iter().all(|value| (0.0..=1.0).contains(value)) {
            return plain(&self.gpu);
        }
        let last = ((1_u32 << CODE_BITS[which]) - 1) as f32;
        if self.grids[which].is_none() {
            let grid: Vec<f32> =
                (0..1 << CODE_BITS[which]).map(|code| code as f32 / last).collect();
            self.grids[which] = Some(Arc::new(self.gpu.buffer("grid", &grid)?));
        }
        match self.grids[which].clone() {
            Some(grid) => {
                self.coded(name, values, which, grid, |value| (value * last).round() as usize)
            }
            None => plain(&self.gpu),
        }
    }

    fn coded(
        &self,
        name: &str,
        values: &[f32],
        which: usize,
        palette: Arc<Buffer<f32>>,
        code: impl Fn(f32) -> usize + Sync,
    ) -> Result<EncodedPlanes> {
        let code_bits = CODE_BITS[which];
        let word = |values: &[f32]| {
            let codes = values.iter().zip((0..).step_by(code_bits as usize));
            codes.fold(0, |word, (&value, shift)| word | (code(value) as u32) << shift)
        };
        let words =
            values.par_chunks(32 / code_bits as usize).with_min_len(WORDS_AT_ONCE).map(word);
        let words: Vec<u32> = words.collect();
        let codes = self.gpu.buffer(name, &words)?;
        Ok(EncodedPlanes { code_bits, value_count: values.len(), codes, values: palette })
    }
}

/// The bits of all different values, ascending, if codes for them save memory.
fn palette(values: &[f32], bits: PhotographBits) -> Option<Vec<u32>> {
    let most = 1 << if bits == PhotographBits::Eight { CODE_BITS[0] } else { CODE_BITS[1] };
    let palette = different(values, most)?;
    let code_bytes = if palette.len() > 1 << CODE_BITS[0] { 2 } else { 1 };
    let bytes = values.len() * code_bytes + size_of_val(palette.as_slice());
    let is_worth_it = bytes as f64 <= WORTH * size_of_val(values) as f64;
    is_worth_it.then_some(palette)
}

/// The bits of all different values, ascending; `None` if there are more than `most`.
fn different(values: &[f32], most: usize) -> Option<Vec<u32>> {
    if hashes_exceed(most, values) {
        return None;
    }
    let capacity = values.len().min(most + 1);
    let mut found = FxHashSet::with_capacity_and_hasher(capacity, FxBuildHasher);
    for bits in changes(values) {
        if found.insert(bits) && found.len() > most {
            return None;
        }
    }
    let mut different: Vec<u32> = found.into_iter().collect();
    different.sort_unstable();
    Some(different)
}

/// The bits of values that differ from the one before: in dark photographs, neighbours are often equal.
fn changes(values: &[f32]) -> impl Iterator<Item = u32> {
    let mut last = None;
    values.iter().map(|x| x.to_bits()).filter(move |&bits| last.replace(bits) != Some(bits))
}

/// Whether more than `most` hashes differ, and so more than `most` values, which would take longer to collect.
fn hashes_exceed(most: usize, values: &[f32]) -> bool {
    const HASH_BITS: u32 = 20;
    /// 2^32 over the golden ratio.
    const SPREADING: u32 = 0x9e37_79b9;
    let mut seen = vec![0_u64; (1 << HASH_BITS) / 64];
    let mut different = 0;
    changes(values).any(|bits| {
        let hash = bits.wrapping_mul(SPREADING) >> (u32::BITS - HASH_BITS);
        let (word, bit) = (&mut seen[hash as usize / 64], 1 << (hash % 64));
        different += usize::from(*word & bit == 0);
        *word |= bit;
        different > most
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::gpu;
    use crate::targets::pseudo_gt::PseudoGt;
    use nightsplat_core::random::Stream;
    use nightsplat_photographs::tone::ToneSettings;

    /// The restored values, and the bits they were stored in.
    fn kept(bits: PhotographBits, values: &[f32]) -> (Vec<f32>, u32) {
        let gpu = gpu();
        let photograph = Encoder::new(&gpu, bits).upload("photograph", values).unwrap();
        let pseudo_gt = PseudoGt::new(&gpu, &ToneSettings::default()).unwrap();
        let mut decoded = gpu.uninit("decoded", values.len()).unwrap();
        let download = gpu.run("decode", |pass| {
            let decoded = pseudo_gt.record(pass, &photograph, None, &mut decoded)?;
            pass.download(decoded)
        });
        (download.unwrap().wait().unwrap(), photograph.code_bits)
    }

    fn bits(values: &[f32]) -> Vec<u32> {
        values.iter().map(|value| value.to_bits()).collect()
    }

    /// A photograph with `different` values, some of which are not finite or not of a file.
    fn photograph(len: usize, different: u64) -> Vec<f32> {
        let stream = Stream::new(7, 1);
        let value = |i| (stream.bits(i) % different) as f32 / (different - 1) as f32;
        let mut values: Vec<f32> = (0..len as u64).map(value).collect();
        let odd = [-0.0, f32::INFINITY, f32::from_bits(0x7fc1_2345), 1e-40, -3.5];
        values[..odd.len()].copy_from_slice(&odd);
        values
    }

    #[test]
    fn exact_restores_every_bit_from_as_few_bits_as_possible() {
        for len in [66, 1023, 1026, 1029, 2052] {
            let values = photograph(len, 2);
            let (back, kept) = kept(PhotographBits::Exact, &values);
            assert_eq!((bits(&back), kept), (bits(&values), 8), "{len} values");
        }
        for (different, expected) in [(251, 8), (252, 16), (5_000, 16), (70_000, 32)] {
            let values = photograph(60_003, different);
            let (back, kept) = kept(PhotographBits::Exact, &values);
            assert_eq!((bits(&back), kept), (bits(&values), expected), "{different} different");
        }
        let signed: Vec<f32> = photograph(60_003, 251).iter().map(|value| value - 0.1).collect();
        let (back, stored) = kept(PhotographBits::Exact, &signed);
        assert_eq!((bits(&back), stored), (bits(&signed), 8));
        let values = photograph(60_003, 251);
        let (back, kept) = kept(PhotographBits::Single, &values);
        assert_eq!((bits(&back), kept), (bits(&values), 32));
    }

    #[test]
    fn a_grid_rounds_by_at_most_half_a_step_and_keeps_values_beyond_it() {
        let stream = Stream::new(7, 2);
        let values: Vec<f32> = (0..60_000).map(|i| stream.uniform(i) as f32).collect();
        for (asked, expected, step) in
            [(PhotographBits::Sixteen, 16, 1.0 / 65535.0), (PhotographBits::Eight, 8, 1.0 / 255.0)]
        {
            let (back, kept) = kept(asked, &values);
            assert_eq!(kept, expected);
            let worst = back.iter().zip(&values).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 0.51 * step && worst > 0.49 * step, "{worst} of {step}");
            // Noise at black is negative.
            for other in [1.5, -1e-3] {
                let beyond = [&values[..], &[other; 3]].concat();
                assert_eq!(self::kept(asked, &beyond), (beyond, 32));
            }
        }
        // An 8-bit photograph is on the grid, and 16 bits represent what 8 cannot.
        let codes = photograph(60_005, 200)[5..].to_vec();
        assert_eq!(kept(PhotographBits::Eight, &codes), (codes, 8));
        let fine = photograph(60_003, 5_000);
        assert_eq!(bits(&kept(PhotographBits::Sixteen, &fine).0), bits(&fine));
    }
}
