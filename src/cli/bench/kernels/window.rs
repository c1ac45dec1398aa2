//! Windows for the networks: copied out of the render, and added back.

use glam::UVec2;

use crate::cli::bench::check::Rule::Exact;
use crate::cli::bench::check::check;
use crate::cli::bench::{Bench, Timing};
use crate::gpu::Threads;
use crate::kernels::*;

/// A window of 256x256 pixels in three planes of a render of eleven.
///
/// # Errors
/// A kernel disagrees with its reference, or the device is out of memory or lost.
pub(super) fn copy(bench: &Bench, timings: &mut Vec<Timing>) -> anyhow::Result<()> {
    let (size, origin, window) = (UVec2::new(512, 384), UVec2::new(100, 50), UVec2::splat(256));
    let (first_plane, plane_count) = (5, 3);
    let image: Vec<f32> =
        (0..11 * size.element_product()).map(|i| (i % 1013) as f32 / 1013.0).collect();
    let value_count = plane_count * window.element_product();
    let content = vec![0.0_f32; value_count as usize];
    let threads = Threads::Exactly([value_count, 1, 1]);
    let (content,) = check!(
        bench,
        timings,
        window_gather,
        window_gather::Constants::default(),
        window_gather::Params { size, origin, window, first_plane, plane_count },
        threads,
        [image],
        [content: Exact]
    );
    check!(
        bench,
        timings,
        window_scatter,
        window_scatter::Constants::default(),
        window_scatter::Params { size, origin, window, first_plane, plane_count },
        threads,
        [content],
        [image: Exact]
    );
    Ok(())
}
