//! The gradient of the lamp's numbers from the partial sums of a view.

use super::lamp::WIDTH;
use super::rounding::{Rounded, chain, values};
use crate::gpu::Reference;
use crate::kernels::lamp_gradient::{Constants, Kernel, Params, Slices, Tolerances};

fn sums(params: &Params, partials: &[f32]) -> Vec<Rounded> {
    let count = params.chunk_count as usize;
    let sum = |number: usize| {
        let own = partials[..count * WIDTH].iter().skip(number).step_by(WIDTH);
        Rounded::sum(chain(count), own.map(|&partial| Rounded::exact(partial)))
    };
    (0..WIDTH).map(sum).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let sums = values(sums(params, slices.partials));
        slices.gradients.iter_mut().zip(sums).for_each(|(to, sum)| *to = sum);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { gradients: sums(params, slices.partials).into_iter().collect() }
    }
}
