//! Properties for arbitrary input: sort and scan, and configurations that are written and read back.

use nightsplat::splats::sort::{Count, RadixSort, Scan};
use proptest::prelude::*;

use crate::common::arbitrary::cases;
use crate::common::prelude::*;

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn keys_are_sorted_stably_and_counts_summed_up_whatever_their_number(
        keys in prop::collection::vec(any::<u32>(), 0..3000), bits in 0..33_u32, left_out in 0..50_usize,
    ) {
        let gpu = gpu();
        let count = keys.len().saturating_sub(left_out);
        let counts = gpu.buffer("counts", &[count as u32]).unwrap();
        let counted = Count { counts: &counts, index: 0 };
        let (mut sort, mut scan) = (RadixSort::new(&gpu, 0).unwrap(), Scan::new(&gpu, 0).unwrap());
        let mut values = gpu.buffer("values", &(0..keys.len() as u32).collect::<Vec<_>>()).unwrap();
        let mut sorted = gpu.buffer("keys", &keys).unwrap();
        let small: Vec<u32> = keys.iter().map(|key| key % 1000).collect();
        let summed = gpu.buffer("summed", &small).unwrap();
        let mut offsets = gpu.uninit("offsets", keys.len()).unwrap();
        let mut total = gpu.uninit("total", 1).unwrap();
        gpu.run("sort", |pass| {
            sort.record(pass, counted, &mut sorted, &mut values, bits)?;
            scan.record(pass, counted, &summed, &mut offsets, &mut total)
        }).unwrap();
        let mask = if bits == 0 { 0 } else { u32::MAX >> (32 - bits) };
        let mut order: Vec<u32> = (0..count as u32).collect();
        order.sort_by_key(|&index| keys[index as usize] & mask);
        prop_assert_eq!(&gpu.read(&values).unwrap()[..count], &order[..]);
        let sums: Vec<u32> = small[..count].iter().scan(0, |sum, value| {
            *sum += value;
            Some(*sum - value)
        }).collect();
        prop_assert_eq!(&gpu.read(&offsets).unwrap()[..count], &sums[..]);
        prop_assert_eq!(gpu.read(&total).unwrap(), [small[..count].iter().sum::<u32>()]);
    }

    #[test]
    fn a_configuration_is_read_back_from_its_toml(
        steps in 1..u64::from(u32::MAX), seed in 0..i64::MAX as u64, near in 1e-6..1.0_f64, rate in 0.0..1.0_f64,
        max_gaussians in 1..1_000_000_000_usize, vram in 1..1_u64 << 50,
    ) {
        let mut config = TrainConfig { steps, seed, near, max_gaussians, ..TrainConfig::bare() };
        config.max_vram = vram.to_string().parse().ok();
        config.density.min_opacity = 0.99 * rate;
        config.schedule.initial_rates.0[1] = rate;
        let text = config.to_toml().unwrap();
        prop_assert_eq!(TrainConfig::from_toml(&text).unwrap(), config);
    }
}
