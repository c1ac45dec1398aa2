use super::rounding::{Rounded, rounded_tone_curve, values};
use crate::gpu::Reference;
use crate::kernels::tone_map::{Constants, Kernel, Params, Slices, Tolerances};

/// Every value under the view's curve.
fn mapped(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Rounded> {
    let tone = &slices.parameters[params.view as usize];
    let image = slices.image[..params.value_count as usize].iter();
    image.map(|&x| rounded_tone_curve(constants.tone_curve, x, tone)).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let mapped = values(mapped(params, constants, &slices));
        slices.target.iter_mut().zip(mapped).for_each(|(to, y)| *to = y);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { target: mapped(params, constants, &slices).into_iter().collect() }
    }
}
