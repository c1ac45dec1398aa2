use super::rounding::{Rounded, chain};
use crate::gpu::{Reference, Tolerance};
use crate::kernels::loss_log::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::status::STATUS_NOT_FINITE;

/// The mean of a term.
fn mean(params: &Params, partials: &[f32], term: usize) -> Rounded {
    let count = params.partial_counts[term] as usize;
    let terms = partials[..count].iter().copied().map(Rounded::exact);
    Rounded::sum(chain(count), terms) * Rounded::exact(params.mean_scales[term])
}

impl Reference for Kernel {
    fn run(
        params: &Params,
        _: &Constants,
        Slices { first_partials, second_partials, log, statuses, status }: Slices<'_>,
    ) {
        let row = (params.slot * params.term_count) as usize;
        for (term, partials) in [first_partials, second_partials].into_iter().enumerate() {
            let mean = mean(params, partials, term).value as f32;
            if params.partial_counts[term] > 0 {
                log[row + params.terms[term] as usize] = mean;
            }
            if !mean.is_finite() {
                status[0] |= STATUS_NOT_FINITE;
            }
        }
        status[3] = status[0];
        statuses[params.slot as usize] = status[0];
    }

    fn tolerances(params: &Params, _: &Constants, slices: Slices<'_>) -> Tolerances {
        let mut log = vec![0.0; slices.log.len()];
        let partials = [slices.first_partials, slices.second_partials];
        for (term, partials) in partials.into_iter().enumerate() {
            if params.partial_counts[term] > 0 {
                let at = params.slot * params.term_count + params.terms[term];
                log[at as usize] = mean(params, partials, term).bound();
            }
        }
        Tolerances { log: Tolerance::Each(log), ..Tolerances::default() }
    }
}
