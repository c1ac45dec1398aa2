//! The comparison of a pass's results on the device with those of its CPU reference.

use std::fmt;

use crate::{Error, Result};

/// The relative error of one rounding to single precision.
const ROUNDING: f64 = f32::EPSILON as f64 / 2.0;

/// The allowed difference between the 32-bit numbers of a buffer and the reference's.
///
/// Two NaNs agree, as do two zeros; a NaN on one side only is a difference. Vulkan lets a device flush subnormal
/// numbers to zero, so this difference is allowed as well wherever floats need not be exact.
#[derive(Clone, Debug, Default)]
pub enum Tolerance {
    /// None: integers, copies, and operations that IEEE 754 rounds correctly.
    #[default]
    Exact,
    /// This number of roundings of the expected number.
    Roundings(f64),
    /// A bound for each number; numbers beyond the list are exact.
    Each(Vec<f64>),
    /// A bound for each word, which holds the bits of a float.
    Floats(Vec<f64>),
    /// A bound for each number, and after them for both numbers of each word, the lower first; then exact.
    Packed {
        /// Of the whole words.
        numbers: Vec<f64>,
        /// The value of half a word.
        format: fn(u16) -> f64,
        /// Of the halves of the words after them.
        pairs: Vec<[f64; 2]>,
    },
    /// Two 16-bit floats in a word, each equal to the reference's or adjacent to it.
    Halves,
    /// Numbers without sign in a word, of these widths from the lowest bit on, each equal to the reference's or adjacent
    /// to it.
    Fields(&'static [u32]),
    /// One partial sum per workgroup, of which only the total counts: the device chooses the partition.
    Sum(f64),
    /// Integers in groups of `width`, in any order between one of `begins`, which are numbers of groups, and the next.
    AnyOrder {
        /// Words of a group.
        width: usize,
        /// Ascending; the groups before the first and after the last are where they are.
        begins: Vec<usize>,
    },
}

/// The result of one pass of a checked recording.
#[derive(Clone, Debug)]
pub struct CheckedPass {
    /// The label of the submission.
    pub recording: String,
    /// The kernel.
    pub kernel: &'static str,
    /// The largest error, in units of the bound: at most 1 where the pass agrees. `None` where the pass was not
    /// compared, because it works on counts or indices that differ already.
    pub error: Option<f64>,
    /// The first number that differs.
    pub difference: Option<Difference>,
}

/// A number that differs by more than roundings explain.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// The pass, counted from 0 in its report.
    pub pass: usize,
    /// The kernel.
    pub kernel: &'static str,
    /// The buffer, as the shader calls it.
    pub buffer: &'static str,
    /// The index among the buffer's 32-bit numbers; 0 for the total of partial sums.
    pub index: usize,
    /// The device's value.
    pub device: f64,
    /// The reference's value.
    pub reference: f64,
    /// The allowed difference.
    pub bound: f64,
    /// The number of elements of the buffer that differ.
    pub count: usize,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { pass, kernel, buffer, index, device, reference, bound, count } = self;
        write!(
            f,
            "pass {pass}, `{kernel}`: {buffer}[{index}] is {device} on the device and {reference} in the "
        )?;
        write!(f, "reference, which may differ by {bound:.3e} ({count} of its numbers differ)")
    }
}

/// All passes of the checked recordings, in order.
#[derive(Clone, Debug, Default)]
pub struct CheckReport {
    /// In order of execution.
    pub passes: Vec<CheckedPass>,
}

impl CheckReport {
    /// The first difference between device and reference; `None` on a sound device.
    pub fn first_difference(&self) -> Option<&Difference> {
        self.passes.iter().find_map(|pass| pass.difference.as_ref())
    }

    /// Appends the passes of a later report.
    pub fn extend(&mut self, later: Self) {
        let before = self.passes.len();
        self.passes.extend(later.passes.into_iter().map(|mut pass| {
            pass.difference = pass
                .difference
                .map(|difference| Difference { pass: before + difference.pass, ..difference });
            pass
        }));
    }

    /// The first difference as an error.
    pub fn agree(&self) -> Result<()> {
        match self.first_difference() {
            Some(difference) => Err(Error::Disagrees { what: difference.to_string() }),
            None => Ok(()),
        }
    }

    /// The numbers of passes by how they compare with their references, in a line.
    pub fn outcomes(&self) -> String {
        let count = |is_meant: &dyn Fn(&CheckedPass) -> bool| {
            self.passes.iter().filter(|pass| is_meant(pass)).count()
        };
        let failed = count(&|pass| pass.difference.is_some());
        let identical = count(&|pass| pass.error == Some(0.0) && pass.difference.is_none());
        let unchecked = count(&|pass| pass.error.is_none());
        let rounded = self.passes.len() - failed - identical - unchecked;
        let mut line = format!(
            "passes: {identical} identical to the reference, {rounded} within its rounding, {failed} failed"
        );
        if unchecked > 0 {
            line += &format!(", {unchecked} not compared");
        }
        line
    }

    /// Each kernel once, in the order of its first pass, with its number of passes and its largest error.
    pub fn kernels(&self) -> Vec<(&'static str, usize, f64)> {
        let mut kernels: Vec<(&'static str, usize, f64)> = vec![];
        for pass in &self.passes {
            let error = pass.error.unwrap_or_default();
            if let Some(entry) = kernels.iter_mut().find(|(name, ..)| *name == pass.kernel) {
                *entry = (entry.0, entry.1 + 1, entry.2.max(error));
            } else {
                kernels.push((pass.kernel, 1, error));
            }
        }
        kernels
    }
}

/// A buffer before the pass, and after it on the device and in the reference.
pub(super) struct Versions<'a> {
    pub(super) before: &'a [u32],
    pub(super) device: &'a [u32],
    pub(super) reference: &'a [u32],
    pub(super) is_float: bool,
}

/// The comparison of a buffer's numbers: the largest error in units of its bound, and the first that exceeds it.
#[derive(Debug, Default, PartialEq)]
pub(super) struct BufferComparison {
    pub(super) error: f64,
    /// Index, device, reference, bound.
    pub(super) first: Option<(usize, [f64; 3])>,
    pub(super) count: usize,
}

impl Versions<'_> {
    /// `workgroups` is the number of partial sums.
    pub(super) fn compare(&self, tolerance: &Tolerance, workgroups: usize) -> BufferComparison {
        let is_float = self.is_float || matches!(tolerance, Tolerance::Floats(_));
        let number = |word: u32| {
            if is_float { f64::from(f32::from_bits(word)) } else { f64::from(word) }
        };
        if let Tolerance::AnyOrder { width, begins } = tolerance {
            let [device, reference] =
                [self.device, self.reference].map(|words| in_order(words, *width, begins));
            let sorted = Versions { device: &device, reference: &reference, ..*self };
            return sorted.compare(&Tolerance::Exact, workgroups);
        }
        let mut comparison = BufferComparison::default();
        let mut from = 0;
        if let Tolerance::Sum(bound) = *tolerance {
            from = workgroups.min(self.device.len());
            let sum = |words: &[u32]| words[..from].iter().map(|&word| number(word)).sum();
            comparison.add(0, sum(self.device), sum(self.reference), bound + flushed(from));
        }
        for i in from..self.device.len() {
            let expected = match tolerance {
                // Beyond the partial sums nothing is written; the reference writes one and zeros.
                Tolerance::Sum(_) => self.before[i],
                _ => self.reference[i],
            };
            if self.device[i] == expected {
                continue;
            }
            let packed = match tolerance {
                Tolerance::Halves => Some(farthest_halves(self.device[i], expected)),
                Tolerance::Fields(widths) => {
                    Some(farthest_fields(self.device[i], expected, widths))
                }
                _ => None,
            };
            if let Some((device, reference)) = packed {
                comparison.add(i, device, reference, 1.0);
                continue;
            }
            if let Tolerance::Packed { numbers, format, pairs } = tolerance
                && let Some(bounds) = i.checked_sub(numbers.len()).and_then(|at| pairs.get(at))
            {
                for (shift, bound) in [0, 16].into_iter().zip(bounds) {
                    let half = |word: u32| format((word >> shift) as u16);
                    comparison.add(i, half(self.device[i]), half(expected), *bound);
                }
                continue;
            }
            let (device, reference) = (number(self.device[i]), number(expected));
            let bound = match tolerance {
                Tolerance::Exact
                | Tolerance::Sum(_)
                | Tolerance::Halves
                | Tolerance::Fields(_)
                | Tolerance::AnyOrder { .. } => 0.0,
                Tolerance::Roundings(n) => n * ROUNDING * reference.abs() + flushed(1),
                Tolerance::Each(bounds)
                | Tolerance::Floats(bounds)
                | Tolerance::Packed { numbers: bounds, .. } => bounds
                    .get(i)
                    .map_or(0.0, |bound| bound + if is_float { flushed(1) } else { 0.0 }),
            };
            comparison.add(i, device, reference, bound);
        }
        comparison
    }
}

/// The words with the groups between two of `begins` sorted.
fn in_order(words: &[u32], width: usize, begins: &[usize]) -> Vec<u32> {
    let mut sorted = words.to_vec();
    for run in begins.windows(2) {
        let words = &words[width * run[0]..width * run[1]];
        let mut groups: Vec<&[u32]> = words.chunks_exact(width).collect();
        groups.sort_unstable();
        sorted[width * run[0]..width * run[1]].copy_from_slice(&groups.concat());
    }
    sorted
}

/// Of two words with fields of these widths, the pair of fields that is farther apart.
fn farthest_fields(device: u32, reference: u32, widths: &[u32]) -> (f64, f64) {
    let (mut shift, mut farthest) = (0, (0u32, 0u32));
    for &width in widths {
        let [device, reference] =
            [device, reference].map(|word| word >> shift & ((1 << width) - 1));
        if device.abs_diff(reference) > farthest.0.abs_diff(farthest.1) {
            farthest = (device, reference);
        }
        shift += width;
    }
    (farthest.0.into(), farthest.1.into())
}

/// Of two words with two halves each, the pair of halves that is farther apart, by index among all halves.
fn farthest_halves(device: u32, reference: u32) -> (f64, f64) {
    let rank = |half: u32| {
        let bits = half & 0x7fff;
        // No number is farther than a NaN, and every NaN is the same.
        if bits > 0x7c00 {
            return f64::from(u16::MAX);
        }
        // Zero is next to the smallest that is not subnormal.
        let magnitude = f64::from(bits.saturating_sub(0x3ff));
        if half & 0x8000 == 0 { magnitude } else { -magnitude }
    };
    let [low, high] = [0, 16].map(|shift| (rank(device >> shift), rank(reference >> shift)));
    if (low.0 - low.1).abs() > (high.0 - high.1).abs() { low } else { high }
}

/// The error of `count` numbers that a device flushes to zero.
fn flushed(count: usize) -> f64 {
    count as f64 * f64::from(f32::MIN_POSITIVE)
}

impl BufferComparison {
    fn add(&mut self, index: usize, device: f64, reference: f64, bound: f64) {
        let is_same = device == reference || (device.is_nan() && reference.is_nan());
        let distance = (device - reference).abs();
        let error = if is_same { 0.0 } else { distance / bound };
        // Positive phrasing: a NaN on one side differs.
        if is_same || distance <= bound {
            self.error = self.error.max(error);
            return;
        }
        self.error = self.error.max(if error > 1.0 { error } else { f64::INFINITY });
        self.count += 1;
        self.first.get_or_insert((index, [device, reference, bound]));
    }
}

#[cfg(test)]
mod tests {
    use super::{BufferComparison, CheckReport, CheckedPass, Difference, Tolerance, Versions};

    #[test]
    fn a_line_counts_the_passes_by_how_they_compare() {
        let pass = |error: Option<f64>| CheckedPass {
            recording: String::new(),
            kernel: "kernel",
            error,
            difference: error.filter(|&error| error > 1.0).map(|_| Difference {
                pass: 0,
                kernel: "kernel",
                buffer: "buffer",
                index: 0,
                device: 0.0,
                reference: 1.0,
                bound: 0.5,
                count: 1,
            }),
        };
        let of = |errors: &[Option<f64>]| {
            CheckReport { passes: errors.iter().copied().map(pass).collect() }.outcomes()
        };
        let sound = "passes: 2 identical to the reference, 1 within its rounding, 0 failed";
        assert_eq!(of(&[Some(0.0), Some(0.5), Some(0.0)]), sound);
        let unsound =
            "passes: 0 identical to the reference, 1 within its rounding, 1 failed, 1 not compared";
        assert_eq!(of(&[Some(1.0), Some(2.0), None]), unsound);
    }

    fn compare(device: &[f32], reference: &[f32], tolerance: &Tolerance) -> BufferComparison {
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        let (device, reference) = (bits(device), bits(reference));
        let before = &vec![0; device.len()];
        let (device, reference) = (&device, &reference);
        Versions { before, device, reference, is_float: true }.compare(tolerance, 2)
    }

    #[test]
    fn a_number_may_be_off_by_its_bound_and_no_more() {
        let each = Tolerance::Each(vec![0.25, 0.25]);
        let agreed = compare(&[1.25, 2.125], &[1.0, 2.0], &each);
        assert!(agreed.first.is_none() && (agreed.error - 1.0).abs() < 1e-6);
        let off = compare(&[1.0, 2.5, 9.0], &[1.0, 2.0, 9.0], &each);
        assert_eq!(
            off.first.map(|(i, [device, reference, _])| (i, device, reference)),
            Some((1, 2.5, 2.0))
        );
        assert_eq!(off.count, 1);
        assert!(
            compare(&[1.0, 2.0, 9.0], &[1.0, 2.0, 9.5], &each).first.is_some(),
            "beyond the list"
        );
        let one = f32::EPSILON;
        assert!(compare(&[1.0 + one], &[1.0], &Tolerance::Roundings(2.0)).first.is_none());
        assert!(compare(&[1.0 + one], &[1.0], &Tolerance::Roundings(1.0)).first.is_some());
        assert!(compare(&[1.0 + one], &[1.0], &Tolerance::Exact).first.is_some());
        assert_eq!(compare(&[0.0], &[-0.0], &Tolerance::Exact), BufferComparison::default());
    }

    #[test]
    fn both_numbers_of_a_word_have_bounds_and_words_before_and_after_them_are_numbers() {
        let packed = Tolerance::Packed {
            numbers: vec![0.25],
            format: |half| f64::from(half),
            pairs: vec![[1.0, 0.0]],
        };
        let words = |pair: u32| [1.0, f32::from_bits(pair), 2.0];
        let of = |device: [f32; 3]| compare(&device, &words(0x0005_0007), &packed);
        assert_eq!(of(words(0x0005_0006)), BufferComparison { error: 1.0, ..Default::default() });
        let off = |pair| of(words(pair)).first;
        assert_eq!(off(0x0005_0009), Some((1, [9.0, 7.0, 1.0])));
        assert_eq!(off(0x0004_0008), Some((1, [4.0, 5.0, 0.0])));
        assert!(of([1.25, words(0x0005_0007)[1], 2.0]).first.is_none());
        assert_eq!(of([1.0, words(0x0005_0007)[1], 2.5]).first, Some((2, [2.5, 2.0, 0.0])));
    }

    #[test]
    fn two_nans_agree_and_one_differs() {
        for tolerance in [
            Tolerance::Exact,
            Tolerance::Roundings(9.0),
            Tolerance::Each(vec![f64::INFINITY; 2]),
            Tolerance::Each(vec![f64::NAN; 2]),
            Tolerance::Sum(9.0),
        ] {
            let nans = [f32::NAN, -f32::NAN];
            assert_eq!(compare(&nans, &[f32::NAN; 2], &tolerance), BufferComparison::default());
            let off = compare(&nans, &[1.0, f32::NAN], &tolerance);
            let sums = matches!(tolerance, Tolerance::Sum(_));
            assert_eq!((off.count, off.error), if sums { (0, 0.0) } else { (1, f64::INFINITY) });
            assert_eq!(compare(&[0.0, 1.0], &[1.0, f32::NAN], &tolerance).error, f64::INFINITY);
        }
    }

    #[test]
    fn groups_of_a_run_are_compared_in_any_order_and_others_where_they_are() {
        let compare = |device: &[u32], reference: &[u32]| {
            let versions = Versions { before: &[0; 8], device, reference, is_float: false };
            versions.compare(&Tolerance::AnyOrder { width: 2, begins: vec![1, 3] }, 1).count
        };
        let reference = [9, 8, 1, 2, 3, 4, 5, 6];
        assert_eq!(compare(&[9, 8, 3, 4, 1, 2, 5, 6], &reference), 0);
        assert_eq!(compare(&[9, 8, 3, 4, 2, 1, 5, 6], &reference), 2, "within a group");
        assert_eq!(compare(&[9, 8, 1, 2, 1, 2, 5, 6], &reference), 2, "twice the same");
        assert_eq!(compare(&[1, 2, 9, 8, 3, 4, 5, 6], &reference), 6, "before the first run");
        assert_eq!(compare(&[9, 8, 1, 2, 5, 6, 3, 4], &reference), 4, "across the end of a run");
    }

    #[test]
    fn partial_sums_compare_as_one_and_nothing_is_written_after_them() {
        let sum = Tolerance::Sum(0.1);
        assert!(compare(&[1.0, 2.0, 0.0], &[3.05, 0.0, 0.0], &sum).first.is_none());
        assert_eq!(
            compare(&[1.0, 2.0, 0.0], &[3.5, 0.0, 0.0], &sum).first,
            Some((0, [3.0, 3.5, 0.1 + 2.0 * f64::from(f32::MIN_POSITIVE)]))
        );
        assert_eq!(
            compare(&[1.0, 2.0, 7.0], &[3.0, 0.0, 0.0], &sum).first,
            Some((2, [7.0, 0.0, 0.0]))
        );
    }
}
