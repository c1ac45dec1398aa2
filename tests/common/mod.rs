//! Shared by the tests: random numbers, comparisons, single kernels, the command, and reports of tests that are not
//! run.

#![allow(dead_code, unused_imports, unused_macros, reason = "no test binary uses everything")]

pub(crate) mod arbitrary;
pub(crate) mod chain;
pub(crate) mod clouds;
pub(crate) mod command;
mod files;
pub(crate) mod grid;
pub(crate) mod log;
pub(crate) mod lpips;
pub(crate) mod png;
pub(crate) mod prelude;
pub(crate) mod process;
pub(crate) mod safetensors;
pub(crate) mod sets;
pub(crate) mod setup;
pub(crate) mod train;
pub(crate) mod workspace;

pub(crate) use files::{
    Folder, contents, copy, file_names, files_below, fixture, not_run, paths, says, shared,
};
use glam::{DAffine3, DVec2};
use nightsplat::gpu::testing::{gpu, gpu_that_binds};
use nightsplat::gpu::{CheckReport, Gpu};
use nightsplat::train::{StepReport, Trainer};
use nightsplat_core::camera::Camera;
use nightsplat_core::random::Stream;

/// A device that no other test uses, to count memory and passes.
pub(crate) fn own_gpu() -> Gpu {
    gpu_that_binds(gpu().properties().max_storage_buffer_range)
}

/// Runs a kernel on the device with host vectors named like its buffers, checks its results against its reference, and
/// copies them back.
macro_rules! run_kernel {
    ($kernel:ident, $constants:expr, $params:expr, $threads:expr, [$($input:ident),*], [$($output:ident),+]) => {{
        // Evaluated before the buffers shadow the vectors.
        let (params, threads) = (&$params, $threads);
        let gpu = nightsplat::gpu::testing::gpu();
        let pipeline = gpu.pipeline::<$kernel::Kernel>(&$constants).unwrap();
        $(let $input = gpu.buffer(stringify!($input), &$input).unwrap();)*
        $(let mut $output = gpu.buffer(stringify!($output), &$output).unwrap();)+
        let (done, report) = gpu.checked(|| {
            gpu.run(stringify!($kernel), |pass| {
                let buffers = $kernel::Buffers {
                    $($input: $input.slice(),)*
                    $($output: $output.slice_mut(),)+
                };
                pass.dispatch(&pipeline, params, buffers, threads)
            })
        });
        done.and_then(|()| report.agree()).unwrap_or_else(|error| panic!("{params:?}: {error}"));
        ($(gpu.read(&$output).unwrap()),+)
    }};
}

/// Runs the kernel's CPU reference in the same way.
#[allow(unused_macros, reason = "no test binary uses everything")]
macro_rules! run_reference {
    ($kernel:ident, $constants:expr, $params:expr, [$($input:ident),*], [$($output:ident),+]) => {{
        $(let mut $output = $output.clone();)+
        let slices = $kernel::Slices { $($input: &$input,)* $($output: &mut $output,)+ };
        <$kernel::Kernel as nightsplat::gpu::Reference>::run(&$params, &$constants, slices);
        ($($output),+)
    }};
}

/// Panics with the first ten elements that exceed `bound(index, expected)`.
pub(crate) fn assert_close(
    what: &str,
    actual: &[f32],
    expected: &[f32],
    bound: impl Fn(usize, f32) -> f32,
) {
    assert_eq!(actual.len(), expected.len(), "{what}");
    // Written so that a NaN is a mismatch.
    let is_close = |i: usize| (actual[i] - expected[i]).abs() <= bound(i, expected[i]);
    let bad: Vec<usize> = (0..actual.len()).filter(|&i| !is_close(i)).collect();
    let first = |&i: &usize| format!("[{i}] {} instead of {}", actual[i], expected[i]);
    let shown: Vec<String> = bad.iter().take(10).map(first).collect();
    assert!(bad.is_empty(), "{what}: {} of {} differ: {shown:#?}", bad.len(), actual.len());
}

/// A stream of random numbers with its position.
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

pub(crate) fn largest(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |largest, value| value.abs().max(largest))
}

pub(crate) fn narrow(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&value| value as f32).collect()
}

pub(crate) fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&value| value.into()).collect()
}

/// A camera with square pixels and its principal point in the middle.
pub(crate) fn pinhole(size: [u32; 2], focal: f64, view_from_world: DAffine3) -> Camera {
    let field_of_view = 2.0 * (0.5 * f64::from(size[1]) / focal).atan();
    Camera {
        focal: DVec2::splat(focal),
        ..Camera::perspective(view_from_world, field_of_view, size)
    }
}

/// Work whose passes agree with their references, and what ran.
#[track_caller]
pub(crate) fn agreeing<R>(work: impl FnOnce() -> R) -> (R, CheckReport) {
    let (result, report) = gpu().checked(work);
    report.agree().unwrap();
    (result, report)
}

/// A step of training, likewise.
#[track_caller]
pub(crate) fn agreeing_step(trainer: &mut Trainer) -> (Vec<StepReport>, CheckReport) {
    let (reports, report) = trainer.check_step();
    report.agree().unwrap();
    (reports.unwrap(), report)
}
