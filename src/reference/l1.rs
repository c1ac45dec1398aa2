use super::inside;
use super::rounding::{Rounded, chain, sum_tolerance, write_sum};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::l1::{Constants, Kernel, Params, Slices, Tolerances};

/// a - b of every value; 0 outside the loss region.
fn differences(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> impl Iterator<Item = Rounded> {
    let loss_region = [params.loss_begin, params.loss_end];
    (0..params.value_count as usize).map(move |i| {
        let target = Rounded::exact(slices.target[i]);
        let counts =
            !constants.with_loss_region || inside(i, [params.width, params.height], loss_region);
        if counts { Rounded::exact(slices.render[i]) - target } else { Rounded::default() }
    })
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let differences: Vec<Rounded> = differences(params, constants, &slices).collect();
        for (d, difference) in slices.d_render.iter_mut().zip(&differences) {
            let difference = difference.value;
            let sign = if difference == 0.0 { 0.0 } else { difference.signum() };
            let gradient = params.l1_scale * sign as f32;
            *d = if constants.adds { *d + gradient } else { gradient };
        }
        write_sum(differences.iter().map(|d| d.value.abs()), slices.partials);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let differences = differences(params, constants, &slices);
        let chain = chain(0) + f64::from(constants.values_per_thread);
        let partials = sum_tolerance(chain, differences.map(Rounded::abs));
        Tolerances { d_render: Tolerance::Exact, partials }
    }
}
