use super::densify_scatter::copies;
use crate::gpu::Reference;
use crate::kernels::densify_moments::{Constants, Kernel, Params, Slices};
use crate::splats::attributes::planes;

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let (n, new_n) = (params.gaussian_count as usize, params.new_gaussian_count as usize);
        let [features, columns] = [params.feature_count, params.column_count].map(|n| n as usize);
        let new = [params.first_new_gaussian, params.new_gaussian_count];
        for copy in copies(n, slices.actions, slices.offsets, new) {
            for plane in planes(features, columns) {
                let word = |n, i, k| plane.index(constants.rest_by_column, n, i, k);
                for k in 0..plane.width {
                    let moment = slices.moments[word(n, copy.of, k)];
                    slices.new_moments[word(new_n, copy.to, k)] =
                        if copy.is_new { 0 } else { moment };
                }
            }
        }
    }
}
