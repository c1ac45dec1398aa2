//! Scan and radix sort: each kernel against its reference, the whole against the standard library.

use nightsplat::gpu::Buffer;
use nightsplat::kernels::digit::MAX_DIGITS;
use nightsplat::kernels::no_tile::NO_TILE;
use nightsplat::kernels::{scan_downsweep, scan_upsweep, sort_downsweep, sort_upsweep};
use nightsplat::splats::sort::{Count, RadixSort, Scan, TileSort, UnsortedTiles};

use crate::common::prelude::*;

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

/// The pairs (keys[i], i) for i below `count`, as sorted by [`RadixSort`].
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
fn sorts_of_all_sizes_are_correct_and_stable() {
    for is_cpu in [true, false] {
        let gpu = gpu_with(|properties| properties.is_cpu = is_cpu);
        let mut sort = RadixSort::new(&gpu, 0).unwrap();
        for size in SIZES {
            let keys = noise(size);
            for bits in [10, 32] {
                assert_sorts(&gpu, &mut sort, "noise", &keys, size, bits);
            }
        }
    }
}

#[test]
fn a_sort_by_any_number_of_bits_uses_only_those_bits() {
    for is_cpu in [true, false] {
        let gpu = gpu_with(|properties| properties.is_cpu = is_cpu);
        let mut sort = RadixSort::new(&gpu, 9000).unwrap();
        let keys = noise(9000);
        for bits in [0, 1, 7, 8, 9, 13, 16, 17, 24, 31] {
            assert_sorts(&gpu, &mut sort, "noise", &keys, 9000, bits);
        }
    }
}

#[test]
fn equal_and_extreme_keys_keep_their_order() {
    for is_cpu in [true, false] {
        let gpu = gpu_with(|properties| properties.is_cpu = is_cpu);
        let mut sort = RadixSort::new(&gpu, 5000).unwrap();
        for key in [0, 1, 0x0102_0408, u32::MAX] {
            assert_sorts(&gpu, &mut sort, "equal keys", &[key; 5000], 5000, 32);
        }
        let extremes: Vec<u32> = noise(5000).iter().map(|n| 0_u32.wrapping_sub(n & 1)).collect();
        assert_sorts(&gpu, &mut sort, "0 and the maximum", &extremes, 5000, 32);
        let descending: Vec<u32> = (0..5000).rev().collect();
        assert_sorts(&gpu, &mut sort, "descending", &descending, 5000, 32);
    }
}

#[test]
fn a_sort_reads_its_count_on_the_device_and_stays_within_the_buffers() {
    for is_cpu in [true, false] {
        let gpu = gpu_with(|properties| properties.is_cpu = is_cpu);
        let mut sort = RadixSort::new(&gpu, 9000).unwrap();
        let keys = noise(9000);
        // A larger count after a smaller one meets the tables that the smaller one left.
        for count in [0, 1, 1023, 2049, 8191, 8193, 3, 8999, 9000, 9001, u32::MAX] {
            assert_sorts(&gpu, &mut sort, "count", &keys, count, 32);
        }
    }
}

#[test]
fn two_sorts_in_one_recording_are_independent() {
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
fn scans_of_all_sizes_are_correct_and_do_not_change_the_rest() {
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
fn a_count_beyond_the_buffers_scans_whole_buffers() {
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
fn more_workgroups_than_fit_along_x_are_folded() {
    // Two values in a partition need 70 001 workgroups, in two rows; the last row is partly idle.
    compare_scan_kernels(140_001, 2);
}

#[test]
fn scan_kernels_match_their_references() {
    for size in SIZES {
        compare_scan_kernels(size, PARTITION);
    }
}

fn compare_scan_kernels(size: u32, partition_size: u32) {
    let partitions = size.div_ceil(partition_size).max(1);
    // One workgroup more than there are partitions: it must not change anything.
    let groups = Threads::Workgroups([partitions + 1, 1, 1]);
    // A count beyond the capacity is clamped to it.
    let (counts, values, capacity) = (vec![size + 5], noise(size), size);
    let (sums, total) = (vec![9; partitions as usize + 1], vec![7]);
    let arrivals = vec![0];
    let (sums, total, arrivals) = run_kernel!(
        scan_upsweep,
        scan_upsweep::Constants { partition_size },
        scan_upsweep::Params { count_index: 0, capacity },
        groups,
        [counts, values],
        [sums, total, arrivals]
    );
    assert_eq!((sums[0], sums[partitions as usize], &arrivals[..]), (0, 9, &[0][..]));
    assert_eq!(total, [values.iter().fold(0u32, |sum, &value| sum.wrapping_add(value))]);
    let offsets = vec![7; values.len() + PARTITION as usize];
    run_kernel!(
        scan_downsweep,
        scan_downsweep::Constants { partition_size },
        scan_downsweep::Params { count_index: 0, capacity },
        groups,
        [counts, values, sums],
        [offsets]
    );
}

#[test]
fn sort_kernels_match_their_references() {
    for (rank_by_ballot, subgroups) in [(false, 1), (true, 1), (true, 8), (false, 3)] {
        let lanes = gpu().properties().subgroup_size;
        if (rank_by_ballot || lanes <= 32) && lanes * subgroups <= 256 {
            compare_sort_kernels(rank_by_ballot, subgroups);
        }
    }
}

fn compare_sort_kernels(rank_by_ballot: bool, subgroups: u32) {
    let counted = sort_upsweep::Constants { subgroups, ..Default::default() };
    let ranked = sort_downsweep::Constants { rank_by_ballot, subgroups, ..Default::default() };
    // A digit narrower than any subgroup and the last of its keys, and the widest before another.
    for (size, (shift, digit_bits, next_bits)) in
        SIZES.into_iter().flat_map(|s| [(s, (31, 1, 0)), (s, (5, 8, 6))])
    {
        let (capacity, count_index) = (size, 0);
        let workgroups = size.div_ceil(PARTITION).div_ceil(subgroups);
        let [own_table, next_table, cleared_table] = [0, 1, 2].map(|i| i * workgroups * MAX_DIGITS);
        // A count beyond the capacity is clamped to it.
        let (counts, keys) = (vec![size + 5], noise(size));
        let values: Vec<u32> = (0..size).map(|i| 3 * i).collect();
        let (table, arrivals) = (vec![9; (3 * workgroups * MAX_DIGITS) as usize], vec![0]);
        let digit_begins = vec![0; MAX_DIGITS as usize];
        // One workgroup more than there are partitions: it must not change anything.
        let threads = Threads::Workgroups([workgroups + 1, 1, 1]);
        let (table, digit_begins, arrivals) = run_kernel!(
            sort_upsweep,
            counted,
            sort_upsweep::Params { count_index, capacity, shift, digit_bits, next_table },
            threads,
            [counts, keys],
            [table, digit_begins, arrivals]
        );
        assert_eq!(arrivals, [0]);
        let (sorted_keys, sorted_values) = (vec![0; keys.len()], vec![0; keys.len()]);
        let (table, digit_begins, sorted_keys, sorted_values, arrivals) = run_kernel!(
            sort_downsweep,
            ranked,
            sort_downsweep::Params {
                count_index,
                capacity,
                shift,
                digit_bits,
                next_bits,
                own_table,
                next_table,
                cleared_table,
            },
            threads,
            [counts, keys, values],
            [table, digit_begins, sorted_keys, sorted_values, arrivals]
        );
        assert_eq!(arrivals, [0]);
        if next_bits == 0 || subgroups == 1 {
            continue;
        }
        let (shift, digit_bits, next_bits) = (shift + digit_bits, next_bits, 0);
        let (keys, values) = (sorted_keys, sorted_values);
        let (sorted_keys, sorted_values) = (vec![0; keys.len()], vec![0; keys.len()]);
        let (_, _, sorted_keys, _, _) = run_kernel!(
            sort_downsweep,
            ranked,
            sort_downsweep::Params {
                count_index,
                capacity,
                shift,
                digit_bits,
                next_bits,
                own_table: next_table,
                next_table: cleared_table,
                cleared_table: own_table,
            },
            threads,
            [counts, keys, values],
            [table, digit_begins, sorted_keys, sorted_values, arrivals]
        );
        assert!(sorted_keys.is_sorted_by_key(|key| key >> 5 & 0x3fff), "{size} keys");
    }
}

// ---------------------------------------------------------------------------
// Tiles

/// Intersections of tiles of these sizes, by slot in no order, and the depths of their Gaussians; `padding` slots
/// belong to no tile.
struct Intersections {
    tiles: Vec<u32>,
    places: Vec<u32>,
    gaussian_ids: Vec<u32>,
    depth_keys: Vec<u32>,
}

impl Intersections {
    /// `depths`: how many different ones there are.
    fn new(sizes: &[u32], padding: usize, depths: u32) -> Self {
        let tiles = (0..).zip(sizes).flat_map(|(tile, &size)| vec![tile; size as usize]);
        let mut tiles: Vec<u32> = tiles.chain(vec![NO_TILE; padding]).collect();
        let draws = noise(2 * tiles.len() as u32 + 1);
        for i in (1..tiles.len()).rev() {
            tiles.swap(i, draws[i] as usize % (i + 1));
        }
        // Arrival from the last slot to the first.
        let (mut arrived, mut places) = (vec![0; sizes.len()], vec![7; tiles.len()]);
        for slot in (0..tiles.len()).rev() {
            if let Some(arrived) = arrived.get_mut(tiles[slot] as usize) {
                places[slot] = *arrived;
                *arrived += 1;
            }
        }
        let gaussian_ids = (0..tiles.len() as u32).rev().collect();
        let depth_keys = draws[tiles.len()..].iter().map(|draw| draw % depths).collect();
        Self { tiles, places, gaussian_ids, depth_keys }
    }

    /// The slots of all tiles, each by depth and then by slot, with their tiles.
    fn sorted(&self) -> (Vec<u32>, Vec<u32>) {
        let mut slots: Vec<u32> = (0..self.tiles.len() as u32).collect();
        slots.retain(|&slot| self.tiles[slot as usize] != NO_TILE);
        let depth = |slot: u32| self.depth_keys[self.gaussian_ids[slot as usize] as usize];
        slots.sort_by_key(|&slot| (self.tiles[slot as usize], depth(slot), slot));
        let tiles = slots.iter().map(|&slot| self.tiles[slot as usize]).collect();
        (tiles, slots)
    }
}

/// Sorts on the device with every pass checked, and compares with the standard library.
fn assert_sorts_tiles(gpu: &Gpu, sort: &mut TileSort, what: &str, sizes: &[u32], depths: u32) {
    let given = Intersections::new(sizes, 5, depths);
    let counts = gpu.buffer("counts", &[given.tiles.len() as u32]).unwrap();
    let [gaussian_ids, depth_keys, mut tiles, mut intersection_ids] =
        [&given.gaussian_ids, &given.depth_keys, &given.tiles, &given.places]
            .map(|values| gpu.buffer("intersections", values).unwrap());
    sort.reserve_tiles(sizes.len()).unwrap();
    gpu.write(&mut sort.sizes, sizes).unwrap();
    let (done, report) = gpu.checked(|| {
        gpu.run("tiles", |pass| {
            let unsorted = UnsortedTiles {
                counts: &counts,
                gaussian_ids: &gaussian_ids,
                depth_keys: &depth_keys,
                tiles: &mut tiles,
                intersection_ids: &mut intersection_ids,
            };
            sort.record(pass, sizes.len() as u32, unsorted)
        })
    });
    done.unwrap();
    report.agree().unwrap();
    let kernels: Vec<_> = report.passes.iter().map(|pass| pass.kernel).collect();
    assert_eq!(kernels, ["tile_begins", "place_pairs", "sort_tiles"]);
    let what = format!("{what}, tiles of {sizes:?}");
    let (expected_tiles, expected_slots) = given.sorted();
    let (sorted_tiles, slots) = (gpu.read(&tiles).unwrap(), gpu.read(&intersection_ids).unwrap());
    let count = expected_tiles.len();
    assert_same(&what, &sorted_tiles[..count], &expected_tiles);
    assert_same(&what, &slots[..count], &expected_slots);
    assert!(sorted_tiles[count..].iter().all(|&tile| tile == NO_TILE), "{what}: padding");
    assert!(gpu.read(&sort.sizes).unwrap().iter().all(|&size| size == 0), "{what}: sizes");
}

#[test]
fn tiles_of_any_size_are_sorted_by_depth_and_then_by_slot() {
    let gpu = gpu();
    for (subgroups, capacity) in [(1, 64), (2, 64), (4, 256)] {
        let mut sort = TileSort::with_capacity(&gpu, subgroups, capacity).unwrap();
        let what = format!("{subgroups} subgroups, {capacity} pairs");
        let at_limits = [0, 1, 2, capacity - 1, capacity, capacity + 1, 3, 0];
        let beyond = [5, 2 * capacity, 2 * capacity + 1, 5 * capacity - 3, 8 * capacity];
        for depths in [u32::MAX, 3, 1] {
            assert_sorts_tiles(&gpu, &mut sort, &what, &at_limits, depths);
            assert_sorts_tiles(&gpu, &mut sort, &what, &beyond, depths);
        }
        let small: Vec<u32> = (0..70).collect();
        assert_sorts_tiles(&gpu, &mut sort, &what, &small, 40);
        assert_sorts_tiles(&gpu, &mut sort, &what, &[], 1);
    }
}
