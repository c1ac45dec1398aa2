//! From Gaussians to each tile's list of splats.

use glam::UVec2;

use super::constants;
use crate::cli::bench::check::Rule::{Close, Exact};
use crate::cli::bench::check::check;
use crate::cli::bench::scene::Scene;
use crate::cli::bench::{Bench, Timing};
use crate::gpu::Threads;
use crate::kernels::*;
use crate::render::RenderSettings;

/// What the passes before the blending leave.
pub(super) struct Frame {
    pub(super) camera: project::Params,
    pub(super) tile_columns: u32,
    pub(super) tile_count: u32,
    pub(super) splats: Vec<ProjectedSplat>,
    pub(super) colors: Vec<f32>,
    pub(super) tile_counts: Vec<u32>,
    pub(super) sorted_ids: Vec<u32>,
    pub(super) ordered_counts: Vec<u32>,
    pub(super) offsets: Vec<u32>,
    pub(super) counts: Vec<u32>,
    pub(super) sorted_slots: Vec<u32>,
    pub(super) owners: Vec<u32>,
    pub(super) tile_ranges: Vec<UVec2>,
}

/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn project_and_bin(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    scene: &Scene,
) -> anyhow::Result<Frame> {
    let settings = RenderSettings::default();
    let (near, [tile_width, tile_height]) = (settings.near, settings.tile_on(&bench.gpu));
    let Scene { camera, gaussians, .. } = scene;
    let (size, n) = (UVec2::new(camera.width, camera.height), gaussians.count);
    let gaussian_count = n as u32;
    let per_gaussian = Threads::Exactly([gaussian_count, 1, 1]);
    let (tile_columns, tile_rows) = (size.x.div_ceil(tile_width), size.y.div_ceil(tile_height));
    let tile_count = tile_columns * tile_rows;
    let parameters = &gaussians.parameters;
    let (splats, colors) = (vec![ProjectedSplat::default(); n], vec![0.0_f32; 3 * n]);
    let [depth_keys, ids, tile_counts] = [0; 3].map(|_| vec![0_u32; n]);
    let camera = project::Params {
        camera: camera.into(),
        near,
        gaussian_count,
        sh_degree: gaussians.shape.sh_degree,
    };
    let (splats, colors, depth_keys, _, tile_counts) = check!(
        bench,
        timings,
        project,
        constants!(bench, project, sh_degree: gaussians.shape.sh_degree, raw_colors: false),
        camera,
        per_gaussian,
        [parameters],
        [
            splats: Close(1e-4), colors: Close(1e-4), depth_keys: Close(1e-5), ids: Exact,
            tile_counts: Close(0.0)
        ]
    );
    let sorted_ids = stably_sorted(&depth_keys);
    let ordered_counts = vec![0_u32; n];
    let (ordered_counts,) = check!(
        bench,
        timings,
        order_counts,
        order_counts::Constants::default(),
        order_counts::Params { gaussian_count },
        per_gaussian,
        [sorted_ids, tile_counts],
        [ordered_counts: Exact]
    );
    let (offsets, total) = scan(bench, timings, &ordered_counts)?;
    let capacity = total[0];
    let (counts, status) = (vec![0_u32], vec![0_u32; 2]);
    let (counts, _) = check!(
        bench,
        timings,
        check_capacity,
        check_capacity::Constants::default(),
        check_capacity::Params { capacity },
        Threads::Exactly([1, 1, 1]),
        [total],
        [counts: Exact, status: Exact]
    );
    let [tiles, slots, owners] = [0; 3].map(|_| vec![0_u32; capacity as usize]);
    let (tiles, _, owners) = check!(
        bench,
        timings,
        emit,
        constants!(bench, emit),
        emit::Params { size, gaussian_count, tile_columns },
        per_gaussian,
        [counts, sorted_ids, ordered_counts, offsets, splats],
        [tiles: Close(0.0), slots: Exact, owners: Exact]
    );
    sort(bench, timings, &tiles)?;
    let sorted_slots = stably_sorted(&tiles);
    let sorted_tiles: Vec<u32> = sorted_slots.iter().map(|&slot| tiles[slot as usize]).collect();
    let tile_ranges = vec![UVec2::ZERO; tile_count as usize];
    let (tile_ranges,) = check!(
        bench,
        timings,
        tile_ranges,
        tile_ranges::Constants::default(),
        tile_ranges::Params { tile_count },
        Threads::Exactly([capacity, 1, 1]),
        [counts, sorted_tiles],
        [tile_ranges: Exact]
    );
    Ok(Frame {
        camera,
        tile_columns,
        tile_count,
        splats,
        colors,
        tile_counts,
        sorted_ids,
        ordered_counts,
        offsets,
        counts,
        sorted_slots,
        owners,
        tile_ranges,
    })
}

/// The indices in the order of their keys, equal ones as they were.
fn stably_sorted(keys: &[u32]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..keys.len() as u32).collect();
    order.sort_by_key(|&i| keys[i as usize]);
    order
}

fn scan(
    bench: &Bench,
    timings: &mut Vec<Timing>,
    values: &[u32],
) -> anyhow::Result<(Vec<u32>, Vec<u32>)> {
    let constants = scan_upsweep::Constants::default();
    let partition_size = constants.partition_size;
    let capacity = values.len() as u32;
    let counts = vec![capacity];
    let partitions = capacity.div_ceil(partition_size);
    let sums = vec![0_u32; partitions as usize];
    let (sums,) = check!(
        bench,
        timings,
        scan_upsweep,
        constants,
        scan_upsweep::Params { count_index: 0, capacity },
        Threads::Workgroups([partitions, 1, 1]),
        [counts, values],
        [sums: Exact]
    );
    let total = vec![0_u32];
    let (sums, total) = check!(
        bench,
        timings,
        scan_spine,
        scan_spine::Constants { partition_size },
        scan_spine::Params { count_index: 0, capacity },
        Threads::Workgroups([1, 1, 1]),
        [counts],
        [sums: Exact, total: Exact]
    );
    let offsets = vec![0_u32; values.len()];
    let (offsets,) = check!(
        bench,
        timings,
        scan_downsweep,
        scan_downsweep::Constants { partition_size },
        scan_downsweep::Params { count_index: 0, capacity },
        Threads::Workgroups([partitions, 1, 1]),
        [counts, values, sums],
        [offsets: Exact]
    );
    Ok((offsets, total))
}

/// One digit of the sort of the intersections by tile.
fn sort(bench: &Bench, timings: &mut Vec<Timing>, keys: &[u32]) -> anyhow::Result<()> {
    const DIGIT_BITS: u32 = 5;
    let constants = sort_upsweep::Constants::default();
    let partition_size = constants.partition_size;
    let (capacity, count_index, shift, digit_bits) = (keys.len() as u32, 0, 0, DIGIT_BITS);
    let counts = vec![capacity];
    let partitions = capacity.div_ceil(partition_size);
    let per_partition = Threads::Workgroups([partitions, 1, 1]);
    let arguments = vec![[0_u32; 3]];
    check!(
        bench,
        timings,
        dispatch_arguments,
        dispatch_arguments::Constants::default(),
        dispatch_arguments::Params { items_per_workgroup: partition_size, count_index, capacity },
        Threads::Workgroups([1, 1, 1]),
        [counts],
        [arguments: Exact]
    );
    let table = vec![0_u32; (partitions << DIGIT_BITS) as usize];
    let (table,) = check!(
        bench,
        timings,
        sort_upsweep,
        constants,
        sort_upsweep::Params { count_index, capacity, shift, digit_bits },
        per_partition,
        [counts, keys],
        [table: Exact]
    );
    let digit_totals = vec![0_u32; 1 << DIGIT_BITS];
    let (table, digit_totals) = check!(
        bench,
        timings,
        sort_spine,
        sort_spine::Constants { partition_size },
        sort_spine::Params { count_index, capacity },
        Threads::Workgroups([1 << DIGIT_BITS, 1, 1]),
        [counts],
        [table: Exact, digit_totals: Exact]
    );
    let values: Vec<u32> = (0..capacity).collect();
    let [sorted_keys, sorted_values] = [0; 2].map(|_| vec![0_u32; keys.len()]);
    let rank_by_ballot = bench.gpu.properties().subgroup_size > 8;
    check!(
        bench,
        timings,
        sort_downsweep,
        sort_downsweep::Constants { partition_size, rank_by_ballot },
        sort_downsweep::Params { count_index, capacity, shift, digit_bits },
        per_partition,
        [counts, table, digit_totals, keys, values],
        [sorted_keys: Exact, sorted_values: Exact]
    );
    Ok(())
}
