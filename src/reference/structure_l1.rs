use crate::gpu::Reference;
use crate::kernels::structure_l1::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    /// The whole sum goes into the first partial: how many there are is the device's choice.
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
        partials.fill(0.0);
        partials[0] = sum as f32;
    }
}
