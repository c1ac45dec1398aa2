use super::real::Real;
use super::tone::clamped;
use crate::gpu::Reference;
use crate::kernels::tone_table::{Constants, Kernel, Params, Slices};

/// The cubic Hermite curve through knots (x, y, slope); beyond the ends it is constant.
pub(crate) fn interpolate<T: Real>(knots: &[[T; 3]], x: T) -> T {
    let [first, last] = [knots[0], knots[knots.len() - 1]];
    // Positive phrasing: a NaN counts as the lower end.
    let x = if x > first[0] { x.at_most(last[0]) } else { first[0] };
    let upper = knots.partition_point(|knot| knot[0] <= x).min(knots.len() - 1);
    let ([x0, y0, d0], [x1, y1, d1]) = (knots[upper - 1], knots[upper]);
    let width = x1 - x0;
    let s = (x - x0) / width;
    let rise = y1 - y0;
    let (a, b) = (width * d0 - rise, rise - width * d1);
    let left = T::of(1.0) - s;
    y0 + rise * s + s * left * (a * left + b * s)
}

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { image, parameters, knots, target }: Slices<'_>,
    ) {
        let white = parameters[params.view as usize].white;
        let knots: Vec<[f32; 3]> = knots.iter().map(|knot| knot.to_array()).collect();
        for i in 0..3 * params.pixel_count as usize {
            let channel = i / params.pixel_count as usize;
            let of_channel =
                &knots[channel * params.knot_count as usize..][..params.knot_count as usize];
            target[i] = clamped(interpolate(of_channel, image[i] / white));
        }
    }
}
