//! From the records of a splat to its Gaussian's share of the camera's gradient, in f64.

use glam::{DMat3, DVec2, DVec3, DVec4};

use super::camera::Camera;
use super::gaussian::{Gaussian, Planes};
use super::project_backward::{rows_backward, splat_gradient, summed_record};
use super::rotation::{rotation, unit_quat};
use super::rounding::{UNIT, sensitivity};
use super::splat::Splat;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::camera::CAMERA_WIDTH;
use crate::kernels::camera_backward::{Constants, Kernel, Params, Slices, Tolerances};

const WIDTH: usize = CAMERA_WIDTH as usize;

/// A Gaussian's share of the gradient of the camera, from the gradients of its mean and of its splat: mean, conic, and
/// the logarithm of the compensation.
pub fn camera_backward(
    camera: &Camera,
    gaussian: &Gaussian,
    d_mean: DVec3,
    conic: DVec3,
    (d_mean2d, d_conic, d_dimming): (DVec2, DVec3, f64),
) -> [f64; WIDTH] {
    let point = camera.view(gaussian.mean);
    let scale = DMat3::from_diagonal(gaussian.log_scale.exp());
    let view_axes = camera.rotation * rotation(unit_quat(gaussian.quat)) * scale;
    let rows = camera.jacobian(point).map(|row| view_axes.transpose() * row);
    let (d_u0, d_u1, _) = rows_backward(conic, rows, (d_conic, d_dimming));
    let d_rows = [view_axes * d_u0, view_axes * d_u1];
    camera.gradient(point, camera.rotation * d_mean, d_mean2d, d_rows)
}

/// The inputs of Gaussian `i` with their error bounds: mean, rotation, scales, conic, the gradient of the mean, the
/// moments of the splat.
fn inputs(params: &Params, constants: &Constants, slices: &Slices<'_>, i: usize) -> [Vec<f64>; 2] {
    const OFF: f64 = 256.0 * UNIT;
    let n = params.gaussian_count as usize;
    let planes = Planes { count: n, feature_count: 0, sh_degree: 0, rest_by_column: false };
    let Gaussian { mean, quat, log_scale, .. } = planes.load(slices.parameters, i);
    let camera = Camera::from(&slices.cameras[params.camera_index as usize]);
    let far = camera.center().length();
    let record =
        summed_record(constants.channels, slices.intersection_ranges[i], slices.gradient_records);
    let own = [mean.to_array().to_vec(), quat.to_array().to_vec(), log_scale.to_array().to_vec()];
    let mut values = own.concat();
    let mut errors: Vec<f64> = values.iter().map(|value| OFF * (value.abs() + 1.0)).collect();
    errors[..3].iter_mut().for_each(|error| *error += OFF * far);
    let conic = slices.splats[i].conic.as_dvec3().to_array();
    let d_mean = (0..3).map(|axis| f64::from(slices.gradients[3 * i + axis]));
    let exact = conic.into_iter().chain(d_mean);
    let summed = record[..6].iter().map(|sum| (sum.value, sum.error));
    for (value, error) in exact.map(|value| (value, 0.0)).chain(summed) {
        values.push(value);
        errors.push(OFF * value.abs() + error);
    }
    [values, errors]
}

fn share(camera: &Camera, antialiased: bool, inputs: &[f64]) -> Vec<f64> {
    let vector = |at: usize| DVec3::from_slice(&inputs[at..]);
    let gaussian = Gaussian {
        mean: vector(0),
        quat: DVec4::from_slice(&inputs[3..]),
        log_scale: vector(7),
        raw_opacity: 0.0,
        features: vec![],
        sh: vec![],
    };
    let splat = Splat { mean2d: DVec2::ZERO, conic: vector(10), opacity: 1.0 };
    // The opacity cancels in the gradient of its logarithm.
    let (d_mean2d, d_conic, d_dimming) = splat_gradient(&splat, &inputs[16..]);
    let arriving = (d_mean2d, d_conic, if antialiased { d_dimming } else { 0.0 });
    camera_backward(camera, &gaussian, vector(13), splat.conic, arriving).to_vec()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let n = params.gaussian_count as usize;
        let camera = Camera::from(&slices.cameras[params.camera_index as usize]);
        slices.shares[..n * WIDTH].fill(0.0);
        for i in (0..n).filter(|&i| slices.tile_counts[i] > 0) {
            let [values, _] = inputs(params, constants, &slices, i);
            for (to, number) in slices.shares[WIDTH * i..].iter_mut().zip(share(
                &camera,
                constants.antialiased,
                &values,
            )) {
                *to = number as f32;
            }
        }
    }

    /// Backward stability, as in `project_backward`.
    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let n = params.gaussian_count as usize;
        let camera = Camera::from(&slices.cameras[params.camera_index as usize]);
        let mut shares = vec![0.0; n * WIDTH];
        for i in (0..n).filter(|&i| slices.tile_counts[i] > 0) {
            let [values, errors] = inputs(params, constants, &slices, i);
            let share = |inputs: &[f64]| share(&camera, constants.antialiased, inputs);
            let exact = share(&values);
            let largest = exact.iter().fold(0.0_f64, |largest, number| largest.max(number.abs()));
            let moved = sensitivity(&values, &errors, share);
            for (to, moved) in shares[WIDTH * i..].iter_mut().zip(moved) {
                *to = moved + 256.0 * UNIT * largest;
            }
        }
        Tolerances { shares: Tolerance::Each(shares) }
    }
}
