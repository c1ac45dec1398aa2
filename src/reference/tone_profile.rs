use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::tone_profile::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::{measurable, profiled};

/// Planar, as the target.
fn mapped(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let n = params.pixel_count as usize;
    let white = Rounded::exact(slices.parameters[params.view as usize].white);
    let profile: Vec<Rounded> = slices.profile.iter().map(|&value| Rounded::exact(value)).collect();
    let pixel = |i: usize| {
        let t = |channel: usize| Rounded::exact(measurable(slices.image[channel * n + i])) / white;
        profiled([t(0), t(1), t(2)], &profile)
    };
    let pixels: Vec<_> = (0..n).map(pixel).collect();
    (0..3).flat_map(|channel| pixels.iter().map(move |mapped| mapped[channel])).collect()
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
