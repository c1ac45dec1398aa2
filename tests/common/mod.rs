//! Scenes, and the rasteriser's kernels one after another with the sorting done on the host.

#![allow(dead_code, reason = "no test binary uses everything")]

pub(crate) mod model;

use glam::{UVec2, Vec2};
use nightsplat::gpu::Threads;
use nightsplat::gpu::testing::gpu;
use nightsplat::kernels::splat::RECORD_HEAD;
use nightsplat::kernels::{
    self, ProjectedSplat, blend_backward, blend_forward, check_capacity, emit, order_counts,
    project, project_backward, reduce_records, tile_ranges,
};
use nightsplat::random::Stream;
use nightsplat::reference::camera::Camera;
use nightsplat::reference::gaussian::{Gaussian, Planes};

/// Runs a kernel on the device over host vectors named like its buffers, checks what it leaves against its reference, and
/// gives back what it writes.
macro_rules! run_kernel {
    ($kernel:ident, $constants:expr, $params:expr, $threads:expr, [$($input:ident),*], [$($output:ident),+]) => {{
        // Before the buffers take the vectors' names.
        let (params, threads) = (&$params, $threads);
        let gpu = gpu();
        let pipeline = gpu.pipeline::<$kernel::Kernel>(&$constants).unwrap();
        $(let $input = gpu.buffer(stringify!($input), &$input).unwrap();)*
        $(let mut $output = gpu.buffer(stringify!($output), &$output).unwrap();)+
        let (done, report) = gpu.checked(|| {
            gpu.run(stringify!($kernel), |pass| {
                let buffers = $kernel::Buffers { $($input: &$input,)* $($output: &mut $output,)+ };
                pass.dispatch(&pipeline, params, buffers, threads)
            })
        });
        done.and_then(|()| report.agree()).unwrap_or_else(|error| panic!("{params:?}: {error}"));
        ($(gpu.read(&$output).unwrap()),+)
    }};
}

/// The same with the kernel's CPU reference.
#[allow(unused_macros, reason = "no test binary uses everything")]
macro_rules! run_reference {
    ($kernel:ident, $constants:expr, $params:expr, [$($input:ident),*], [$($output:ident),+]) => {{
        $(let mut $output = $output.clone();)+
        let slices = $kernel::Slices { $($input: &$input,)* $($output: &mut $output,)+ };
        <$kernel::Kernel as nightsplat::gpu::Reference>::run(&$params, &$constants, slices);
        ($($output),+)
    }};
}

/// Panics with the first ten elements that `bound(index, expected)` does not allow.
pub(crate) fn assert_close(
    what: &str,
    actual: &[f32],
    expected: &[f32],
    bound: impl Fn(usize, f32) -> f32,
) {
    assert_eq!(actual.len(), expected.len(), "{what}");
    // Positive phrasing: a NaN is a mismatch.
    let is_close = |i: usize| (actual[i] - expected[i]).abs() <= bound(i, expected[i]);
    let bad: Vec<usize> = (0..actual.len()).filter(|&i| !is_close(i)).collect();
    let first = |&i: &usize| format!("[{i}] {} instead of {}", actual[i], expected[i]);
    let shown: Vec<String> = bad.iter().take(10).map(first).collect();
    assert!(bad.is_empty(), "{what}: {} of {} differ: {shown:#?}", bad.len(), actual.len());
}

/// A stream of random numbers that remembers where it is.
pub(crate) struct Random(Stream, u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(Stream::new(seed, 0), 0)
    }

    /// Uniform in [low, high).
    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        self.1 += 1;
        low + (high - low) * self.0.uniform(self.1)
    }

    pub(crate) fn normals<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| {
            self.1 += 1;
            self.0.normal(self.1)
        })
    }
}

/// Gaussians, a view of them, and what the kernels are specialised for.
#[derive(Clone)]
pub(crate) struct Setup {
    pub(crate) params: project::Params,
    pub(crate) parameters: Vec<f32>,
    pub(crate) sh_degree: u32,
    pub(crate) raw_colors: bool,
    pub(crate) alpha_max: f32,
    pub(crate) channels: u32,
    pub(crate) tile: UVec2,
    pub(crate) background: [f32; 11],
}

impl Setup {
    /// `count` Gaussians inside the view of a turned camera with an off-centre principal point.
    pub(crate) fn new(count: usize, size: UVec2, sh_degree: u32, seed: u64) -> Self {
        Self::with_channels(count, size, sh_degree, 3, seed)
    }

    /// The same with features beside colour.
    pub(crate) fn with_channels(
        count: usize,
        size: UVec2,
        sh_degree: u32,
        channels: u32,
        seed: u64,
    ) -> Self {
        let (sin, cos) = 0.3f32.sin_cos();
        let camera = kernels::Camera {
            view_from_world: [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos], [0.2, -0.1, 0.4]],
            focal: Vec2::new(0.9, 0.8) * size.x as f32,
            principal_point: Vec2::new(0.42, 0.57) * size.as_vec2(),
            size,
        };
        let gaussian_count = count as u32;
        let params = project::Params { camera, near: 0.2, gaussian_count, sh_degree };
        let mut setup = Self {
            params,
            parameters: vec![],
            sh_degree,
            raw_colors: false,
            alpha_max: 0.99,
            channels,
            tile: UVec2::new(16, 16),
            background: std::array::from_fn(|c| 0.1 * c as f32),
        };
        setup.parameters = vec![0.0; setup.planes().len()];
        let mut random = Random::new(seed);
        for i in 0..count {
            let gaussian = setup.random_gaussian(&mut random);
            setup.set(i, &gaussian);
        }
        setup
    }

    /// One that projects into the image or beside it, also where slopes are clamped, some pixels wide.
    fn random_gaussian(&self, random: &mut Random) -> Gaussian {
        let camera = self.camera();
        let depth = random.between(1.0, 5.0);
        let pixel =
            camera.size * glam::DVec2::from_array([0; 2].map(|_| random.between(-0.25, 1.25)));
        let in_view = ((pixel - camera.principal_point) / camera.focal * depth).extend(depth);
        let pixel_size = depth / camera.focal.x;
        let count = nightsplat::reference::sh::sh_count(self.sh_degree);
        Gaussian {
            mean: camera.rotation.transpose() * (in_view - camera.translation),
            quat: random.normals().into(),
            log_scale: [0; 3].map(|_| (pixel_size * random.between(0.3, 8.0)).ln()).into(),
            raw_opacity: random.between(-3.0, 6.0),
            features: (3..self.channels).map(|_| random.between(-1.0, 2.0)).collect(),
            sh: (0..count)
                .map(|k| (random.normals().map(|c: f64| c / (1.0 + k as f64))).into())
                .collect(),
        }
    }

    pub(crate) fn planes(&self) -> Planes {
        let feature_count = self.channels as usize - 3;
        let count = self.params.gaussian_count as usize;
        Planes { count, feature_count, sh_degree: self.sh_degree }
    }

    pub(crate) fn camera(&self) -> Camera {
        Camera::from(&self.params.camera)
    }

    pub(crate) fn get(&self, i: usize) -> Gaussian {
        self.planes().load(&self.parameters, i)
    }

    pub(crate) fn set(&mut self, i: usize, gaussian: &Gaussian) {
        let planes = self.planes();
        planes.store(gaussian, i, |at, value| self.parameters[at] = value as f32);
    }

    pub(crate) fn tiles(&self) -> UVec2 {
        (self.params.camera.size + self.tile - 1) / self.tile
    }

    pub(crate) fn tile_count(&self) -> u32 {
        self.tiles().element_product()
    }

    pub(crate) fn pixels(&self) -> usize {
        self.params.camera.size.element_product() as usize
    }

    pub(crate) fn record(&self) -> usize {
        (RECORD_HEAD + self.channels) as usize
    }
}

/// Every size, channel count, tile and SH degree (stored, in use) that a kernel may trip over; colours are raw in those
/// with many channels.
pub(crate) fn variants() -> Vec<Setup> {
    type Row = (usize, [u32; 2], [u32; 2], u32, [u32; 2]);
    let rows: [Row; 7] = [
        (0, [33, 17], [0, 0], 3, [16, 8]),
        (1, [16, 16], [0, 0], 3, [16, 16]),
        (63, [50, 37], [1, 1], 4, [16, 8]),
        (64, [64, 48], [2, 1], 11, [16, 4]),
        (65, [65, 31], [3, 0], 3, [8, 8]),
        (65, [40, 41], [3, 2], 11, [8, 8]),
        (1777, [131, 77], [3, 3], 3, [16, 8]),
    ];
    let build = |(count, size, [stored, used], channels, tile): Row| {
        let mut setup = Setup::with_channels(count, size.into(), stored, channels, count as u64);
        setup.params.sh_degree = used;
        Setup { raw_colors: channels > 4, tile: tile.into(), ..setup }
    };
    rows.map(build).to_vec()
}

/// The constants of a kernel that includes `splat.glsl`.
macro_rules! constants {
    ($kernel:ident, $setup:expr $(, $field:ident)*) => {
        $kernel::Constants {
            alpha_max: $setup.alpha_max,
            channels: $setup.channels,
            tile_width: $setup.tile.x,
            tile_height: $setup.tile.y,
            $($field: $setup.$field,)*
        }
    };
}

/// Everything between the Gaussians and the render.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Frame {
    pub(crate) splats: Vec<ProjectedSplat>,
    pub(crate) colors: Vec<f32>,
    pub(crate) depth_keys: Vec<u32>,
    pub(crate) ids: Vec<u32>,
    pub(crate) tile_counts: Vec<u32>,
    pub(crate) sorted_ids: Vec<u32>,
    pub(crate) ordered_counts: Vec<u32>,
    pub(crate) offsets: Vec<u32>,
    pub(crate) counts: Vec<u32>,
    pub(crate) status: Vec<u32>,
    pub(crate) tiles: Vec<u32>,
    pub(crate) slots: Vec<u32>,
    pub(crate) owners: Vec<u32>,
    pub(crate) sorted_tiles: Vec<u32>,
    pub(crate) sorted_slots: Vec<u32>,
    pub(crate) tile_ranges: Vec<UVec2>,
    pub(crate) render: Vec<f32>,
    pub(crate) transmittances: Vec<f32>,
}

/// Colours before `project` fills them in: those of culled Gaussians stay.
pub(crate) fn initial_colors(setup: &Setup) -> Vec<f32> {
    let mut random = Random::new(9);
    let count = setup.params.gaussian_count * setup.channels;
    (0..count).map(|_| random.between(-1.0, 2.0) as f32).collect()
}

/// A slot that no kernel has written.
pub(crate) const UNWRITTEN: u32 = 0xdead;

/// The kernels forward, with room for `capacity` intersections (as many as there are for `None`).
pub(crate) fn forward(setup: &Setup, capacity: Option<u32>) -> Frame {
    let n = setup.params.gaussian_count;
    let exactly = Threads::Exactly([n, 1, 1]);
    let Setup { parameters, params, .. } = setup;
    let (splats, colors) = (vec![ProjectedSplat::default(); n as usize], initial_colors(setup));
    let [depth_keys, ids, tile_counts] = [0; 3].map(|_| vec![0u32; n as usize]);
    let (splats, colors, depth_keys, ids, tile_counts) = run_kernel!(
        project,
        constants!(project, setup, sh_degree, raw_colors),
        params,
        exactly,
        [parameters],
        [splats, colors, depth_keys, ids, tile_counts]
    );

    let mut sorted_ids = ids.clone();
    sorted_ids.sort_by_key(|&id| depth_keys[id as usize]);
    let ordered_counts = vec![0u32; n as usize];
    let ordered_counts = run_kernel!(
        order_counts,
        order_counts::Constants::default(),
        order_counts::Params { gaussian_count: n },
        exactly,
        [sorted_ids, tile_counts],
        [ordered_counts]
    );
    let (offsets, total) = scan(&ordered_counts);
    let total = vec![total];
    let capacity = capacity.unwrap_or(total[0]);
    let (counts, status) = (vec![7u32], vec![0u32, 0]);
    let (counts, status) = run_kernel!(
        check_capacity,
        check_capacity::Constants::default(),
        check_capacity::Params { capacity },
        Threads::Exactly([1, 1, 1]),
        [total],
        [counts, status]
    );
    let [tiles, slots, owners] = [0; 3].map(|_| vec![UNWRITTEN; capacity as usize]);
    let (tiles, slots, owners) = run_kernel!(
        emit,
        constants!(emit, setup),
        emit::Params { size: params.camera.size, gaussian_count: n, tile_columns: setup.tiles().x },
        exactly,
        [counts, sorted_ids, ordered_counts, offsets, splats],
        [tiles, slots, owners]
    );

    let count = counts[0] as usize;
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by_key(|&i| tiles[i]);
    let sorted_tiles: Vec<u32> = order.iter().map(|&i| tiles[i]).collect();
    let sorted_slots: Vec<u32> = order.iter().map(|&i| slots[i]).collect();
    let tile_ranges = vec![UVec2::ZERO; setup.tile_count() as usize];
    let tile_ranges = run_kernel!(
        tile_ranges,
        tile_ranges::Constants::default(),
        tile_ranges::Params { tile_count: setup.tile_count() },
        Threads::Exactly([counts[0], 1, 1]),
        [counts, sorted_tiles],
        [tile_ranges]
    );
    let render = vec![f32::NAN; setup.channels as usize * setup.pixels()];
    let transmittances = vec![f32::NAN; setup.pixels()];
    let (render, transmittances) = run_kernel!(
        blend_forward,
        constants!(blend_forward, setup),
        blend_params(setup),
        Threads::Workgroups([setup.tile_count(), 1, 1]),
        [tile_ranges, sorted_slots, owners, splats, colors],
        [render, transmittances]
    );
    Frame {
        splats,
        colors,
        depth_keys,
        ids,
        tile_counts,
        sorted_ids,
        ordered_counts,
        offsets,
        counts,
        status,
        tiles,
        slots,
        owners,
        sorted_tiles,
        sorted_slots,
        tile_ranges,
        render,
        transmittances,
    }
}

pub(crate) fn blend_params(setup: &Setup) -> blend_forward::Params {
    blend_forward::Params {
        size: setup.params.camera.size,
        tile_columns: setup.tiles().x,
        background: setup.background,
    }
}

/// The sums before each element, and that of all.
pub(crate) fn scan(counts: &[u32]) -> (Vec<u32>, u32) {
    let mut total = 0;
    let before = |&count: &u32| {
        let before = total;
        total += count;
        before
    };
    let offsets = counts.iter().map(before).collect();
    (offsets, total)
}

/// What the backward kernels leave behind.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Gradients {
    pub(crate) records: Vec<f32>,
    pub(crate) d_splats: Vec<f32>,
    pub(crate) gradients: Vec<f32>,
    pub(crate) grad_norm_sums: Vec<f32>,
    pub(crate) visit_counts: Vec<u32>,
}

pub(crate) fn project_backward_params(setup: &Setup) -> project_backward::Params {
    let project::Params { camera, gaussian_count, sh_degree, .. } = setup.params;
    project_backward::Params {
        camera,
        gaussian_count,
        sh_degree,
        damping_weight: 0.7,
        damping_depth: 3.0,
    }
}

/// The kernels backward, from `d_render` (channels, H, W) of a frame.
pub(crate) fn backward(setup: &Setup, frame: &Frame, d_render: &[f32]) -> Gradients {
    let Frame { tile_ranges, sorted_slots, owners, splats, colors, render, .. } = frame;
    let Frame { counts, sorted_ids, ordered_counts, offsets, tile_counts, status, .. } = frame;
    let Setup { parameters, .. } = setup;
    let n = setup.params.gaussian_count;
    let records = vec![f32::NAN; setup.record() * owners.len()];
    let records = run_kernel!(
        blend_backward,
        constants!(blend_backward, setup),
        blend_backward::Params { size: setup.params.camera.size, tile_columns: setup.tiles().x },
        Threads::Workgroups([setup.tile_count(), 1, 1]),
        [tile_ranges, sorted_slots, owners, splats, colors, render, d_render],
        [records]
    );
    let d_splats = vec![f32::NAN; setup.record() * n as usize];
    let d_splats = run_kernel!(
        reduce_records,
        constants!(reduce_records, setup),
        reduce_records::Params { gaussian_count: n },
        Threads::Exactly([n, 1, 1]),
        [counts, sorted_ids, ordered_counts, offsets, records],
        [d_splats]
    );
    let gradients = vec![f32::NAN; setup.planes().len()];
    let (grad_norm_sums, visit_counts) = (vec![0.5; n as usize], vec![3u32; n as usize]);
    let (gradients, grad_norm_sums, visit_counts) = run_kernel!(
        project_backward,
        constants!(project_backward, setup, sh_degree, raw_colors),
        project_backward_params(setup),
        Threads::Exactly([n, 1, 1]),
        [parameters, splats, colors, tile_counts, d_splats, status],
        [gradients, grad_norm_sums, visit_counts]
    );
    Gradients { records, d_splats, gradients, grad_norm_sums, visit_counts }
}
