//! The blending kernels by themselves: runs of tiles, the pixels of a part that a splat skips, and what devices differ
//! in. The references check every pass.

use std::f64::consts::TAU;

use glam::DMat2;
use nightsplat::gpu::Tile;
use nightsplat::kernels::blend_forward::{DEPTH_MEAN, DEPTH_MEDIAN, DEPTH_SUM};
use nightsplat::kernels::splat::ALPHA_MIN;
use nightsplat::kernels::{ProjectedSplat, blend_backward, blend_forward};
use nightsplat::reference::splat::{Splat, splat_level};

use crate::common::prelude::*;
use crate::common::setup::tile_of;

/// Tiles with their splats, front to back.
struct Tiles {
    tile: Tile,
    columns: u32,
    size: UVec2,
    channels: u32,
    sorted_tiles: Vec<u32>,
    splats: Vec<ProjectedSplat>,
    /// (splats, channels), filled up to vectors of four
    colors: Vec<f32>,
    longest_run: u32,
}

/// What the kernels differ in between devices.
#[derive(Clone, Copy, Debug)]
struct Device {
    skips_groups: bool,
    sums_in_shared_memory: u32,
}

const CPU: Device = Device { skips_groups: false, sums_in_shared_memory: 0 };
const GPUS: [Device; 2] = [
    Device { skips_groups: true, sums_in_shared_memory: 0 },
    Device { skips_groups: true, sums_in_shared_memory: 1 },
];

/// What the forward pass writes.
#[derive(PartialEq)]
struct Blended {
    render: Vec<f32>,
    transmittances: Vec<f32>,
    tile_ranges: Vec<UVec2>,
    status: Vec<u32>,
    segment_states: Vec<f32>,
}

impl Tiles {
    /// An image of as many tiles as `runs` has lengths, in columns of this number.
    fn new(tile: Tile, columns: u32, channels: u32, runs: &[usize]) -> Self {
        let rows = (runs.len() as u32).div_ceil(columns);
        let size = UVec2::new(columns, rows) * UVec2::from(tile.size);
        let sorted_tiles =
            (0..).zip(runs).flat_map(|(tile, &run)| std::iter::repeat_n(tile, run)).collect();
        let count = runs.iter().sum::<usize>();
        let colors = vec![0.0; count * channels.next_multiple_of(4) as usize];
        Self {
            tile,
            columns,
            size,
            channels,
            sorted_tiles,
            splats: vec![],
            colors,
            longest_run: u32::MAX,
        }
    }

    fn count(&self) -> usize {
        self.sorted_tiles.len()
    }

    fn tile_count(&self) -> u32 {
        self.columns * self.size.y.div_ceil(self.tile.size[1])
    }

    fn origin(&self, tile: u32) -> DVec2 {
        let at = UVec2::new(tile % self.columns, tile / self.columns);
        (at * UVec2::from(self.tile.size)).as_dvec2()
    }

    /// The slot of every intersection, and the Gaussian of every slot: the last is in front.
    fn slots(&self) -> (Vec<u32>, Vec<u32>) {
        let count = self.count() as u32;
        ((0..count).rev().collect(), (0..count).collect())
    }

    fn states(&self, segment: u32) -> usize {
        let [width, height] = self.tile.size;
        let blocks = (self.count() as u32).checked_div(segment).map_or(0, |blocks| blocks + 1);
        (blocks * (self.channels + 1) * width * height).max(1) as usize
    }

    fn forward_constants(&self, segment: u32, device: Device) -> blend_forward::Constants {
        blend_forward::Constants {
            channels: self.channels,
            tile_width: self.tile.size[0],
            tile_height: self.tile.size[1],
            subgroups_per_tile: self.tile.subgroups,
            segment,
            skips_groups: device.skips_groups,
            ..Default::default()
        }
    }

    fn forward(
        &self,
        constants: blend_forward::Constants,
        limits: &[f32],
        depth_kind: u32,
    ) -> Blended {
        let (splats, colors, sorted_tiles) = (&self.splats, &self.colors, &self.sorted_tiles);
        let (sorted_intersections, gaussian_ids) = self.slots();
        let pixels = self.size.element_product() as usize;
        let (render, transmittances) =
            (vec![f32::NAN; self.channels as usize * pixels], vec![f32::NAN; pixels]);
        let (counts, status) = (vec![self.count() as u32], vec![0; 3]);
        let tile_ranges = vec![UVec2::ONE; self.tile_count() as usize];
        // What no segment writes stays.
        let segment_states = vec![0.5; self.states(constants.segment)];
        let params = blend_forward::Params {
            size: self.size,
            tile_columns: self.columns,
            longest_run: self.longest_run,
            background: [0.25; 3],
            has_limits: u32::from(limits.len() > 1),
            depth_kind,
        };
        let (render, transmittances, tile_ranges, status, segment_states) = run_kernel!(
            blend_forward,
            constants,
            params,
            Threads::Workgroups([self.tile_count(), 1, 1]),
            [counts, sorted_intersections, gaussian_ids, splats, colors, sorted_tiles, limits],
            [render, transmittances, tile_ranges, status, segment_states]
        );
        Blended { render, transmittances, tile_ranges, status, segment_states }
    }

    fn backward(&self, blended: &Blended, segment: u32, device: Device) -> Vec<f32> {
        let (splats, colors, sorted_tiles) = (&self.splats, &self.colors, &self.sorted_tiles);
        let (sorted_intersections, gaussian_ids) = self.slots();
        let Blended { render, tile_ranges, segment_states, .. } = blended;
        let mut random = Random::new(3);
        let d_render: Vec<f32> = render.iter().map(|_| random.between(-1.0, 1.0) as f32).collect();
        let counts = vec![self.count() as u32];
        let stored = (6 + self.channels).next_multiple_of(4) as usize;
        let gradient_records = vec![f32::NAN; stored * self.count()];
        let constants = blend_backward::Constants {
            channels: self.channels,
            shaping_channels: self.channels - self.channels / 4,
            tile_width: self.tile.size[0],
            tile_height: self.tile.size[1],
            subgroups_per_tile: self.tile.subgroups,
            segment,
            skips_groups: device.skips_groups,
            sums_in_shared_memory: device.sums_in_shared_memory,
            ..Default::default()
        };
        let tile_count = self.tile_count();
        let blocks = (self.count() as u32).checked_div(segment).map_or(0, |blocks| blocks + 1);
        run_kernel!(
            blend_backward,
            constants,
            blend_backward::Params { size: self.size, tile_columns: self.columns, tile_count },
            Threads::Workgroups([tile_count + blocks, 1, 1]),
            [
                tile_ranges,
                sorted_intersections,
                gaussian_ids,
                splats,
                colors,
                render,
                d_render,
                counts,
                sorted_tiles,
                segment_states
            ],
            [gradient_records]
        )
    }
}

/// A splat as `project` makes it, of these standard deviations.
fn splat(mean: DVec2, [long, short]: [f64; 2], angle: f64, opacity: f64) -> ProjectedSplat {
    let turn = DMat2::from_angle(angle);
    let cov =
        turn * DMat2::from_diagonal(DVec2::new(long * long, short * short)) * turn.transpose()
            + DMat2::from_diagonal(DVec2::splat(0.3));
    let conic = cov.inverse();
    let variances = Vec2::new(cov.x_axis.x as f32, cov.y_axis.y as f32);
    let half_extent = (splat_level(opacity as f32) * variances).map(f32::sqrt) + 0.01;
    ProjectedSplat {
        mean2d: mean.as_vec2(),
        conic: DVec3::new(conic.x_axis.x, conic.x_axis.y, conic.y_axis.y).as_vec3(),
        opacity: opacity as f32,
        half_extent,
    }
}

/// Tiles without splats, with some, and with hundreds, of which those in front end the uppermost rows.
fn mixed_tiles(tile: Tile, channels: u32) -> Tiles {
    let mut random = Random::new(u64::from(channels));
    let mut tiles = Tiles::new(tile, 2, channels, &[5, 0, 67, 230, 1, 33]);
    // Some pixels of the last tiles are outside.
    tiles.size -= UVec2::new(3, 5);
    let [width, height] = tile.size.map(f64::from);
    for i in 0..tiles.count() {
        let tile = tiles.sorted_tiles[i];
        let mut between = |low, high| random.between(low, high);
        let mean = tiles.origin(tile)
            + DVec2::new(between(-0.2, 1.2) * width, between(-0.2, 1.2) * height);
        let deviations = [0, 0].map(|_| between(-1.0, 2.0).exp());
        let faint = splat(mean, deviations, between(0.0, TAU), between(0.0045, 0.6));
        let above = DVec2::new(mean.x, tiles.origin(tile).y);
        let opaque = splat(above, [300.0, 0.8], 0.02, 0.997);
        tiles.splats.push(if i % 7 == 3 { opaque } else { faint });
    }
    let stored = channels.next_multiple_of(4) as usize;
    for i in 0..tiles.count() {
        for c in 0..channels as usize {
            tiles.colors[stored * i + c] = random.between(0.0, 1.0) as f32;
        }
    }
    // Gaussians are in reverse order: the last channel is a depth.
    for i in 0..tiles.count() {
        tiles.colors[stored * i + channels as usize - 1] = (tiles.count() - i) as f32 * 0.01;
    }
    tiles.splats.reverse();
    tiles
}

fn suited<const N: usize>(tiles: [([u32; 2], u32); N]) -> impl Iterator<Item = Tile> {
    tiles.into_iter().map(tile_of).filter(|&tile| gpu().properties().suits_tile(tile))
}

#[test]
fn splats_that_wait_in_shared_memory_are_blended_as_those_that_are_shuffled() {
    let segment = gpu().properties().subgroup_size.max(16);
    for (channels, tile, segment) in [
        (3, ([8, 8], 1), segment),
        (11, ([8, 8], 1), 0),
        (4, ([16, 8], 2), 0),
        (3, ([16, 16], 4), segment),
        (11, ([16, 8], 4), segment),
    ] {
        let tile = tile_of(tile);
        if !gpu().properties().suits_tile(tile) {
            continue;
        }
        let tiles = mixed_tiles(tile, channels);
        let forward =
            |device| tiles.forward(tiles.forward_constants(segment, device), &[0.0], DEPTH_SUM);
        let blended = forward(CPU);
        assert!(forward(GPUS[0]) == blended, "{channels} {tile}");
        let shuffled = tiles.backward(&blended, segment, CPU);
        let largest = shuffled.iter().fold(0.0f32, |most, d| most.max(d.abs()));
        for device in GPUS {
            let records = tiles.backward(&blended, segment, device);
            for (waiting, shuffled) in records.iter().zip(&shuffled) {
                let difference = (waiting - shuffled).abs();
                assert!(difference <= 1e-5 * largest, "{channels} {tile} {device:?}");
            }
        }
    }
}

#[test]
fn depths_end_pixels_and_are_their_median_on_every_device() {
    // The last has all features.
    for (tile, channels) in [(([8, 8], 1), 4), (([16, 16], 4), 4), (([8, 8], 1), 12)] {
        let Some(tile) = suited([tile]).next() else { continue };
        let tiles = mixed_tiles(tile, channels);
        let mut random = Random::new(9);
        let limits: Vec<f32> = (0..tiles.size.element_product())
            .map(|_| random.between(0.0, 0.01 * tiles.count() as f64) as f32)
            .collect();
        for (limits, kind) in [
            (&limits[..], DEPTH_SUM),
            (&limits, DEPTH_MEDIAN),
            (&[0.0], DEPTH_MEDIAN),
            (&[0.0], DEPTH_MEAN),
        ] {
            let [passed, waiting] = [CPU, GPUS[0]].map(|device| {
                let constants = tiles.forward_constants(0, device);
                let constants = blend_forward::Constants { view_depths: 1, ..constants };
                tiles.forward(constants, limits, kind)
            });
            assert!(passed == waiting, "{tile} {channels} {} {kind}", limits.len());
        }
    }
}

/// One splat a tile, of any shape, at any place around it.
fn ellipses(tile: Tile, count: usize) -> Tiles {
    let mut tiles = Tiles::new(tile, 32, 3, &vec![1; count]);
    let mut random = Random::new(5);
    let [width, height] = tile.size.map(f64::from);
    for i in 0..count {
        let mut between = |low, high| random.between(low, high);
        let deviations = [0, 0].map(|_| between(-4.0, if i % 5 == 0 { 6.0 } else { 2.5 }).exp());
        let reach = 1.0 + deviations[0].max(deviations[1]);
        let mean = tiles.origin(i as u32)
            + DVec2::new(between(-reach, width + reach), between(-reach, height + reach));
        let mean = if i % 4 == 0 { mean.round() + 0.5 } else { mean };
        let angle = if i % 3 == 0 { (i % 8) as f64 * TAU / 8.0 } else { between(0.0, TAU) };
        let opacity = [1.0, 0.99, 0.5, 0.02, 0.003_95, 0.003_922][i % 6];
        tiles.splats.push(splat(mean, deviations, angle, opacity));
    }
    tiles.splats.reverse();
    tiles
}

/// The pixels of every tile that are not skipped: those that a colour of NaN reaches, even with a weight of zero.
fn blended_pixels(tiles: &Tiles) -> Vec<bool> {
    let gpu = gpu();
    let constants = tiles.forward_constants(0, GPUS[0]);
    let pipeline = gpu.pipeline::<blend_forward::Kernel>(&constants).unwrap();
    let (sorted_intersections, gaussian_ids) = tiles.slots();
    let pixels = tiles.size.element_product() as usize;
    let words = |name, words: &[u32]| gpu.buffer(name, words).unwrap();
    let floats = |name, floats: &[f32]| gpu.buffer(name, floats).unwrap();
    let counts = words("counts", &[tiles.count() as u32]);
    let sorted_intersections = words("sorted_intersections", &sorted_intersections);
    let gaussian_ids = words("gaussian_ids", &gaussian_ids);
    let splats = gpu.buffer("splats", &tiles.splats).unwrap();
    let colors = floats("colors", &vec![f32::NAN; tiles.colors.len()]);
    let sorted_tiles = words("sorted_tiles", &tiles.sorted_tiles);
    let limits = floats("limits", &[0.0]);
    let mut render = floats("render", &vec![0.0; 3 * pixels]);
    let mut transmittances = floats("transmittances", &vec![0.0; pixels]);
    let ranges = vec![UVec2::ZERO; tiles.tile_count() as usize];
    let mut tile_ranges = gpu.buffer("tile_ranges", &ranges).unwrap();
    let mut status = words("status", &[0; 4]);
    let mut segment_states = floats("segment_states", &[0.0]);
    gpu.run("blend_forward", |pass| {
        let params = blend_forward::Params {
            size: tiles.size,
            tile_columns: tiles.columns,
            longest_run: u32::MAX,
            background: [0.0; 3],
            has_limits: 0,
            depth_kind: 0,
        };
        let buffers = blend_forward::Buffers {
            counts: counts.slice(),
            sorted_intersections: sorted_intersections.slice(),
            gaussian_ids: gaussian_ids.slice(),
            splats: splats.slice(),
            colors: colors.slice(),
            sorted_tiles: sorted_tiles.slice(),
            limits: limits.slice(),
            render: render.slice_mut(),
            transmittances: transmittances.slice_mut(),
            tile_ranges: tile_ranges.slice_mut(),
            status: status.slice_mut(),
            segment_states: segment_states.slice_mut(),
        };
        pass.dispatch(&pipeline, &params, buffers, Threads::Workgroups([tiles.tile_count(), 1, 1]))
    })
    .unwrap();
    let render: Vec<f32> = gpu.read(&render).unwrap();
    render[..pixels].iter().map(|value| value.is_nan()).collect()
}

/// Panics where a pixel that a splat shows on is skipped; returns the rows of parts with such pixels, and those that
/// are blended.
fn assert_none_is_missed(tiles: &Tiles) -> [usize; 2] {
    let blended = blended_pixels(tiles);
    let [width, height] = tiles.tile.size;
    let mut rows = [0, 0];
    for tile in 0..tiles.count() as u32 {
        let projected = tiles.splats[tiles.count() - 1 - tile as usize];
        let splat = Splat::from(&projected);
        let origin = tiles.origin(tile).as_uvec2();
        for y in 0..height {
            let (mut is_visible, mut is_blended) = (false, false);
            for pixel in (0..width).map(|x| origin + UVec2::new(x, y)) {
                let sigma = splat.sigma(splat.mean2d - pixel.as_dvec2() - 0.5);
                let shows = sigma >= 0.0 && splat.opacity * (-sigma).exp() >= ALPHA_MIN;
                let blends = blended[(pixel.y * tiles.size.x + pixel.x) as usize];
                assert!(blends || !shows, "{}: {pixel} of {projected:?}", tiles.tile);
                is_visible |= shows;
                is_blended |= blends;
            }
            rows[0] += usize::from(is_visible);
            rows[1] += usize::from(is_blended);
        }
    }
    rows
}

#[test]
fn no_row_that_an_ellipse_shows_on_is_skipped_and_few_others_are_blended() {
    for tile in suited([([16, 8], 1), ([8, 8], 1), ([16, 16], 4), ([4, 16], 1)]) {
        let mut tiles = ellipses(tile, 1500);
        tiles.colors.fill(0.5);
        tiles.forward(tiles.forward_constants(0, GPUS[0]), &[0.0], DEPTH_SUM);
        let [visible, blended] = assert_none_is_missed(&tiles);
        // Seldom a row that the margin alone touches; half of the rows that a group has beside the first.
        let rows = gpu().properties().subgroup_size.div_ceil(tile.size[0]) as usize;
        let more = tiles.count() / 10 + tiles.count() * (rows - 1) / 2;
        assert!(visible > 3000, "{tile}: {visible}");
        assert!(blended <= visible + more, "{tile}: {visible} {blended}");
    }
}

#[test]
fn no_row_is_skipped_for_a_box_that_is_no_number_or_that_no_image_holds() {
    for tile in suited([([16, 8], 1), ([8, 8], 1)]) {
        let mut tiles = ellipses(tile, 300);
        for (i, splat) in tiles.splats.iter_mut().enumerate() {
            let extent = [0.0, f32::NAN, f32::INFINITY, 1e30, -1.0][i % 5];
            let half_extent = &mut splat.half_extent;
            match i % 3 {
                0 => half_extent.x = extent,
                1 => half_extent.y = extent,
                _ => *half_extent = Vec2::splat(extent),
            }
        }
        assert_none_is_missed(&tiles);
        // A splat that nothing is known of shows nothing.
        for (i, splat) in tiles.splats.iter_mut().enumerate() {
            *[&mut splat.conic.x, &mut splat.conic.y, &mut splat.mean2d.y][i % 3] = f32::NAN;
        }
        tiles.colors.fill(1.0);
        let blended = tiles.forward(tiles.forward_constants(0, GPUS[0]), &[0.0], DEPTH_SUM);
        assert!(blended.transmittances.iter().all(|&transmittance| transmittance == 1.0));
    }
}

/// The runs of `sorted_tiles` that are found in a view of 5 x 24 tiles, and the status.
pub(crate) fn tile_runs(sorted_tiles: Vec<u32>, longest_run: u32) -> (Vec<UVec2>, Vec<u32>) {
    let count = sorted_tiles.len();
    let mut tiles = Tiles::new(tile_of(([16, 16], 1)), 5, 3, &[0; 120]);
    tiles.splats = vec![splat(DVec2::ZERO, [1.0; 2], 0.0, 0.5); count];
    (tiles.sorted_tiles, tiles.colors, tiles.longest_run) =
        (sorted_tiles, vec![0.5; 4 * count], longest_run);
    let Blended { tile_ranges, status, .. } =
        tiles.forward(tiles.forward_constants(0, GPUS[0]), &[0.0], DEPTH_SUM);
    (tile_ranges, status)
}

#[test]
fn padding_belongs_to_no_tile() {
    let (ranges, status) = tile_runs(vec![0, 0, 2, 120, u32::MAX], 2);
    assert_eq!(ranges[..3], [UVec2::new(0, 2), UVec2::splat(2), UVec2::new(2, 3)]);
    assert!(ranges[3..].iter().all(|range| range.x == range.y));
    assert_eq!(status, [0; 3]);
}

#[test]
fn every_tile_finds_its_run_among_any_number_of_intersections() {
    let mut random = Random::new(8);
    for count in [0, 1, 7, 8, 9, 63, 64, 65, 513, 5000] {
        let mut tiles: Vec<u32> = (0..count).map(|_| random.between(0.0, 122.0) as u32).collect();
        tiles.sort_unstable();
        let (ranges, _) = tile_runs(tiles.clone(), u32::MAX);
        for (tile, range) in (0..120).zip(ranges) {
            let run = &tiles[range.x as usize..range.y as usize];
            let all = tiles.iter().filter(|&&other| other == tile).count();
            assert!(run.len() == all && run.iter().all(|&other| other == tile), "{count}: {tile}");
        }
    }
}
