use super::rounding::{UNIT, chain, write_sum};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::structure_l1::{Constants, Kernel, Params, Slices, Tolerances};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { render, structure, d_render, partials }: Slices<'_>,
    ) {
        let mut sum = 0.0;
        for i in 0..params.pixel_count as usize {
            let p = render[params.first as usize + i];
            let difference = p.clamp(0.0, 1.0) - structure[i];
            let passes = (0.0..=1.0).contains(&p) && difference != 0.0;
            let sign = if passes { difference.signum() } else { 0.0 };
            d_render[params.first as usize + i] = params.scale * sign;
            sum += f64::from(difference.abs());
        }
        write_sum(std::iter::once(sum), partials);
    }

    /// The gradient is a sign; each difference rounds once, then in the sum.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let plane = &slices.render[params.first as usize..][..params.pixel_count as usize];
        let differences =
            plane.iter().zip(slices.structure).map(|(p, s)| (p.clamp(0.0, 1.0) - s).abs());
        let sum: f64 = differences.map(f64::from).sum();
        let chain = chain(0) + f64::from(constants.values_per_thread) + 2.0;
        Tolerances { partials: Tolerance::Sum(chain * UNIT * sum), ..Tolerances::default() }
    }
}
