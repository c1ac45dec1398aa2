//! The renderer's passes at their limits: counts that wrap around, slots without a tile, Gaussians that cover
//! everything, many Gaussians on one pixel, and unsuitable tiles.

use std::array;
use std::collections::HashSet;

use nightsplat::gpu::Tile;
use nightsplat::kernels::no_tile::NO_TILE;
use nightsplat::kernels::status::STATUS_TILE_LIMIT;
use nightsplat::kernels::{self, ProjectedSplat, emit, order_counts, project_backward};
use nightsplat::splats::render::Status;
use nightsplat_core::camera::Patch;

use crate::blending::tile_runs;
use crate::common::not_run;
use crate::common::prelude::*;
use crate::common::setup::{features, tile_of};

/// The total and the status after `order_counts` for this much memory.
fn counted(
    tile_counts: Vec<u32>,
    capacity: u32,
    truncates: u32,
    before: [u32; 2],
) -> (u32, Vec<u32>) {
    let constants = order_counts::Constants { partition_size: 2 };
    let gaussian_count = tile_counts.len() as u32;
    let sorted_ids: Vec<u32> = (0..gaussian_count).rev().collect();
    let (intersection_offsets, sums, arrivals) = (vec![7; 5], vec![7; 3], vec![0]);
    let (counts, status) = (vec![7], vec![before[0], before[1], 0, 9]);
    let (_, _, counts, status, arrivals) = run_kernel!(
        order_counts,
        constants,
        order_counts::Params { gaussian_count, capacity, truncates },
        Threads::Workgroups([3, 1, 1]),
        [sorted_ids, tile_counts],
        [intersection_offsets, sums, counts, status, arrivals]
    );
    assert_eq!(arrivals, [0]);
    (counts[0], status)
}

#[test]
fn more_intersections_than_can_be_counted_are_an_overflow() {
    // The last sum wraps around.
    for (tile_counts, before, flag) in [
        (vec![], [0, 9], 0),
        (vec![2, 3], [0, 9], 0),
        (vec![6], [2, 1], 1),
        (vec![u32::MAX], [0, 0], 1),
        (vec![1 << 31, 0, 1 << 31, 3], [0, 0], 1),
    ] {
        let total: u64 = tile_counts.iter().map(|&count| u64::from(count)).sum();
        let total = u32::try_from(total).unwrap_or(u32::MAX);
        let (count, after) = counted(tile_counts, 5, 0, before);
        assert_eq!(count, if flag == 0 { total } else { 0 });
        let flags = before[0] | flag;
        assert_eq!(after, [flags, before[1].max(total), 0, flags]);
    }
}

#[test]
fn what_exceeds_the_memory_is_left_out_without_a_flag() {
    for (capacity, kept) in [(5, 5), (9, 9), (12, 9)] {
        assert_eq!(counted(vec![4, 3, 2], capacity, 1, [0, 1]), (kept, vec![0, 9, 0, 0]));
    }
    // Where the sum wraps around, so do the offsets.
    let (kept, status) = counted(vec![1 << 31, 1 << 31, 3], 5, 1, [0, 1]);
    assert_eq!((kept, status[1]), (0, u32::MAX));
}

/// What `emit` writes for three Gaussians in a view of four tiles, intersections, Gaussians, ranges.
fn emitted(count: u32, tile_counts: Vec<u32>) -> (Vec<u32>, Vec<u32>, Vec<u32>, Vec<UVec2>) {
    let setup = Setup::new(3, [32, 32], 0, 1);
    let splats = gpu().read(&setup.render().renderer.frame().splats).unwrap();
    let (counts, sorted_ids) = (vec![count], vec![0, 1, 2]);
    let (sums, intersection_offsets) = (vec![0], vec![0, 4, 8]);
    let [tiles, intersection_ids, gaussian_ids] = [0; 3].map(|_| vec![7u32; 16]);
    let (intersection_ranges, tile_sizes) = (vec![UVec2::splat(7); 3], vec![0; 1]);
    let (tiles, intersection_ids, gaussian_ids, intersection_ranges, _) = run_kernel!(
        emit,
        emit::Constants { partition_size: 256, ..Default::default() },
        emit::Params { size: UVec2::new(32, 32), gaussian_count: 3, tile_columns: 2 },
        Threads::Exactly([3, 1, 1]),
        [counts, sorted_ids, intersection_offsets, sums, splats, tile_counts],
        [tiles, intersection_ids, gaussian_ids, intersection_ranges, tile_sizes]
    );
    (tiles, intersection_ids, gaussian_ids, intersection_ranges)
}

#[test]
fn the_gaussian_across_the_end_of_the_memory_covers_no_tile() {
    let (tiles, ids, _, ranges) = emitted(6, vec![4, 4, 4]);
    assert!(tiles[4..6].iter().all(|&tile| tile == u32::MAX), "{tiles:?}");
    assert_eq!(ids[..6], [0, 1, 2, 3, 4, 5]);
    assert!(ids[6..].iter().chain(&tiles[6..]).all(|&slot| slot == 7));
    assert!(ranges[1].x == ranges[1].y && ranges[2].x == ranges[2].y, "{ranges:?}");
}

#[test]
fn memory_for_intersections_grows_to_the_largest_binding_and_no_further() {
    let mut renderer = Setup::new(1, [32, 32], 0, 1).render().renderer;
    let most = renderer.max_intersections();
    // If a device binds gigabytes, allocating them makes no sense in a test.
    if most > 1 << 23 {
        return not_run("lavapipe", format_args!("this device binds {most} intersections at once"));
    }
    renderer.grow(most - most / 4).unwrap();
    renderer.grow(most).unwrap();
    let message = renderer.grow(most + 1).unwrap_err().to_string();
    assert!(message.contains("gradient_records"), "{message}");
}

#[test]
fn a_count_that_wrapped_around_writes_no_slot_beyond_the_count() {
    // As if the offsets of later ranks had exceeded the total.
    let (tiles, ids, gaussians, ranges) = emitted(2, vec![4, 4, u32::MAX - 5]);
    let untouched = |slots: &[u32]| slots[2..].iter().all(|&slot| slot == 7);
    assert!(untouched(&tiles) && untouched(&ids) && untouched(&gaussians));
    assert!(ranges.iter().all(|range| range.x == range.y));
}

/// Splats that cover an image entirely, with `extra` slots more reserved than they need, and the output of `emit`.
fn emit_wide(count: u32, size: UVec2, extra: u32) -> (Vec<u32>, Vec<UVec2>, u32) {
    let constants = emit::Constants { partition_size: 256, ..Default::default() };
    let tile = UVec2::new(constants.tile_width, constants.tile_height);
    let tiles = (size + tile - 1) / tile;
    let splat = ProjectedSplat {
        mean2d: size.as_vec2() / 2.0,
        conic: Vec3::new(1e-9, 0.0, 1e-9),
        opacity: 0.5,
        half_extent: Vec2::splat(1e5),
    };
    let per_splat = tiles.element_product() + extra;
    let (splats, sorted_ids) = (vec![splat; count as usize], (0..count).rev().collect::<Vec<_>>());
    let (counts, sums) = (vec![count * per_splat], vec![0; 1 + count as usize / 256]);
    let tile_counts = vec![per_splat; count as usize];
    let intersection_offsets: Vec<u32> = (0..count).map(|rank| rank * per_splat).collect();
    let [tiles_, intersection_ids, gaussian_ids] = [0; 3].map(|_| vec![7u32; counts[0] as usize]);
    let (tiles, intersection_ranges) = (tiles_, vec![UVec2::ZERO; count as usize]);
    let tile_sizes = vec![0; 1];
    let (tiles, _, _, intersection_ranges, _) = run_kernel!(
        emit,
        constants,
        emit::Params { size, gaussian_count: count, tile_columns: size.x.div_ceil(tile.x) },
        Threads::Exactly([count, 1, 1]),
        [counts, sorted_ids, intersection_offsets, sums, splats, tile_counts],
        [tiles, intersection_ids, gaussian_ids, intersection_ranges, tile_sizes]
    );
    (tiles, intersection_ranges, per_splat)
}

/// A record of four channels.
type Record = [f32; 12];

/// Sums the records of Gaussians with one feature, all at one position, which have these slots: the gradients of the
/// features are the sums of the last channel.
fn sums(intersection_ranges: Vec<UVec2>, gradient_records: &[Record]) -> Vec<f32> {
    let (count, shape) = (intersection_ranges.len(), Shape { sh_degree: 3, features: features(4) });
    let mut setup = Setup::new(count, [32, 32], shape, 1);
    for i in 0..count {
        setup.set(i, &Gaussian { mean: setup.at_pixel(DVec2::splat(16.0), 2.0), ..setup.get(0) });
    }
    let rendered = setup.render();
    let frame = rendered.renderer.frame();
    let (splats, colors) = (gpu().read(&frame.splats).unwrap(), gpu().read(&frame.colors).unwrap());
    let (parameters, tile_counts, status) = (setup.parameters.clone(), vec![1; count], vec![0; 4]);
    let gradient_records: Vec<f32> = gradient_records.concat();
    let gradients = vec![f32::NAN; parameters.len()];
    let (grad_norm_sums, visit_counts) = (vec![0.0f32; count], vec![0; count]);
    let cameras = vec![kernels::Camera::from(&Patch::from(&setup.camera))];
    let lamp = vec![0.0f32; 1];
    let (_, gradients, _, _) = run_kernel!(
        project_backward,
        project_backward::Constants { channels: 4, ..Default::default() },
        project_backward::Params {
            camera_index: 0,
            half_view: Vec2::splat(16.0),
            gaussian_count: count as u32,
            sh_degree: 3,
            adds_pixels: 0,
            damping_weight: 0.0,
            damping_depth: 1.0,
        },
        Threads::Exactly([count as u32, 1, 1]),
        [
            parameters,
            splats,
            colors,
            tile_counts,
            intersection_ranges,
            gradient_records,
            cameras,
            lamp
        ],
        [status, gradients, grad_norm_sums, visit_counts]
    );
    (0..count).map(|i| setup.planes().load(&gradients, i).features[0] as f32).collect()
}

#[test]
fn gaussians_that_cover_the_whole_of_a_large_image_fill_their_slots_and_are_summed() {
    // More tiles than the loop limit of some devices, for every lane of a subgroup.
    let size = UVec2::new(4096, 2176);
    let (tiles, intersection_ranges, per_splat) = emit_wide(9, size, 0);
    assert!(per_splat > 32_000 && tiles.len() == 9 * per_splat as usize);
    assert!(tiles.chunks(per_splat as usize).all(|chunk| (0..per_splat).eq(chunk.iter().copied())));
    let mut random = Random::new(3);
    let mut number = || random.between(-1.0, 1.0) as f32;
    let mut record = || array::from_fn(|_| number());
    let gradient_records: Vec<Record> = tiles.iter().map(|_| record()).collect();
    sums(intersection_ranges, &gradient_records);
}

#[test]
fn slots_that_no_tile_fills_are_padding_and_do_not_change_the_sums() {
    // Few slots, which one lane processes alone, and many, which all lanes share.
    for size in [UVec2::new(40, 20), UVec2::new(400, 200)] {
        let (tiles, intersection_ranges, per_splat) = emit_wide(11, size, 5);
        let is_padding = |slot: usize| slot as u32 % per_splat >= per_splat - 5;
        assert!((0..tiles.len()).all(|slot| (tiles[slot] == NO_TILE) == is_padding(slot)));
        // No tile writes the records of padding.
        let record = |slot: usize| [if is_padding(slot) { f32::NAN } else { 1.0 }; 12];
        let gradient_records: Vec<Record> = (0..tiles.len()).map(record).collect();
        assert_eq!(sums(intersection_ranges, &gradient_records), [(per_splat - 5) as f32; 11]);
    }
}

#[test]
fn a_view_has_at_most_the_tiles_that_a_subgroup_of_covering_gaussians_can_process() {
    let most = gpu().properties().max_loop_iterations;
    if most == u32::MAX {
        return not_run("lavapipe", "this device has no loop limit");
    }
    // Of the tile of a CPU.
    let cpu = gpu_with(|properties| properties.is_cpu = true);
    let mut renderer = Renderer::new(&cpu, Setup::new(1, [32, 32], 0, 1).settings).unwrap();
    let view = |size| Setup::new(1, size, 0, 1).camera;
    renderer.reserve(1, [&view([8192, 16])]).unwrap();
    renderer.reserve(1, [&view([3840, 2160])]).unwrap();
    // The host's renders are assembled from patches; no single pass accepts such a view.
    renderer.reserve(1, [&view([8192, 8192])]).unwrap();
    let refused = renderer.reserve_sizes(1, 1, [UVec2::splat(8192)]).unwrap_err();
    let message = refused.to_string();
    assert!(message.starts_with("a 8192x8192 view has 524288 tiles of 16x8 pixels"), "{message}");
    assert!(!message.contains('\n'), "{message}");

    // The tile grows with the view unless a size is given.
    let tile_for = |tile: Option<Tile>| {
        let settings = RenderSettings { tile, ..RenderSettings::default() };
        settings.tile_for(&cpu, [[8192, 4096]].into_iter()).unwrap()
    };
    let named = Tile::from([16, 8]);
    assert_eq!(tile_for(Some(named)), named);
    assert!(tile_for(None).size[1] > 8, "{:?}", tile_for(None));

    let lanes = gpu().properties().subgroup_size;
    let tiles = most - 64 - 2 * lanes;
    let intersection_ids = (tiles * lanes) as usize;
    let intersection_ranges: Vec<_> = (0..lanes).map(|i| UVec2::new(i, i + 1) * tiles).collect();
    assert_eq!(
        sums(intersection_ranges, &vec![[1.0; 12]; intersection_ids]),
        vec![tiles as f32; lanes as usize]
    );
}

/// The longest side that a refusal names fits, and is not much less than the maximum.
#[test]
fn a_refused_view_names_a_longest_side_that_fits() {
    let gpu = gpu();
    let settings = RenderSettings::default();
    for size in [[1 << 16, 1 << 15], [1 << 15, 1 << 17], [1 << 18, 1 << 18]] {
        let refused = settings.check_size(&gpu, "night.png", size).unwrap_err().to_string();
        let view = format!("view night.png is {}x{}: it", size[0], size[1]);
        assert!(refused.starts_with(&view), "{refused}");
        let longest: f64 = refused.rsplit(' ').next().unwrap().parse().unwrap();
        let shrunk = |longest: f64| {
            let share = longest / f64::from(size[0].max(size[1]));
            size.map(|side| (f64::from(side) * share).round() as u32)
        };
        settings.check_size(&gpu, "", shrunk(longest)).unwrap();
        assert!(settings.check_size(&gpu, "", shrunk(1.05 * longest)).is_err(), "{refused}");
    }
}

/// `count` faint splats on one pixel, at increasing depths.
fn splats_per_tile(count: usize) -> Setup {
    let mut setup = Setup::new(count, [16, 8], 0, 5);
    let size = setup.camera().size;
    for i in 0..count {
        let depth = 1.0 + 4.0 * i as f64 / count as f64;
        let gaussian = Gaussian {
            mean: setup.at_pixel((size / 2.0).floor() + 0.5, depth),
            log_scale: DVec3::splat((0.1 * depth / setup.camera().focal.x).ln()),
            raw_opacity: -4.5,
            ..setup.get(i)
        };
        setup.set(i, &gaussian);
    }
    setup
}

#[test]
fn a_hundred_thousand_splats_on_one_pixel_are_blended_as_in_the_references() {
    let mut setup = splats_per_tile(100_000);
    // If four subgroups share a tile, each also iterates over its parts.
    let shared = tile_of(([16, 16], 4));
    for tile in [None, Some(shared).filter(|&tile| gpu().properties().suits_tile(tile))] {
        setup.settings.tile = tile;
        let (_, report) = gpu().checked(|| {
            let mut rendered = setup.render();
            rendered.backward(&vec![1.0; 3 * setup.pixels()])
        });
        report.agree().unwrap();
        let passed: HashSet<_> = report.passes.iter().map(|pass| pass.kernel).collect();
        for kernel in ["emit", "blend_forward", "blend_backward", "project_backward"] {
            assert!(passed.contains(kernel), "{kernel} of {tile:?}");
        }
    }
}

#[test]
fn more_splats_on_a_tile_than_the_device_can_process_are_a_clear_error() {
    let (ranges, status) = tile_runs(vec![0, 0, 0, 0, 2, 2, 2], 3);
    assert_eq!(ranges[..3], [UVec2::ZERO, UVec2::splat(4), UVec2::new(4, 7)]);
    assert_eq!(status, [STATUS_TILE_LIMIT, 0, 4]);
    assert_eq!(Status::from_words(&status).splats_per_tile, 4);
    if gpu().properties().max_loop_iterations == u32::MAX {
        return;
    }
    let setup = splats_per_tile(300_000);
    let cpu = gpu_with(|properties| properties.is_cpu = true);
    let gaussians = setup.gaussians().upload(&cpu).unwrap();
    let mut renderer = Renderer::new(&cpu, setup.settings).unwrap();
    renderer.reserve(setup.count, [&setup.camera]).unwrap();
    let refused = renderer.render_image(&gaussians, &setup.camera, &setup.options);
    let message = refused.unwrap_err().to_string();
    assert!(message.starts_with("a 16x8 render: 300000 splats on one tile of 16x8"), "{message}");
    assert!(!message.contains('\n'), "{message}");
}

#[test]
fn a_tile_that_does_not_suit_the_device_is_refused_in_one_line_and_other_tiles_render() {
    let lanes = gpu().properties().subgroup_size;
    let mut setup = Setup::new(5, [50, 40], 1, 5);
    for tile in [[0, 8], [1, 1], [lanes + 1, 1], [lanes, 33], [64 * lanes, 1], [1 << 20, 1 << 20]] {
        setup.settings.tile = Some(tile.into());
        let message = Renderer::new(&gpu(), setup.settings).unwrap_err().to_string();
        let [width, height] = tile;
        assert!(message.starts_with(&format!("{width}x{height} tiles do not suit")), "{message}");
        assert!(message.contains("take a tile") && !message.contains('\n'), "{message}");
    }
    for subgroups in [0, 3, 8] {
        setup.settings.tile = Some(tile_of(([lanes, 24], subgroups)));
        let message = Renderer::new(&gpu(), setup.settings).unwrap_err().to_string();
        assert!(message.contains("1, 2 or 4 subgroups") && !message.contains('\n'), "{message}");
    }
    for tile in [[lanes, 1], [1, lanes], [lanes, 32]] {
        setup.settings.tile = Some(tile.into());
        setup.render();
    }
}

/// With fewer lanes each has the state of more pixels.
#[test]
fn narrow_subgroups_of_a_gpu_share_a_tile_where_they_stay_converged() {
    let tile = |lanes, stays_converged, channels| {
        let gpu = gpu_with(|properties| {
            properties.is_cpu = false;
            properties.subgroup_size = lanes;
            properties.has_uniform_subgroup_control_flow = stays_converged;
        });
        let shape = Shape { sh_degree: 0, features: features(channels) };
        RenderSettings { shape, ..RenderSettings::default() }.tile_on(&gpu).unwrap()
    };
    assert_eq!(tile(8, true, 3), tile_of(([16, 16], 4)));
    assert_eq!(tile(8, true, 11), tile_of(([16, 8], 4)));
    assert_eq!(tile(8, false, 3), Tile::from([8, 8]));
    assert_eq!(tile(8, false, 11), Tile::from([8, 4]));
    assert_eq!(tile(32, false, 11), Tile::from([16, 16]));
}
