use glam::DVec3;

use super::adam::{bounded, stepped};
use super::camera::ReferenceCamera;
use super::gaussian::Planes;
use super::rounding::{Rounded, UNIT};
use super::sh::sh_basis;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::adam_gaussian::{Constants, Kernel, Params, Slices, Tolerances};
use crate::splats::attributes::{Attribute, planes};
use crate::splats::batches::frozen_floats;

/// The number with this place in the planes, of plane `plane`, and its gradient.
struct Update {
    at: usize,
    /// Among the planes that are trained.
    trained: usize,
    plane: usize,
    gradient: f32,
    /// Of the gradient.
    error: f64,
}

/// The numbers that a step updates.
fn updates(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Update> {
    let Slices { parameters, gradients, status, cameras, .. } = slices;
    if status[0] != 0 {
        return vec![];
    }
    let Constants { sh_degree, feature_count, rest_by_column, frozen_columns } = *constants;
    let count = params.gaussian_count as usize;
    let layout = Planes { count, feature_count: feature_count as usize, sh_degree, rest_by_column };
    let camera = ReferenceCamera::from(&cameras[params.camera_index as usize]);
    let left_out = frozen_floats(frozen_columns, count);
    let of_gaussian = |i: usize| {
        let numbers: Vec<usize> = layout.indices(i).collect();
        let planes = planes(layout.feature_count, numbers.len());
        let before_rest = planes[Attribute::Rest as usize].column;
        let mean = DVec3::from_array([0, 1, 2].map(|axis| parameters[numbers[axis]].into()));
        let offset = mean - camera.center();
        let basis = sh_basis(params.sh_degree, offset.normalize_or_zero());
        // The direction has the error of the difference.
        let far = (mean.length() + camera.center().length()) / offset.length().max(1e-12);
        let update = |column: usize| {
            let plane = planes.iter().rposition(|plane| plane.width > 0 && column >= plane.column);
            let (at, plane) = (numbers[column], plane.unwrap_or_default());
            let trained = at - left_out;
            if column < before_rest {
                return Update { at, trained, plane, gradient: gradients[trained], error: 0.0 };
            }
            let (coefficient, channel) = ((column - before_rest) / 3 + 1, column % 3);
            let channel = (channel + 3 - before_rest % 3) % 3;
            let d_color = f64::from(gradients[numbers[before_rest + channel] - left_out]);
            let error = 256.0 * UNIT * d_color.abs() * (1.0 + far);
            // Beyond the degree in use, the basis is zero.
            let is_used = coefficient < (params.sh_degree as usize + 1).pow(2);
            Update {
                at,
                trained,
                plane,
                gradient: (basis[coefficient] * d_color) as f32,
                error: if is_used { error } else { 0.0 },
            }
        };
        let columns = if params.sh_degree == 0 { before_rest } else { numbers.len() };
        (frozen_columns as usize..columns).map(update).collect::<Vec<_>>()
    };
    (0..count).flat_map(of_gaussian).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        for Update { at, trained, plane, gradient, .. } in updates(params, constants, &slices) {
            let before = [
                slices.parameters[at],
                gradient,
                slices.first_moments[trained],
                slices.second_moments[trained],
            ];
            let rates = [params.rates[plane], params.second_correction];
            let [p, m, v] = bounded(plane, stepped::<f64>(rates, before));
            slices.parameters[at] = p as f32;
            (slices.first_moments[trained], slices.second_moments[trained]) = (m as f32, v as f32);
        }
    }

    /// Those of `adam`, and the change by an error of the gradient.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let mut bounds = [(); 3].map(|()| vec![0.0; slices.parameters.len()]);
        for Update { at, trained, plane, gradient, error } in updates(params, constants, &slices) {
            let [p, m, v] = [
                slices.parameters[at],
                slices.first_moments[trained],
                slices.second_moments[trained],
            ];
            let rates = [params.rates[plane], params.second_correction];
            let rounded = bounded(plane, stepped::<Rounded>(rates, [p, gradient, m, v]));
            let of = |gradient: f32| stepped::<f64>(rates, [p, gradient, m, v]);
            let expected = of(gradient);
            let moved = [-error, error].map(|by| of((f64::from(gradient) + by) as f32));
            for which in 0..3 {
                let change = |moved: [f64; 3]| (moved[which] - expected[which]).abs();
                bounds[which][[at, trained, trained][which]] =
                    2.0 * rounded[which].error + moved.map(change).into_iter().fold(0.0, f64::max);
            }
        }
        let [parameters, first_moments, second_moments] = bounds.map(Tolerance::Each);
        Tolerances { parameters, first_moments, second_moments }
    }
}
