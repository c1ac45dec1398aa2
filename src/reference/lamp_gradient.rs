//! The gradient of the lamp's numbers from the partial sums of a view.

use super::lamp::WIDTH;
use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::lamp_gradient::{Constants, Kernel, Params, Slices, Tolerances};

fn sums(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let count = params.chunk_count as usize;
    let sum = |number: usize| {
        let partials = slices.partials[..count * WIDTH].iter().skip(number).step_by(WIDTH);
        Rounded::sum(chain(count), partials.map(|&partial| Rounded::exact(partial)))
    };
    [(0..WIDTH).map(sum).collect()]
}

bounded_reference!(sums: gradients);
