use super::real::Real;
use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::tone_table::{Constants, Kernel, Params, Slices, Tolerances};

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

/// Every value on its channel's curve.
fn mapped(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let (pixels, count) = (params.pixel_count as usize, params.knot_count as usize);
    let white = Rounded::exact(slices.parameters[params.view as usize].white);
    let knots: Vec<_> =
        slices.knots.iter().map(|knot| knot.to_array().map(Rounded::exact)).collect();
    let value = |i: usize| {
        let of_channel = &knots[i / pixels * count..][..count];
        let y = interpolate(of_channel, Rounded::exact(slices.image[i]) / white);
        y.at_least(Rounded::of(0.0)).at_most(Rounded::of(1.0))
    };
    (0..3 * pixels).map(value).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let mapped = values(mapped(params, &slices));
        slices.target.iter_mut().zip(mapped).for_each(|(to, y)| *to = y);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { target: mapped(params, &slices).into_iter().collect() }
    }
}
