//! Scan and radix sort: each kernel against its reference, the whole against the standard library.

#![allow(clippy::unwrap_used, reason = "what fails here fails the test")]

use nightsplat::gpu::testing::gpu;
use nightsplat::gpu::{Buffer, Gpu, Reference, Threads};
use nightsplat::kernels::{
    dispatch_arguments, scan_downsweep, scan_spine, scan_upsweep, sort_downsweep, sort_spine,
    sort_upsweep,
};
use nightsplat::sort::{Count, DispatchArguments, RadixSort, Scan};

const PARTITION: u32 = 1024;
const SIZES: [u32; 8] =
    [0, 1, PARTITION - 1, PARTITION, PARTITION + 1, 3 * PARTITION + 17, 65_000, 300_000];

/// Numbers without a pattern (xorshift64*), the same every time.
fn noise(len: u32) -> Vec<u32> {
    let mut state = 88_172_645_463_325_252_u64;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 32) as u32
    };
    (0..len).map(|_| next()).collect()
}

fn first(counts: &Buffer<u32>) -> Count<'_> {
    Count { counts, index: 0 }
}

fn assert_same(what: &str, actual: &[u32], expected: &[u32]) {
    assert_eq!(actual.len(), expected.len(), "{what}: lengths");
    let pairs = actual.iter().zip(expected).enumerate();
    let wrong: Vec<_> = pairs.filter(|(_, (a, b))| a != b).take(10).collect();
    assert!(wrong.is_empty(), "{what}: (index, (actual, expected)) {wrong:?}");
}

/// The pairs (keys[i], i) for i below `count`, as [`RadixSort`] leaves them.
fn sorted(
    gpu: &Gpu,
    sort: &mut RadixSort,
    keys: &[u32],
    count: u32,
    bits: u32,
) -> (Vec<u32>, Vec<u32>) {
    let counts = gpu.buffer("counts", &[u32::MAX, count]).unwrap();
    let mut values = gpu.buffer("values", &(0..keys.len() as u32).collect::<Vec<_>>()).unwrap();
    let mut keys = gpu.buffer("keys", keys).unwrap();
    let count = Count { counts: &counts, index: 1 };
    gpu.run("sort", |pass| sort.record(pass, count, &mut keys, &mut values, bits)).unwrap();
    (gpu.read(&keys).unwrap(), gpu.read(&values).unwrap())
}

/// Sorts on the device and with the standard library, and compares the first `count` pairs.
fn assert_sorts(gpu: &Gpu, sort: &mut RadixSort, what: &str, keys: &[u32], count: u32, bits: u32) {
    let what = format!("{what}, {count} of {} keys, {bits} bits", keys.len());
    let mask = if bits == 0 { 0 } else { u32::MAX >> (32 - bits) };
    let count_in_range = (count as usize).min(keys.len());
    let mut order: Vec<u32> = (0..count_in_range as u32).collect();
    order.sort_by_key(|&i| keys[i as usize] & mask);
    let expected: Vec<u32> = order.iter().map(|&i| keys[i as usize]).collect();
    let (sorted_keys, sorted_values) = sorted(gpu, sort, keys, count, bits);
    assert_same(&format!("{what}: keys"), &sorted_keys[..count_in_range], &expected);
    assert_same(&format!("{what}: values"), &sorted_values[..count_in_range], &order);
}

#[test]
fn sorts_of_all_sizes_are_right_and_stable() {
    let gpu = gpu();
    let mut sort = RadixSort::new(&gpu, 0).unwrap();
    for size in SIZES {
        let keys = noise(size);
        for bits in [10, 32] {
            assert_sorts(&gpu, &mut sort, "noise", &keys, size, bits);
        }
    }
}

#[test]
fn any_number_of_bits_sorts_by_those_bits_alone() {
    let gpu = gpu();
    let mut sort = RadixSort::new(&gpu, 3000).unwrap();
    let keys = noise(3000);
    for bits in [0, 1, 7, 8, 9, 13, 16, 17, 24, 31] {
        assert_sorts(&gpu, &mut sort, "noise", &keys, 3000, bits);
    }
}

#[test]
fn equal_and_extreme_keys_keep_their_order() {
    let gpu = gpu();
    let mut sort = RadixSort::new(&gpu, 5000).unwrap();
    for key in [0, 1, 0x0102_0408, u32::MAX] {
        assert_sorts(&gpu, &mut sort, "equal keys", &[key; 5000], 5000, 32);
    }
    let extremes: Vec<u32> = noise(5000).iter().map(|n| 0_u32.wrapping_sub(n & 1)).collect();
    assert_sorts(&gpu, &mut sort, "0 and the maximum", &extremes, 5000, 32);
    let descending: Vec<u32> = (0..5000).rev().collect();
    assert_sorts(&gpu, &mut sort, "descending", &descending, 5000, 32);
}

#[test]
fn a_sort_takes_its_count_from_the_device_and_stays_within_the_buffers() {
    let gpu = gpu();
    let mut sort = RadixSort::new(&gpu, 4000).unwrap();
    let keys = noise(4000);
    for count in [0, 1, 1023, 2049, 3999, 4000, 4001, u32::MAX] {
        assert_sorts(&gpu, &mut sort, "count", &keys, count, 32);
    }
}

#[test]
fn twenty_five_sorts_are_identical() {
    let gpu = gpu();
    let mut sort = RadixSort::new(&gpu, 20_000).unwrap();
    // Few distinct keys: any race between equal ones would show in the values.
    let keys: Vec<u32> = noise(20_000).iter().map(|n| n % 37).collect();
    let first = sorted(&gpu, &mut sort, &keys, 20_000, 8);
    for _ in 1..25 {
        assert!(sorted(&gpu, &mut sort, &keys, 20_000, 8) == first);
    }
}

#[test]
fn two_sorts_in_one_recording_do_not_disturb_each_other() {
    let gpu = gpu();
    let (keys, ids) = (noise(2500), (0..2500).collect::<Vec<u32>>());
    let mut sort = RadixSort::new(&gpu, 2500).unwrap();
    let counts = gpu.buffer("counts", &[2500]).unwrap();
    let mut low = gpu.buffer("low", &keys).unwrap();
    let mut order = gpu.buffer("order", &ids).unwrap();
    let mut high = gpu.buffer("high", &keys.iter().map(|k| k >> 24).collect::<Vec<_>>()).unwrap();
    let mut high_order = gpu.buffer("high_order", &ids).unwrap();
    gpu.run("sort", |pass| {
        sort.record(pass, first(&counts), &mut low, &mut order, 24)?;
        sort.record(pass, first(&counts), &mut high, &mut high_order, 8)
    })
    .unwrap();
    let (mut by_low, mut by_high) = (ids.clone(), ids);
    by_low.sort_by_key(|&i| keys[i as usize] & 0xff_ffff);
    by_high.sort_by_key(|&i| keys[i as usize] >> 24);
    assert_same("low", &gpu.read(&order).unwrap(), &by_low);
    assert_same("high", &gpu.read(&high_order).unwrap(), &by_high);
}

#[test]
fn scans_of_all_sizes_are_right_and_leave_the_rest_alone() {
    let gpu = gpu();
    let mut scan = Scan::new(&gpu, 0).unwrap();
    for size in SIZES {
        // Large enough to wrap around.
        let values = noise(size + 5);
        let mut running = 0_u32;
        let mut expected = vec![7; values.len()];
        for i in 0..size as usize {
            expected[i] = running;
            running = running.wrapping_add(values[i]);
        }
        let counts = gpu.buffer("counts", &[size]).unwrap();
        let values = gpu.buffer("values", &values).unwrap();
        let mut offsets = gpu.buffer("offsets", &vec![7; values.len()]).unwrap();
        let mut total = gpu.buffer("total", &[7]).unwrap();
        gpu.run("scan", |pass| {
            scan.record(pass, first(&counts), &values, &mut offsets, &mut total)
        })
        .unwrap();
        assert_same(&format!("{size} offsets"), &gpu.read(&offsets).unwrap(), &expected);
        assert_eq!(gpu.read(&total).unwrap(), [running], "total of {size}");
    }
}

#[test]
fn a_count_beyond_the_buffers_scans_what_they_hold() {
    let gpu = gpu();
    let mut scan = Scan::new(&gpu, 3).unwrap();
    let counts = gpu.buffer("counts", &[u32::MAX]).unwrap();
    let values = gpu.buffer("values", &[5, 6, 7]).unwrap();
    let mut offsets = gpu.zeros("offsets", 3).unwrap();
    let mut total = gpu.zeros("total", 1).unwrap();
    gpu.run("scan", |pass| scan.record(pass, first(&counts), &values, &mut offsets, &mut total))
        .unwrap();
    assert_eq!(gpu.read(&offsets).unwrap(), [0, 5, 11]);
    assert_eq!(gpu.read(&total).unwrap(), [18]);
}

#[test]
fn buffers_that_do_not_fit_together_are_an_error() {
    let gpu = gpu();
    let (mut sort, mut scan) = (RadixSort::new(&gpu, 4).unwrap(), Scan::new(&gpu, 4).unwrap());
    let counts = gpu.zeros::<u32>("counts", 1).unwrap();
    let [mut a, mut b] = ["a", "b"].map(|name| gpu.zeros(name, 4).unwrap());
    let (mut five, mut none) = (gpu.zeros("five", 5).unwrap(), gpu.zeros("none", 0).unwrap());
    let outside = Count { counts: &counts, index: 1 };
    let lengths = gpu.run("sort", |pass| sort.record(pass, first(&counts), &mut a, &mut five, 8));
    let index = gpu.run("sort", |pass| sort.record(pass, outside, &mut a, &mut b, 8));
    let scan_lengths =
        gpu.run("scan", |pass| scan.record(pass, first(&counts), &a, &mut five, &mut b));
    let no_total = gpu.run("scan", |pass| scan.record(pass, first(&counts), &a, &mut b, &mut none));
    for (result, expected) in [
        (lengths, "sort: buffers of lengths [4, 5]; give them one length"),
        (index, "buffer `counts` holds 1 counts, none at 1"),
        (scan_lengths, "scan: buffers of lengths [4, 5]; give them one length"),
        (no_total, "scan: buffer `none` is empty; give the total one element"),
    ] {
        assert_eq!(result.unwrap_err().to_string(), expected);
    }
}

#[test]
fn dispatch_arguments_cover_the_items_and_match_the_reference() {
    let gpu = gpu();
    let pipeline = gpu.pipeline::<dispatch_arguments::Kernel>(&Default::default()).unwrap();
    let most = 65_535 * 64;
    for (count, items_per_workgroup, capacity) in [
        (0, 64, 100),
        (1, 64, 100),
        (64, 64, 100),
        (65, 64, 100),
        (1000, 64, 100),
        (most, 64, u32::MAX),
        (most + 1, 64, u32::MAX),
        (3 * most - 5, 64, u32::MAX),
        (u32::MAX, 2, u32::MAX),
    ] {
        let params = dispatch_arguments::Params { items_per_workgroup, count_index: 1, capacity };
        let counts = [12_345, count];
        let mut expected = [[9; 3]];
        let slices = dispatch_arguments::Slices { counts: &counts, arguments: &mut expected };
        dispatch_arguments::Kernel::run(&params, &Default::default(), slices);
        let counts = gpu.buffer("counts", &counts).unwrap();
        let mut arguments = gpu.zeros("arguments", 1).unwrap();
        gpu.run("dispatch_arguments", |pass| {
            let buffers =
                dispatch_arguments::Buffers { counts: &counts, arguments: &mut arguments };
            pass.dispatch(&pipeline, &params, buffers, Threads::Workgroups([1, 1, 1]))
        })
        .unwrap();
        let actual = gpu.read(&arguments).unwrap();
        assert_eq!(actual, expected, "{params:?}");
        let [x, y, z] = actual[0];
        let covered = u64::from(x) * u64::from(y) * u64::from(items_per_workgroup);
        assert!(covered >= u64::from(count.min(capacity)) && x <= 65_535 && y <= 65_535 && z == 1);
    }
}

#[test]
fn no_items_per_workgroup_count_as_one() {
    let gpu = gpu();
    let counts = gpu.buffer("counts", &[3]).unwrap();
    let mut arguments = DispatchArguments::new(&gpu).unwrap();
    gpu.run("arguments", |pass| arguments.record(pass, first(&counts), 0, 100)).unwrap();
    let Threads::Indirect(arguments) = arguments.threads() else { panic!("not indirect") };
    assert_eq!(gpu.read(arguments).unwrap(), [[3, 1, 1]]);
}

#[test]
fn more_workgroups_than_fit_along_x_are_folded() {
    let gpu = gpu();
    // Two values a partition make 70 001 workgroups, in two rows of 35 001: the last is idle.
    let constants = scan_upsweep::Constants { partition_size: 2 };
    let (values, capacity) = (noise(140_001), 140_001);
    let params = scan_upsweep::Params { count_index: 0, capacity };
    let mut expected = vec![9; 70_002];
    let slices = scan_upsweep::Slices { counts: &[capacity], values: &values, sums: &mut expected };
    scan_upsweep::Kernel::run(&params, &constants, slices);
    let pipeline = gpu.pipeline::<scan_upsweep::Kernel>(&constants).unwrap();
    let mut arguments = DispatchArguments::new(&gpu).unwrap();
    let counts = gpu.buffer("counts", &[capacity]).unwrap();
    let values = gpu.buffer("values", &values).unwrap();
    let mut sums = gpu.buffer("sums", &vec![9; expected.len()]).unwrap();
    gpu.run("folded", |pass| {
        arguments.record(pass, first(&counts), constants.partition_size, capacity)?;
        let buffers = scan_upsweep::Buffers { counts: &counts, values: &values, sums: &mut sums };
        pass.dispatch(&pipeline, &params, buffers, arguments.threads())
    })
    .unwrap();
    assert_same("sums", &gpu.read(&sums).unwrap(), &expected);
}

#[test]
fn scan_kernels_match_their_references() {
    let gpu = gpu();
    let upsweep = gpu.pipeline::<scan_upsweep::Kernel>(&Default::default()).unwrap();
    let spine = gpu.pipeline::<scan_spine::Kernel>(&Default::default()).unwrap();
    let downsweep = gpu.pipeline::<scan_downsweep::Kernel>(&Default::default()).unwrap();
    for size in SIZES {
        let partitions = size.div_ceil(PARTITION);
        // One workgroup more than there are partitions: it must leave no trace.
        let groups = Threads::Workgroups([partitions + 1, 1, 1]);
        let (capacity, count_index) = (size, 0);
        // A count beyond the capacity is clamped to it.
        let (counts, values) = ([size + 5], noise(size));
        let (mut sums, mut total) = (vec![9; partitions as usize + 1], [0]);
        let gpu_counts = gpu.buffer("counts", &counts).unwrap();
        let gpu_values = gpu.buffer("values", &values).unwrap();
        let mut gpu_sums = gpu.buffer("sums", &sums).unwrap();
        let mut gpu_total = gpu.zeros("total", 1).unwrap();
        let mut offsets = vec![7; values.len() + PARTITION as usize];
        let mut gpu_offsets = gpu.buffer("offsets", &offsets).unwrap();

        let params = scan_upsweep::Params { count_index, capacity };
        let slices = scan_upsweep::Slices { counts: &counts, values: &values, sums: &mut sums };
        scan_upsweep::Kernel::run(&params, &Default::default(), slices);
        let (counts_, values_) = (&gpu_counts, &gpu_values);
        let buffers =
            scan_upsweep::Buffers { counts: counts_, values: values_, sums: &mut gpu_sums };
        gpu.run("upsweep", |pass| pass.dispatch(&upsweep, &params, buffers, groups)).unwrap();
        assert_same(&format!("upsweep of {size}"), &gpu.read(&gpu_sums).unwrap(), &sums);

        let params = scan_spine::Params { count_index, capacity };
        let slices = scan_spine::Slices { counts: &counts, sums: &mut sums, total: &mut total };
        scan_spine::Kernel::run(&params, &Default::default(), slices);
        let buffers =
            scan_spine::Buffers { counts: counts_, sums: &mut gpu_sums, total: &mut gpu_total };
        let one = Threads::Workgroups([1, 1, 1]);
        gpu.run("spine", |pass| pass.dispatch(&spine, &params, buffers, one)).unwrap();
        assert_same(&format!("spine of {size}"), &gpu.read(&gpu_sums).unwrap(), &sums);
        assert_eq!(gpu.read(&gpu_total).unwrap(), total, "total of {size}");

        let params = scan_downsweep::Params { count_index, capacity };
        let slices = scan_downsweep::Slices {
            counts: &counts,
            values: &values,
            sums: &sums,
            offsets: &mut offsets,
        };
        scan_downsweep::Kernel::run(&params, &Default::default(), slices);
        let buffers = scan_downsweep::Buffers {
            counts: counts_,
            values: values_,
            sums: &gpu_sums,
            offsets: &mut gpu_offsets,
        };
        gpu.run("downsweep", |pass| pass.dispatch(&downsweep, &params, buffers, groups)).unwrap();
        assert_same(&format!("downsweep of {size}"), &gpu.read(&gpu_offsets).unwrap(), &offsets);
    }
}

#[test]
fn sort_kernels_match_their_references() {
    for rank_by_ballot in [false, true] {
        if rank_by_ballot || gpu().properties().subgroup_size <= 32 {
            compare_sort_kernels(rank_by_ballot);
        }
    }
}

fn compare_sort_kernels(rank_by_ballot: bool) {
    let gpu = gpu();
    let upsweep = gpu.pipeline::<sort_upsweep::Kernel>(&Default::default()).unwrap();
    let spine = gpu.pipeline::<sort_spine::Kernel>(&Default::default()).unwrap();
    let ranked = sort_downsweep::Constants { rank_by_ballot, ..Default::default() };
    let downsweep = gpu.pipeline::<sort_downsweep::Kernel>(&ranked).unwrap();
    // A digit narrower than any subgroup, and the widest.
    for (size, (shift, digit_bits)) in SIZES.into_iter().flat_map(|s| [(s, (31, 1)), (s, (5, 8))]) {
        let (capacity, count_index, digits) = (size, 0, 1_u32 << digit_bits);
        let partitions = size.div_ceil(PARTITION);
        // One workgroup more than there are partitions: it must leave no trace.
        let groups = Threads::Workgroups([partitions + 1, 1, 1]);
        // A count beyond the capacity is clamped to it.
        let (counts, keys) = ([size + 5], noise(size));
        let values: Vec<u32> = (0..size).map(|i| 3 * i).collect();
        let mut table = vec![0; (digits * partitions) as usize];
        let mut digit_totals = vec![0; digits as usize];
        let gpu_counts = gpu.buffer("counts", &counts).unwrap();
        let gpu_keys = gpu.buffer("keys", &keys).unwrap();
        let gpu_values = gpu.buffer("values", &values).unwrap();
        let mut gpu_table = gpu.zeros("table", table.len()).unwrap();
        let mut gpu_totals = gpu.zeros("digit_totals", digit_totals.len()).unwrap();
        let mut gpu_sorted_keys = gpu.zeros("sorted_keys", keys.len()).unwrap();
        let mut gpu_sorted_values = gpu.zeros("sorted_values", keys.len()).unwrap();
        let what = format!("of {size}, {digit_bits} bits at {shift}, {ranked:?}");

        let params = sort_upsweep::Params { count_index, capacity, shift, digit_bits };
        let slices = sort_upsweep::Slices { counts: &counts, keys: &keys, table: &mut table };
        sort_upsweep::Kernel::run(&params, &Default::default(), slices);
        let (counts_, keys_, values_) = (&gpu_counts, &gpu_keys, &gpu_values);
        let buffers = sort_upsweep::Buffers { counts: counts_, keys: keys_, table: &mut gpu_table };
        gpu.run("upsweep", |pass| pass.dispatch(&upsweep, &params, buffers, groups)).unwrap();
        assert_same(&format!("upsweep {what}"), &gpu.read(&gpu_table).unwrap(), &table);

        let params = sort_spine::Params { count_index, capacity, digit_bits };
        let slices = sort_spine::Slices {
            counts: &counts,
            table: &mut table,
            digit_totals: &mut digit_totals,
        };
        sort_spine::Kernel::run(&params, &Default::default(), slices);
        let buffers = sort_spine::Buffers {
            counts: counts_,
            table: &mut gpu_table,
            digit_totals: &mut gpu_totals,
        };
        let rows = Threads::Workgroups([digits, 1, 1]);
        gpu.run("spine", |pass| pass.dispatch(&spine, &params, buffers, rows)).unwrap();
        assert_same(&format!("spine {what}"), &gpu.read(&gpu_table).unwrap(), &table);
        assert_same(&format!("totals {what}"), &gpu.read(&gpu_totals).unwrap(), &digit_totals);

        let params = sort_downsweep::Params { count_index, capacity, shift, digit_bits };
        let (mut sorted_keys, mut sorted_values) = (vec![0; keys.len()], vec![0; keys.len()]);
        let slices = sort_downsweep::Slices {
            counts: &counts,
            table: &table,
            digit_totals: &digit_totals,
            keys: &keys,
            values: &values,
            sorted_keys: &mut sorted_keys,
            sorted_values: &mut sorted_values,
        };
        sort_downsweep::Kernel::run(&params, &ranked, slices);
        let buffers = sort_downsweep::Buffers {
            counts: counts_,
            table: &gpu_table,
            digit_totals: &gpu_totals,
            keys: keys_,
            values: values_,
            sorted_keys: &mut gpu_sorted_keys,
            sorted_values: &mut gpu_sorted_values,
        };
        gpu.run("downsweep", |pass| pass.dispatch(&downsweep, &params, buffers, groups)).unwrap();
        assert_same(&format!("keys {what}"), &gpu.read(&gpu_sorted_keys).unwrap(), &sorted_keys);
        assert_same(
            &format!("values {what}"),
            &gpu.read(&gpu_sorted_values).unwrap(),
            &sorted_values,
        );
    }
}
