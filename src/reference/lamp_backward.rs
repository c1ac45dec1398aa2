//! The sums of the gradients of the lamp's numbers over chunks of Gaussians.

use glam::DVec3;
use nightsplat_models::attributes::Attribute;

use super::camera::ReferenceCamera;
use super::lamp::{ReferenceLamp, WIDTH};
use super::rounding::{Rounded, UNIT, bounds_from, chain, sensitivity, write};
use super::splat::stored_color;
use crate::gpu::Reference;
use crate::kernels::lamp::LAMP_NUMBERS;
use crate::kernels::lamp_backward::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::sh::SH_C0;
use crate::splats::batches::frozen_floats;

/// The numbers before the lamp's among the inputs of a Gaussian: its mean, its lit colour, and the gradient of its DC.
const BEFORE_LAMP: usize = 9;

/// A Gaussian's share of the gradient of the numbers.
fn share(camera: &ReferenceCamera, inputs: &[f64]) -> Vec<f64> {
    let (gaussian, numbers) = inputs.split_at(BEFORE_LAMP);
    let (point, lamp) =
        (camera.view(DVec3::from_slice(gaussian)), ReferenceLamp::from_numbers(numbers));
    let [lit, d_dc] = [3, 6].map(|at| DVec3::from_slice(&gaussian[at..]));
    lamp.gradient(lit, d_dc / SH_C0, point).to_vec()
}

/// The shares of Gaussian `i`, with their rounding errors; `None` if it has none.
fn shares(
    params: &Params,
    constants: &Constants,
    slices: &Slices<'_>,
    i: usize,
) -> Option<Vec<Rounded>> {
    const OFF: f64 = 64.0 * UNIT;
    let vector = |values: &[f32], at: usize| {
        DVec3::from_array([0, 1, 2].map(|axis| f64::from(values[at + axis])))
    };
    let count = params.gaussian_count as usize;
    let dc = Attribute::Dc.column(0) * count - frozen_floats(constants.frozen_columns, count);
    let d_dc = vector(slices.gradients, dc + 3 * i);
    if d_dc == DVec3::ZERO {
        return None;
    }
    let camera = ReferenceCamera::from(&slices.cameras[params.camera_index as usize]);
    let color = vector(slices.colors, stored_color(constants.channels) * i);
    let mean = vector(slices.parameters, 3 * i);
    let lamp = ReferenceLamp::from_numbers(slices.lamp);
    let mut inputs = [mean, color, d_dc].map(|vector| vector.to_array()).concat();
    let far = DVec3::splat(mean.length() + camera.center().length());
    let mut errors = [far, DVec3::ONE + color.abs(), d_dc.abs()]
        .map(|vector| (OFF * vector).to_array())
        .concat();
    for &number in &slices.lamp[..LAMP_NUMBERS as usize] {
        inputs.push(number.into());
        errors.push(OFF * (1.0 + f64::from(number.abs())));
    }
    let moved = sensitivity(&inputs, &errors, |inputs| share(&camera, inputs));
    let relative = OFF + lamp.factor_error(camera.view(mean));
    // A number whose terms cancel has the errors of these.
    let values = share(&camera, &inputs);
    let largest = values.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let of = |(value, moved): (f64, f64)| Rounded { value, error: moved + relative * largest };
    Some(values.into_iter().zip(moved).map(of).collect())
}

fn sums(params: &Params, constants: &Constants, slices: &Slices<'_>) -> Vec<Rounded> {
    let (count, chunk) = (params.gaussian_count as usize, constants.chunk as usize);
    let of_chunk = |first: usize| {
        let indices = first..(first + chunk).min(count);
        let all: Vec<_> = indices.filter_map(|i| shares(params, constants, slices, i)).collect();
        let sum = move |n| Rounded::sum(chain(chunk), all.iter().map(|shares| shares[n]));
        (0..WIDTH).map(sum).collect::<Vec<_>>()
    };
    (0..count).step_by(chunk).flat_map(of_chunk).collect()
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, slices: Slices<'_>) {
        let sums = sums(params, constants, &slices);
        write(sums, &mut slices.partials[WIDTH * params.first_chunk as usize..]);
    }

    fn tolerances(params: &Params, constants: &Constants, slices: Slices<'_>) -> Tolerances {
        let sums = sums(params, constants, &slices);
        Tolerances { partials: bounds_from(WIDTH * params.first_chunk as usize, sums) }
    }
}
