use super::inside;
use super::rounding::{Rounded, chain, rounded_tone_curve};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::l1::{Constants, Kernel, Params, Slices, Tolerances};

/// a - b of every value; 0 outside the interior.
fn differences(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> impl Iterator<Item = Rounded> {
    let interior = [params.interior_begin, params.interior_end];
    (0..params.value_count as usize).map(move |i| {
        let target = rounded_tone_curve(constants.tone_curve, slices.low[i], &slices.tone[0]);
        let counts = !constants.with_interior || inside(i, [params.width, params.height], interior);
        if counts { Rounded::exact(slices.render[i]) - target } else { Rounded::default() }
    })
}

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let differences: Vec<Rounded> = differences(params, constants, &slices).collect();
        for (d, difference) in slices.d_render.iter_mut().zip(&differences) {
            let difference = difference.value;
            let sign = if difference == 0.0 { 0.0 } else { difference.signum() };
            *d = params.l1_scale * sign as f32;
        }
        slices.partials.fill(0.0);
        slices.partials[0] = differences.iter().map(|d| d.value.abs()).sum::<f64>() as f32;
    }

    /// The sign may be the other one where a rounding of the curve decides.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let flip = 2.0 * f64::from(params.l1_scale.abs());
        let either = |d: &Rounded| if d.may_cross(0.0) { flip } else { 0.0 };
        let differences: Vec<Rounded> = differences(params, constants, &slices).collect();
        let chain = chain(0) + f64::from(constants.values_per_thread);
        let sum = Rounded::sum(chain, differences.iter().map(|d| d.abs()));
        Tolerances {
            d_render: Tolerance::Each(differences.iter().map(either).collect()),
            partials: Tolerance::Sum(sum.bound()),
        }
    }
}
