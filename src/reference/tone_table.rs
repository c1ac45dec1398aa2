use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::tone_table::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::{Real, interpolate};

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
