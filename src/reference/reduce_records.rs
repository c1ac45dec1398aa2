use super::rounding::{UNIT, chain};
use super::splat::stored_record;
use crate::gpu::{Reference, Tolerance};
use crate::kernels::reduce_records::{Constants, Kernel, Params, Slices, Tolerances};
use crate::kernels::shared_slots::SHARED_SLOTS;

/// Calls `add` with every number of every Gaussian, the slots of the Gaussian, and where the slot has the number.
fn for_each_number(
    params: &Params,
    constants: &Constants,
    slices: &mut Slices<'_>,
    mut add: impl FnMut(&mut f32, &mut dyn Iterator<Item = f32>, usize),
) {
    let record = stored_record(constants.channels);
    let records: &[f32] = bytemuck::cast_slice(slices.records);
    let d_splats: &mut [f32] = bytemuck::cast_slice_mut(slices.d_splats);
    for i in 0..params.gaussian_count as usize {
        let range = slices.emitted[i];
        for k in 0..record {
            let slots = range.x as usize..range.y as usize;
            let count = slots.len();
            let mut numbers = slots.map(|slot| records[record * slot + k]);
            add(&mut d_splats[record * i + k], &mut numbers, count);
        }
    }
}

impl Reference for Kernel {
    fn run(params: &Params, constants: &Constants, mut slices: Slices<'_>) {
        for_each_number(params, constants, &mut slices, |d_splat, numbers, count| {
            // In f32 what the kernel adds up in this very order.
            *d_splat = match count as u32 {
                0..=SHARED_SLOTS => numbers.fold(0.0, |sum, number| sum + number),
                _ => numbers.map(f64::from).sum::<f64>() as f32,
            };
        });
    }

    /// The lanes of a subgroup add up the slots of a Gaussian that has many, in an order that is the device's.
    fn tolerances(params: &Params, constants: &Constants, mut slices: Slices<'_>) -> Tolerances {
        let mut bounds = vec![];
        for_each_number(params, constants, &mut slices, |_, numbers, count| {
            bounds.push(match count as u32 {
                0..=SHARED_SLOTS => 0.0,
                _ => {
                    UNIT * chain(count) * numbers.map(|number| f64::from(number.abs())).sum::<f64>()
                }
            });
        });
        Tolerances { d_splats: Tolerance::Each(bounds) }
    }
}
