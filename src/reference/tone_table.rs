use crate::gpu::Reference;
use crate::kernels::tone_table::{Constants, Kernel, Params, Slices};
use crate::tone::{clamped, interpolate};

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { image, parameters, knots, target }: Slices<'_>,
    ) {
        let white = parameters[params.view as usize].white;
        let knots: Vec<[f32; 3]> = knots.iter().map(|knot| knot.to_array()).collect();
        for i in 0..3 * params.pixel_count as usize {
            let channel = i / params.pixel_count as usize;
            let of_channel =
                &knots[channel * params.knot_count as usize..][..params.knot_count as usize];
            target[i] = clamped(interpolate(of_channel, image[i] / white));
        }
    }
}
