use crate::gpu::Reference;
use crate::kernels::reduce_strips::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, Slices { partials, gradients }: Slices<'_>) {
        let count = params.parameter_count as usize;
        for i in 0..count {
            let of_strip = |strip| f64::from(partials[strip * count + i]);
            let sum: f64 = (0..params.strip_count as usize).map(of_strip).sum();
            let gradient = &mut gradients[params.offset as usize + i];
            *gradient = (f64::from(*gradient) + sum) as f32;
        }
    }
}
