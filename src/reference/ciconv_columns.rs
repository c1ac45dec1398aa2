//! `CIConv`: the columns pass and the invariant.

use glam::Vec3;
use nightsplat_photographs::tone::Real;

use super::ciconv_rows::taps;
use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::ciconv_columns::{Constants, EPSILON, Kernel, Params, Slices, Tolerances};

/// ln(W + 1e-5) of every pixel.
fn log_invariants(params: &Params, smooth_rows: &[Vec3], slope_rows: &[Vec3]) -> Vec<Rounded> {
    let (width, height) = (params.width as usize, params.height as usize);
    let [smooth, slope] = taps();
    let log_invariant = |i: usize| {
        let along = |rows: &[Vec3], channel: usize, taps: &[f64; 13]| {
            let neighbours = (0..13).filter_map(|k| Some((k, (i / width + k).checked_sub(6)?)));
            let inside = neighbours.filter(|&(_, y)| y < height);
            let term = |(k, y): (usize, usize)| {
                Rounded::from_f64(taps[k]) * Rounded::exact(rows[y * width + i % width][channel])
            };
            Rounded::sum(13.0, inside.map(term))
        };
        let e = along(smooth_rows, 0, &smooth).at_least(Rounded::from_f64(0.0));
        let e = e + Rounded::from_f64(EPSILON);
        let squares = (0..3).map(|channel| {
            let x = along(slope_rows, channel, &smooth) / e;
            let y = along(smooth_rows, channel, &slope) / e;
            // The kernel multiplies by the inverse.
            (x * x + y * y).rounded(2.0)
        });
        (Rounded::sum(4.0, squares) + Rounded::from_f64(EPSILON)).ln()
    };
    (0..width * height).map(log_invariant).collect()
}

/// Mean and sum of squares about it of every workgroup's pixels.
fn moments(params: &Params, logs: &[Rounded]) -> impl Iterator<Item = [Rounded; 2]> {
    logs.chunks(params.pixels_per_moment as usize).map(|logs| {
        let (count, chain) = (logs.len() as f64, chain(logs.len()));
        let mean = Rounded::sum(chain, logs.iter().copied()) / Rounded::from_f64(count);
        let squares = logs.iter().map(|&log| (log - mean) * (log - mean));
        [mean, Rounded::sum(chain, squares)]
    })
}

fn numbers(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 2] {
    let logs = log_invariants(params, slices.smooth_rows, slices.slope_rows);
    let moments = moments(params, &logs).flatten().collect();
    [logs, moments]
}

// A derivative that almost vanishes has lost its digits to cancellation; W is floored at 1e-5.
bounded_reference!(numbers: logs, moments);
