//! The radix sort: least significant digit first, up to 8 bits per pass.
//!
//! On a GPU, only the first pass has an upsweep: where a downsweep places a key, it counts it for the next pass.

use std::sync::Arc;

use super::{Count, common_len};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads, WORKGROUP};
use crate::kernels::digit::{MAX_DIGIT_BITS, MAX_DIGITS};
use crate::kernels::{sort_downsweep, sort_upsweep};

/// A stable sort of (key, value) pairs of `u32`, ascending by key.
#[derive(Debug)]
pub struct RadixSort {
    gpu: Gpu,
    kernels: Arc<RadixKernels>,
    partition_size: u32,
    /// Partitions of a workgroup.
    subgroups: u32,
    /// Workgroups of a kernel that are done; 0 between kernels.
    arrivals: Buffer<u32>,
    scratch: SortScratch,
}

/// The kernels, which sorts on one device share.
#[derive(Debug)]
struct RadixKernels {
    upsweep: Pipeline<sort_upsweep::Kernel>,
    downsweep: Pipeline<sort_downsweep::Kernel>,
}

/// The most subgroups of a workgroup on a GPU, where the last workgroup scans the counts of all with as many threads.
/// On a CPU, a barrier between subgroups costs more than that saves.
const SUBGROUPS_ON_A_GPU: u32 = 8;

/// Scratch memory of a sort.
#[derive(Debug)]
struct SortScratch {
    /// Each pass writes the pairs here; then these and the caller's buffers are swapped.
    keys: Buffer<u32>,
    values: Buffer<u32>,
    /// (workgroups, digits), in turn that of a pass, of the next and of the one after it; one where each pass counts
    /// its own keys.
    table: Buffer<u32>,
    /// (digits)
    digit_begins: Buffer<u32>,
}

/// A pass of a sort.
struct Digit {
    shift: u32,
    bits: u32,
    /// The bits of the next pass's digit; 0: there is none.
    next_bits: u32,
    /// How many passes are before it.
    index: u32,
}

impl RadixSort {
    /// Its size in bytes per pair.
    pub(crate) fn bytes_per_item(&self) -> usize {
        2 * size_of::<u32>() + (size_of::<u32>() << MAX_DIGIT_BITS) / self.partition_size as usize
    }

    /// A sort with scratch memory for `capacity` pairs, reallocated for buffers of another length.
    pub fn new(gpu: &Gpu, capacity: u32) -> Result<Self> {
        let partition_size = sort_upsweep::Constants::default().partition_size;
        let subgroup_size = gpu.properties().subgroup_size;
        let rank_by_ballot = subgroup_size > MAX_DIGIT_BITS;
        let subgroups = if gpu.properties().is_cpu {
            1
        } else {
            SUBGROUPS_ON_A_GPU.min(WORKGROUP / subgroup_size)
        };
        Ok(Self {
            gpu: gpu.clone(),
            kernels: Arc::new(RadixKernels {
                upsweep: gpu.pipeline(&sort_upsweep::Constants { partition_size, subgroups })?,
                downsweep: gpu.pipeline(&sort_downsweep::Constants {
                    partition_size,
                    rank_by_ballot,
                    subgroups,
                })?,
            }),
            partition_size,
            subgroups,
            arrivals: gpu.zeros("sort_arrivals", 1)?,
            scratch: SortScratch::new(gpu, capacity, [partition_size, subgroups])?,
        })
    }

    /// Another sort with the same kernels and memory of its own, none yet.
    pub(crate) fn another(&self) -> Result<Self> {
        Ok(Self {
            gpu: self.gpu.clone(),
            kernels: Arc::clone(&self.kernels),
            arrivals: self.gpu.zeros("sort_arrivals", 1)?,
            scratch: SortScratch::new(&self.gpu, 0, [self.partition_size, self.subgroups])?,
            ..*self
        })
    }

    /// Takes memory to sort buffers of `capacity` pairs, so that recording takes none.
    pub(crate) fn reserve(&mut self, capacity: usize) -> Result<()> {
        if self.scratch.keys.len() != capacity {
            let capacity = common_len("sort", &[capacity])?;
            let shape = [self.partition_size, self.subgroups];
            self.scratch = SortScratch::new(&self.gpu, capacity, shape)?;
        }
        Ok(())
    }

    /// Records the sort of the first `count` pairs by the lowest `bits` bits of their keys (32 at most); it is stable.
    /// Afterwards `keys` and `values` hold the result, whatever the number of passes, because they are swapped with the
    /// scratch memory: their elements beyond the count are lost. A count beyond the buffers' common length is clamped
    /// to it.
    pub fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        count: Count<'_>,
        keys: &mut Buffer<u32>,
        values: &mut Buffer<u32>,
        bits: u32,
    ) -> Result<()> {
        count.check()?;
        common_len("sort", &[keys.len(), values.len()])?;
        self.reserve(keys.len())?;
        let mut digits = digits(bits).zip(0..).peekable();
        while let Some(((shift, bits), index)) = digits.next() {
            let next_bits = digits.peek().map_or(0, |((_, bits), _)| *bits);
            let digit = Digit { shift, bits, next_bits, index };
            self.record_pass(pass, count, keys, values, &digit)?;
            std::mem::swap(keys, &mut self.scratch.keys);
            std::mem::swap(values, &mut self.scratch.values);
        }
        Ok(())
    }

    /// Sorts the pairs by one digit, from `keys` and `values` into the scratch memory.
    fn record_pass(
        &mut self,
        pass: &mut Recorder<'_>,
        Count { counts, index: count_index }: Count<'_>,
        keys: &Buffer<u32>,
        values: &Buffer<u32>,
        digit: &Digit,
    ) -> Result<()> {
        let capacity = common_len("sort", &[keys.len(), values.len()])?;
        let Digit { shift, bits: digit_bits, next_bits, index } = *digit;
        let SortScratch { keys: sorted_keys, values: sorted_values, table, digit_begins } =
            &mut self.scratch;
        let arrivals = &mut self.arrivals;
        let workgroups = capacity.div_ceil(self.partition_size).div_ceil(self.subgroups);
        let counts_next = self.subgroups > 1;
        let table_of = |index| if counts_next { index % 3 * workgroups * MAX_DIGITS } else { 0 };
        let threads = Threads::Workgroups([workgroups, 1, 1]);
        if index == 0 || !counts_next {
            pass.dispatch(
                &self.kernels.upsweep,
                &sort_upsweep::Params {
                    count_index,
                    capacity,
                    shift,
                    digit_bits,
                    next_table: table_of(1),
                },
                sort_upsweep::Buffers {
                    counts: counts.slice(),
                    keys: keys.slice(),
                    table: table.slice_mut(),
                    digit_begins: digit_begins.slice_mut(),
                    arrivals: arrivals.slice_mut(),
                },
                threads,
            )?;
        }
        pass.dispatch(
            &self.kernels.downsweep,
            &sort_downsweep::Params {
                count_index,
                capacity,
                shift,
                digit_bits,
                next_bits,
                own_table: table_of(index),
                next_table: table_of(index + 1),
                cleared_table: table_of(index + 2),
            },
            sort_downsweep::Buffers {
                counts: counts.slice(),
                table: table.slice_mut(),
                digit_begins: digit_begins.slice_mut(),
                keys: keys.slice(),
                values: values.slice(),
                sorted_keys: sorted_keys.slice_mut(),
                sorted_values: sorted_values.slice_mut(),
                arrivals: arrivals.slice_mut(),
            },
            threads,
        )
    }
}

impl SortScratch {
    fn new(gpu: &Gpu, capacity: u32, [partition_size, subgroups]: [u32; 2]) -> Result<Self> {
        let rows = |count: u32| (count as usize) << MAX_DIGIT_BITS;
        let workgroups = capacity.div_ceil(partition_size).div_ceil(subgroups);
        let tables = if subgroups > 1 { 3 } else { 1 };
        Ok(Self {
            keys: gpu.uninit("sort_keys", capacity as usize)?,
            values: gpu.uninit("sort_values", capacity as usize)?,
            table: gpu.uninit("sort_table", rows(tables * workgroups))?,
            digit_begins: gpu.uninit("sort_digit_begins", rows(1))?,
        })
    }
}

/// The lowest bit and the width of each pass's digit. As few passes as possible, of widths as equal as possible: two
/// digits of 5 bits need an eighth of the counters of 8 and 2 bits.
fn digits(bits: u32) -> impl Iterator<Item = (u32, u32)> {
    let bits = bits.min(u32::BITS);
    let passes = bits.div_ceil(MAX_DIGIT_BITS);
    let width = bits.div_ceil(passes.max(1)).max(1);
    (0..bits).step_by(width as usize).map(move |shift| (shift, width.min(bits - shift)))
}

#[cfg(test)]
mod tests {
    use super::digits;

    #[test]
    fn digits_cover_every_bit_once_in_the_fewest_passes() {
        for bits in 0..=32 {
            let digits: Vec<_> = digits(bits).collect();
            assert_eq!(digits.len() as u32, bits.div_ceil(8), "{bits} bits");
            let mut next = 0;
            for (shift, width) in digits {
                assert_eq!(shift, next, "{bits} bits");
                assert!((1..=8).contains(&width), "{bits} bits");
                next += width;
            }
            assert_eq!(next, bits);
        }
    }
}
