use super::inside;
use super::rounding::{UNIT, chain, write_sum};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::denoising::{Constants, Kernel, Params, Slices, Tolerances};

/// Gradients and sums, in double precision.
struct Terms {
    d_denoised: Vec<f64>,
    d_render: Vec<f64>,
    squares: f64,
    tv: f64,
}

impl Terms {
    /// With sums of magnitudes for the gradients, if `term` returns those of their terms.
    fn new(params: &Params, slices: &Slices<'_>, term: impl Fn(f64) -> f64) -> Self {
        let Slices { denoised, render, .. } = slices;
        let (width, values) = (params.width as usize, 3 * (params.width * params.height) as usize);
        let counts = |i: usize| {
            inside(i, [params.width, params.height], [params.loss_begin, params.loss_end])
        };
        let [u, v] = [params.mse_weight, params.tv_weight].map(f64::from);
        let (mut d, mut squares, mut tv) = (vec![0.0; values], 0.0, 0.0);
        for i in (0..values).filter(|&i| counts(i)) {
            let difference = f64::from(denoised[i]) - f64::from(render[i]);
            squares += difference * difference;
            d[i] += term(2.0 * u * f64::from(params.mean_scale) * difference);
        }
        let d_render = d.iter().map(|d| -d).collect();
        for i in (0..values).filter(|&i| counts(i)) {
            let (row, height) = (i / width, params.height as usize);
            let right = (i % width + 1 < width).then_some((i + 1, params.x_scale));
            let below = (row % height + 1 < height).then_some((i + width, params.y_scale));
            for (j, scale) in [right, below].into_iter().flatten().filter(|&(j, _)| counts(j)) {
                let (scale, step) =
                    (f64::from(scale), f64::from(denoised[j]) - f64::from(denoised[i]));
                tv += scale * step * step;
                d[j] += term(2.0 * v * scale * step);
                d[i] += term(-2.0 * v * scale * step);
            }
        }
        Self { d_denoised: d, d_render, squares, tv }
    }
}

impl Reference for Kernel {
    fn run(params: &Params, _: &Constants, slices: Slices<'_>) {
        let terms = Terms::new(params, &slices, |x| x);
        let Slices { d_denoised, d_render, mse_partials, tv_partials, .. } = slices;
        d_denoised.iter_mut().zip(terms.d_denoised).for_each(|(to, d)| *to = d as f32);
        d_render.iter_mut().zip(terms.d_render).for_each(|(to, d)| *to = d as f32);
        write_sum(std::iter::once(terms.squares), mse_partials);
        write_sum(std::iter::once(terms.tv), tv_partials);
    }

    /// Each term is a product of five factors, and there are five of them.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let terms = Terms::new(params, &slices, f64::abs);
        let bounds = |sums: Vec<f64>| sums.iter().map(|m| 10.0 * UNIT * m.abs()).collect();
        let sum_error = (chain(0) + f64::from(constants.rows) + 6.0) * UNIT;
        Tolerances {
            d_denoised: bounds(terms.d_denoised),
            d_render: bounds(terms.d_render),
            mse_partials: Tolerance::Sum(sum_error * terms.squares),
            tv_partials: Tolerance::Sum(sum_error * terms.tv),
        }
    }
}
