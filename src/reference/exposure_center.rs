//! Values that are centred over the views.

use crate::gpu::Reference;
use crate::kernels::exposure::EXPOSURE_WIDTH;
use crate::kernels::exposure_center::{BOUND, Constants, Kernel, Params, QUANTA, Slices};

/// The value in whole quanta, within bounds.
fn quanta(x: f32) -> i64 {
    let bound = BOUND as f32;
    (x.clamp(-bound, bound) * QUANTA as f32).round_ties_even() as i64
}

/// Centres every value of (views, `EXPOSURE_WIDTH`) so that its sum over the views is exactly 0.
pub fn center(exposures: &mut [f32]) {
    let width = EXPOSURE_WIDTH as usize;
    let view_count = (exposures.len() / width) as i64;
    for number in 0..width {
        let of_views = || exposures.iter().skip(number).step_by(width);
        let sum: i64 = of_views().map(|&x| quanta(x)).sum();
        let (mean, rest) = (sum.div_euclid(view_count), sum.rem_euclid(view_count));
        for (view, x) in (0..).zip(exposures.iter_mut().skip(number).step_by(width)) {
            let centred = quanta(*x) - mean - i64::from(view < rest);
            *x = centred as f32 / QUANTA as f32;
        }
    }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        if slices.status[0] == 0 {
            center(&mut slices.exposures[..(params.view_count * EXPOSURE_WIDTH) as usize]);
        }
    }
}
