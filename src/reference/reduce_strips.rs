use super::rounding::{Rounded, values};
use crate::gpu::Reference;
use crate::kernels::reduce_strips::{Constants, Kernel, Params, Slices, Tolerances};

/// Every gradient of the buffer up to the layer's last.
fn gradients(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let (count, offset) = (params.parameter_count as usize, params.offset as usize);
    let before = slices.gradients[..offset + count].iter().copied().map(Rounded::exact);
    let after = before.enumerate().map(|(i, gradient)| match i.checked_sub(offset) {
        None => gradient,
        Some(i) => {
            let strips = (0..params.strip_count as usize).map(|strip| strip * count + i);
            let terms = strips.map(|at| Rounded::exact(slices.partials[at]));
            gradient + Rounded::sum(params.strip_count.into(), terms)
        }
    });
    after.collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let after = values(gradients(params, &slices));
        slices.gradients.iter_mut().zip(after).for_each(|(gradient, after)| *gradient = after);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { gradients: gradients(params, &slices).into_iter().collect() }
    }
}
