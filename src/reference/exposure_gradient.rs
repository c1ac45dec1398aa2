use nightsplat_photographs::tone::Real;

use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::exposure::{BIAS_SCALE, EXPOSURE_WIDTH};
use crate::kernels::exposure_gradient::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of every number of every view.
fn gradients(params: &Params, _: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 1] {
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
        gradients[view * width + channel + 3] = Rounded::from_f64(BIAS_SCALE) * sum(1);
    }
    [gradients]
}

bounded_reference!(gradients: gradients);
