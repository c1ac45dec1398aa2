use super::rounding::{Rounded, chain, values};
use crate::gpu::Reference;
use crate::kernels::exposure::{BIAS_SCALE, EXPOSURE_WIDTH};
use crate::kernels::exposure_gradient::{Constants, Kernel, Params, Slices, Tolerances};
use crate::photographs::tone::Real;

/// The gradient of every number of every view.
fn gradients(params: &Params, slices: &Slices<'_>) -> Vec<Rounded> {
    let (chunks, view) = (params.chunk_count as usize, params.view as usize);
    let width = EXPOSURE_WIDTH as usize;
    let mut gradients = vec![Rounded::default(); params.view_count as usize * width];
    for channel in 0..3 {
        let of_channel = &slices.partials[channel * chunks..][..chunks];
        let sum = |which: usize| {
            let terms = of_channel.iter().map(|partial| Rounded::exact(partial[which]));
            Rounded::sum(chain(chunks), terms)
        };
        gradients[view * width + channel] = sum(0);
        gradients[view * width + channel + 3] = Rounded::of(BIAS_SCALE) * sum(1);
    }
    gradients
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let gradients = values(gradients(params, &slices));
        slices.gradients.iter_mut().zip(gradients).for_each(|(to, gradient)| *to = gradient);
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        Tolerances { gradients: gradients(params, &slices).into_iter().collect() }
    }
}
