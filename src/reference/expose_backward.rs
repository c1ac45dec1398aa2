use super::expose::{gain_and_bias, is_clipped};
use super::rounding::{Rounded, bounded_reference, chain};
use crate::kernels::expose_backward::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of the render, and both sums of every chunk of every channel.
fn backward(params: &Params, constants: &Constants, slices: &Slices<'_>) -> [Vec<Rounded>; 2] {
    let (pixels, chunk) = (params.pixel_count as usize, constants.chunk as usize);
    let exposures = Rounded::all(slices.exposures);
    let (mut d_render, mut partials) = (vec![], vec![]);
    for channel in 0..3 {
        let [gain, _] = gain_and_bias(&exposures, params.view as usize, channel);
        let plane = channel * pixels..(channel + 1) * pixels;
        let white = slices.whites[3 * params.view as usize + channel];
        let passed = |i: usize| {
            let target = slices.target[i];
            let is_bound = slices.exposed[i] >= target && is_clipped(target, white);
            if is_bound { 0.0 } else { slices.d_render[i] }
        };
        let c = &slices.render[plane.clone()];
        let d: Vec<f32> = plane.map(passed).collect();
        let of_render: Vec<Rounded> = d.iter().map(|&d| gain * Rounded::exact(d)).collect();
        let chunks = c.chunks(chunk).zip(d.chunks(chunk)).zip(of_render.chunks(chunk));
        for ((c, d), of_render) in chunks {
            let products = c.iter().zip(of_render).map(|(&c, &d)| Rounded::exact(c) * d);
            partials.push(Rounded::sum(chain(chunk), products));
            partials.push(Rounded::sum(chain(chunk), Rounded::all(d)));
        }
        d_render.extend(of_render);
    }
    [d_render, partials]
}

bounded_reference!(backward: d_render, partials);
