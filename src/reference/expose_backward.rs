use glam::Vec2;

use super::expose::{gain_and_bias, is_clipped};
use super::rounding::{Rounded, chain, values};
use crate::gpu::Reference;
use crate::kernels::expose_backward::{Constants, Kernel, Params, Slices, Tolerances};

/// The gradient of the render, and both sums of every chunk of every channel.
fn backward(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
) -> (Vec<Rounded>, Vec<[Rounded; 2]>) {
    let (pixels, chunk) = (params.pixel_count as usize, constants.chunk as usize);
    let exposures: Vec<Rounded> = slices.exposures.iter().copied().map(Rounded::exact).collect();
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
        for ((c, d), own) in chunks {
            let products = c.iter().zip(own).map(|(&c, &own)| Rounded::exact(c) * own);
            let of_render = Rounded::sum(chain(chunk), products);
            let alone = Rounded::sum(chain(chunk), d.iter().copied().map(Rounded::exact));
            partials.push([of_render, alone]);
        }
        d_render.extend(of_render);
    }
    (d_render, partials)
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (d_render, partials) = backward(params, constants, &slices);
        slices.d_render.iter_mut().zip(values(d_render)).for_each(|(to, d)| *to = d);
        for (partial, sums) in slices.partials.iter_mut().zip(partials) {
            *partial = Vec2::from_array(sums.map(|sum| sum.value as f32));
        }
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let (d_render, partials) = backward(params, constants, &slices);
        Tolerances {
            d_render: d_render.into_iter().collect(),
            partials: partials.into_iter().flatten().collect(),
        }
    }
}
