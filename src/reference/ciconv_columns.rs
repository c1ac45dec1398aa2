//! `CIConv` in double precision: the columns pass and the invariant.

use glam::{Vec2, Vec3};

use super::ciconv_rows::{correlate, taps};
use crate::gpu::Reference;
use crate::kernels::ciconv_columns::{Constants, EPSILON, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let (width, height) = (params.width as usize, params.height as usize);
        let [smooth, slope] = taps();
        let mut logs = vec![0.0; width * height];
        for i in 0..logs.len() {
            let at = |rows: &[Vec3], channel: usize, u: isize| {
                let y = (i / width).checked_add_signed(u).filter(|&y| y < height)?;
                Some(f64::from(rows[y * width + i % width][channel]))
            };
            let along = |rows, channel, taps| correlate(taps, |u| at(rows, channel, u));
            let e = along(slices.smooth_rows, 0, &smooth);
            let squares = (0..3).map(|channel| {
                let x = along(slices.slope_rows, channel, &smooth) / (e + EPSILON);
                let y = along(slices.smooth_rows, channel, &slope) / (e + EPSILON);
                x * x + y * y
            });
            logs[i] = (squares.sum::<f64>() + EPSILON).ln();
            slices.logs[i] = logs[i] as f32;
        }
        let chunks = logs.chunks(params.pixels_per_moment as usize);
        for (logs, moments) in chunks.zip(slices.moments) {
            let mean = logs.iter().sum::<f64>() / logs.len() as f64;
            let squares: f64 = logs.iter().map(|log| (log - mean).powi(2)).sum();
            *moments = Vec2::new(mean as f32, squares as f32);
        }
    }
}
