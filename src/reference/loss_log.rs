use crate::gpu::Reference;
use crate::kernels::loss_log::{Constants, Kernel, Params, Slices};
use crate::kernels::status::STATUS_NOT_FINITE;

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { first_partials, second_partials, log, statuses, status }: Slices<'_>,
    ) {
        let row = (params.slot * params.term_count) as usize;
        for (term, partials) in [first_partials, second_partials].into_iter().enumerate() {
            let count = params.partial_counts[term] as usize;
            let sum: f64 = partials[..count].iter().map(|&x| f64::from(x)).sum();
            let mean = (sum * f64::from(params.mean_scales[term])) as f32;
            if count > 0 {
                log[row + params.terms[term] as usize] = mean;
            }
            if !mean.is_finite() {
                status[0] |= STATUS_NOT_FINITE;
            }
        }
        statuses[params.slot as usize] = status[0];
    }
}
