use super::inside;
use crate::gpu::Reference;
use crate::kernels::denoising::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    /// The whole sums go into the first partials: how many there are is the device's choice.
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let Slices { denoised, render, d_denoised, d_render, mse_partials, tv_partials } = slices;
        let (width, values) = (params.width as usize, 3 * (params.width * params.height) as usize);
        let counts = |i: usize| {
            inside(i, [params.width, params.height], [params.interior_begin, params.interior_end])
        };
        let [u, v] = [params.mse_weight, params.tv_weight].map(f64::from);
        let (mut d, mut squares, mut tv) = (vec![0.0; values], 0.0, 0.0);
        for i in (0..values).filter(|&i| counts(i)) {
            let difference = f64::from(denoised[i]) - f64::from(render[i]);
            squares += difference * difference;
            d[i] += 2.0 * u * f64::from(params.mean_scale) * difference;
        }
        for i in 0..values {
            d_render[i] = -d[i] as f32;
        }
        for i in (0..values).filter(|&i| counts(i)) {
            let (row, height) = (i / width, params.height as usize);
            let right = (i % width + 1 < width).then_some((i + 1, params.x_scale));
            let below = (row % height + 1 < height).then_some((i + width, params.y_scale));
            for (j, scale) in [right, below].into_iter().flatten().filter(|&(j, _)| counts(j)) {
                let (scale, step) =
                    (f64::from(scale), f64::from(denoised[j]) - f64::from(denoised[i]));
                tv += scale * step * step;
                d[j] += 2.0 * v * scale * step;
                d[i] -= 2.0 * v * scale * step;
            }
        }
        for i in 0..values {
            d_denoised[i] = d[i] as f32;
        }
        mse_partials.fill(0.0);
        tv_partials.fill(0.0);
        (mse_partials[0], tv_partials[0]) = (squares as f32, tv as f32);
    }
}
