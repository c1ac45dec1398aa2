use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference};
use crate::kernels::mask_render::{Constants, Kernel, Params, Slices, Tolerances};

/// Every value written.
fn shown(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
    let pixels = params.pixel_count as usize;
    let value = |i: usize| {
        let [weight, render, target] =
            [slices.weights[i % pixels], slices.render[i], slices.target[i]].map(Rounded::exact);
        let of_target = Rounded::from_f64(1.0) - weight;
        if weight.value >= 1.0 { render } else { weight * render + of_target * target }
    };
    [(0..params.value_count as usize).map(value).collect()]
}

bounded_reference!(shown: shown);
