use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::mask_render::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::Real;

/// Every value written.
fn shown<'a>(params: &Params, slices: &'a Slices<'_>) -> impl Iterator<Item = Rounded> + 'a {
    let pixels = params.pixel_count as usize;
    (0..params.value_count as usize).map(move |i| {
        let (weight, render) = (slices.weights[i % pixels], Rounded::exact(slices.render[i]));
        if weight >= 1.0 {
            return render;
        }
        let target = Rounded::exact(slices.target[i]);
        let weight = Rounded::exact(weight);
        weight * render + (Rounded::of(1.0) - weight) * target
    })
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let shown: Vec<f32> = values(shown(params, &slices)).collect();
        slices.shown[..shown.len()].copy_from_slice(&shown);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { shown: shown(params, &slices).collect() }
    }
}
