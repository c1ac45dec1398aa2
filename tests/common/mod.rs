//! Shared by the tests: random numbers, comparisons, single kernels, the command, and reports of tests that are not
//! run.

#![allow(dead_code, unused_macros, reason = "no test binary uses everything")]

pub(crate) mod chain;
pub(crate) mod command;
pub(crate) mod log;
pub(crate) mod lpips;
pub(crate) mod png;
pub(crate) mod prelude;
pub(crate) mod safetensors;
pub(crate) mod setup;
pub(crate) mod train;
pub(crate) mod workspace;

use std::path::{Path, PathBuf};

use nightsplat::gpu::Gpu;
pub(crate) use nightsplat::gpu::testing::not_run;
use nightsplat::gpu::testing::{gpu, gpu_that_binds};
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

/// A file or folder of captures that may be next to the checkout; without it, the rest of the test is not run.
#[track_caller]
pub(crate) fn shared(name: &str) -> Option<PathBuf> {
    let path = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared")).join(name);
    if path.exists() {
        return Some(path);
    }
    not_run("captures", format_args!("../shared/{name} is absent"));
    None
}

/// A file or folder that is committed with the tests.
pub(crate) fn fixture(name: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures")).join(name)
}

/// Copies a folder.
pub(crate) fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let (path, target) = entry.map(|e| (e.path(), to.join(e.file_name()))).unwrap();
        if path.is_dir() {
            copy(&path, &target);
        } else {
            std::fs::copy(path, target).unwrap();
        }
    }
}
