use super::rounding::{Rounded, bounded_reference};
use crate::kernels::reduce_strips::{Constants, Kernel, Params, Slices, Tolerances};

/// Every gradient of the buffer up to the layer's last.
fn gradients(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let (count, offset) = (params.parameter_count as usize, params.offset as usize);
    let before = Rounded::all(&slices.gradients[..offset + count]);
    let after = |(i, gradient): (usize, Rounded)| match i.checked_sub(offset) {
        None => gradient,
        Some(i) => {
            let strips = (0..params.strip_count as usize).map(|strip| strip * count + i);
            let terms = strips.map(|at| Rounded::exact(slices.partials[at]));
            gradient + Rounded::sum(params.strip_count.into(), terms)
        }
    };
    [before.into_iter().enumerate().map(after).collect()]
}

bounded_reference!(gradients: gradients);
