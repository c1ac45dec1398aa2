use super::densify_scatter::copies;
use super::gaussian::Words;
use crate::gpu::Reference;
use crate::kernels::densify_moments::{Constants, Kernel, Params, Slices};

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (n, new_n) = (params.gaussian_count as usize, params.new_gaussian_count as usize);
        let widths = [params.feature_count, params.column_count];
        let words = |count| Words::new(count, widths, constants.rest_by_column);
        let new = [params.first_new_gaussian, params.new_gaussian_count];
        for copy in copies(n, slices.actions, slices.offsets, new) {
            let from = words(n).of_gaussian(copy.of);
            for (to, from) in words(new_n).of_gaussian(copy.to).zip(from) {
                slices.new_moments[to] = if copy.is_new { 0 } else { slices.moments[from] };
            }
        }
    }
}
