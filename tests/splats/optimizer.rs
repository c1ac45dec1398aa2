//! Adam: the kernel against its reference, its guards, and a minimisation.

use nightsplat::gpu::{Buffer, Reference};
use nightsplat::kernels::adam;
use nightsplat::splats::optimizer::{
    Adam, AdamBuffers, AdamStep, FiniteCheck, LearningRates, Schedule,
};
use nightsplat_models::attributes::Attribute;
use nightsplat_models::attributes::PlaneCounts;

use crate::common::prelude::*;

/// Two features and SH of degree 1.
const COLUMNS: u32 = 25;
const FEATURES: u32 = 2;
/// Two Gaussians without features or SH beyond degree 0.
const PLANES: PlaneCounts = PlaneCounts { gaussians: 2, columns: 14, features: 0 };
/// Learning rates of means, quats, log scales, raw opacities, dc, features, rest.
const RATES: LearningRates = LearningRates([0.01, 0.02, 0.03, 0.04, 0.05, 0.015, 0.06]);

fn planes([gaussians, columns]: [u32; 2]) -> PlaneCounts {
    let [gaussians, columns] = [gaussians as usize, columns as usize];
    PlaneCounts { gaussians, columns, features: FEATURES as usize }
}

/// Parameters, gradients and both moments of one step in host memory.
#[derive(Clone)]
struct Planes {
    parameters: Vec<f32>,
    gradients: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
}

impl Planes {
    fn new(gaussian_count: u32) -> Self {
        let wave = |scale: f32, phase: f32| {
            (0..gaussian_count * COLUMNS)
                .map(|i| scale * (i as f32 * 0.7 + phase).sin())
                .collect::<Vec<_>>()
        };
        let second = wave(1e-3, 0.5).iter().map(|m| m * m).collect();
        Self {
            parameters: wave(2.0, 0.0),
            gradients: wave(1e-3, 1.0),
            first: wave(1e-4, 2.0),
            second,
        }
    }

    /// The parameters from the first, and what a step has of the columns from another float on.
    fn upload(&self, trained: usize) -> OnDevice {
        let upload = |name: &str, data: &[f32]| gpu().buffer(name, data).unwrap();
        let (first, second) = (upload("first", &self.first[trained..]), &self.second[trained..]);
        OnDevice {
            parameters: upload("parameters", &self.parameters),
            gradients: upload("gradients", &self.gradients[trained..]),
            moments: Moments::Single { first, second: upload("second", second) },
        }
    }

    /// One step on the device.
    fn step(&mut self, step: u64, columns: [u32; 2], status: u32) {
        let (gpu, mut on_device) = (gpu(), self.upload(0));
        let status = gpu.buffer("status", &[status]).unwrap();
        let adam = Adam::new(&gpu).unwrap();
        gpu.run("adam", |pass| {
            let step = AdamStep { step, rates: &RATES, status: &status };
            adam.record(pass, step, planes(columns), on_device.buffers())
        })
        .unwrap();
        [self.parameters, self.first, self.second] = on_device.read();
    }

    /// The same step in the reference.
    fn reference_step(&mut self, step: i32, [gaussian_count, column_count]: [u32; 2]) {
        let first_correction = 1.0 / (1.0 - 0.9f64.powi(step));
        let rate = |rate: f64| (rate * first_correction) as f32;
        let params = adam::Params {
            gaussian_count,
            column_count,
            feature_count: FEATURES,
            second_correction: (1.0 / (1.0 - 0.999f64.powi(step)).sqrt()) as f32,
            rates: RATES.0.map(rate),
        };
        let slices = adam::Slices {
            parameters: &mut self.parameters,
            gradients: &self.gradients,
            first_moments: &mut self.first,
            second_moments: &mut self.second,
            status: &[0],
        };
        adam::Kernel::run(&params, &adam::Constants::default(), slices);
    }

    fn bits(&self) -> Vec<u32> {
        [&self.parameters, &self.first, &self.second]
            .into_iter()
            .flatten()
            .map(|x| x.to_bits())
            .collect()
    }
}

struct OnDevice {
    parameters: Buffer<f32>,
    gradients: Buffer<f32>,
    moments: Moments,
}

impl OnDevice {
    fn buffers(&mut self) -> AdamBuffers<'_> {
        AdamBuffers {
            parameters: self.parameters.slice_mut(),
            gradients: self.gradients.slice(),
            moments: self.moments.slice_mut(),
        }
    }

    /// The parameters and both moments.
    fn read(&self) -> [Vec<f32>; 3] {
        let Moments::Single { first, second } = &self.moments else { panic!("{:?}", self.moments) };
        [&self.parameters, first, second].map(|planes| gpu().read(planes).unwrap())
    }
}

#[test]
fn adam_matches_its_reference() {
    for gaussian_count in [0, 1, 255, 1024, 1025, 3001] {
        for (step, column_count) in [(1, COLUMNS), (7, COLUMNS), (1000, 14)] {
            let mut expected = Planes::new(gaussian_count);
            let mut actual = expected.clone();
            expected.reference_step(step, [gaussian_count, column_count]);
            actual.step(step as u64, [gaussian_count, column_count], 0);
            // Division and square root are within a few ulp, and steps are at most one unit.
            let pairs = [
                (&actual.parameters, &expected.parameters, 4e-6),
                (&actual.first, &expected.first, 1e-9),
                (&actual.second, &expected.second, 1e-12),
            ];
            for (actual, expected, tolerance) in pairs {
                for (i, (a, b)) in actual.iter().zip(expected).enumerate() {
                    assert!(
                        (a - b).abs() <= tolerance,
                        "{gaussian_count} Gaussians, float {i}: {a} {b}"
                    );
                }
            }
        }
    }
}

/// A vector of four can begin in a frozen column.
#[test]
fn frozen_columns_have_no_moments_and_keep_their_parameters() {
    let gpu = gpu();
    let status = gpu.buffer("status", &[0]).unwrap();
    for (frozen, gaussian_count) in [(3, 1), (10, 3), (11, 2), (11, 1025), (14, 7)] {
        let adam = Adam::with_frozen(&gpu, frozen).unwrap();
        let before = Planes::new(gaussian_count);
        let begin = (frozen * gaussian_count) as usize;
        let trained = begin / 4 * 4;
        let mut on_device = before.upload(trained);
        let planes = planes([gaussian_count, COLUMNS]);
        let (done, report) = gpu.checked(|| {
            gpu.run("adam", |pass| {
                let step = AdamStep { step: 3, rates: &RATES, status: &status };
                adam.record_trained(pass, step, planes, on_device.buffers())
            })
        });
        done.unwrap();
        report.agree().unwrap();
        let mut expected = before.clone();
        expected.step(3, [gaussian_count, COLUMNS], 0);
        let [stepped, first, second] = on_device.read();
        assert!(stepped[..begin] == before.parameters[..begin]);
        assert!(stepped[begin..] == expected.parameters[begin..]);
        let shared = begin % 4;
        assert!(first[shared..] == expected.first[begin..]);
        assert!(second[shared..] == expected.second[begin..]);
        // Those of frozen parameters in the first vector.
        assert!(first[..shared] == before.first[trained..][..shared]);
    }
}

#[test]
fn the_first_step_moves_every_attribute_by_its_own_learning_rate() {
    let count = 5;
    let mut planes = Planes::new(count);
    planes.first.fill(0.0);
    planes.second.fill(0.0);
    let before = planes.clone();
    planes.step(1, [count, COLUMNS], 0);
    for (columns, attribute) in [
        ([0, 2], Attribute::Means),
        ([3, 6], Attribute::Quats),
        ([7, 9], Attribute::LogScales),
        ([10, 10], Attribute::RawOpacities),
        ([11, 13], Attribute::Dc),
        ([14, 13 + FEATURES], Attribute::Features),
        ([14 + FEATURES, COLUMNS - 1], Attribute::Rest),
    ] {
        for column in columns {
            for i in (column * count) as usize..((column + 1) * count) as usize {
                let step = RATES[attribute] as f32 * before.gradients[i].signum();
                let off = (planes.parameters[i] - (before.parameters[i] - step)).abs();
                assert!(off < 1e-5, "column {column}");
            }
        }
    }
}

#[test]
fn columns_beyond_the_count_do_not_change() {
    let mut planes = Planes::new(10);
    let before = planes.clone();
    planes.step(3, [10, 14], 0);
    assert_eq!(planes.parameters[140..], before.parameters[140..]);
    assert_eq!(planes.first[140..], before.first[140..]);
    assert_ne!(planes.parameters[139], before.parameters[139]);
}

#[test]
fn nothing_changes_while_the_status_is_set() {
    let mut planes = Planes::new(300);
    let before = planes.bits();
    planes.step(3, [300, COLUMNS], 4);
    assert!(planes.bits() == before);
}

/// Without the guard, a NaN would stay in the moments forever, and an infinite second moment would freeze its
/// parameter.
#[test]
fn a_gradient_that_is_not_finite_counts_as_zero() {
    let mut expected = Planes::new(64);
    for i in [0, 200, 700, 1000] {
        expected.gradients[i] = 0.0;
    }
    let mut actual = expected.clone();
    for (i, value) in
        [(0, f32::NAN), (200, f32::INFINITY), (700, f32::NEG_INFINITY), (1000, -f32::NAN)]
    {
        actual.gradients[i] = value;
    }
    expected.step(5, [64, COLUMNS], 0);
    actual.step(5, [64, COLUMNS], 0);
    assert!(actual.bits() == expected.bits());
}

#[test]
fn a_huge_gradient_gives_finite_moments() {
    let mut planes = Planes::new(4);
    planes.gradients.fill(3e30);
    planes.step(2, [4, COLUMNS], 0);
    assert!(planes.second.iter().chain(&planes.parameters).all(|x| x.is_finite()));
}

#[test]
fn log_scales_stay_where_exp_is_finite() {
    let mut planes = Planes::new(2);
    planes.parameters.fill(100.0);
    planes.parameters[7 * 2] = -100.0;
    planes.step(1, [2, COLUMNS], 0);
    assert_eq!(planes.parameters[7 * 2..10 * 2], [-30.0, 13.0, 13.0, 13.0, 13.0, 13.0]);
    assert!(
        planes.parameters[..7 * 2].iter().chain(&planes.parameters[10 * 2..]).all(|x| *x > 99.0)
    );
}

/// A kernel that ran anyway would write out of bounds.
#[test]
fn a_buffer_that_is_too_short_is_refused() {
    let gpu = gpu();
    let adam = Adam::new(&gpu).unwrap();
    for (lengths, status_len, step) in [
        ([27, 28, 28], 1, 1),
        ([28, 27, 28], 1, 1),
        ([28, 28, 27], 1, 1),
        ([28; 3], 0, 1),
        ([28; 3], 1, 0),
    ] {
        let mut on_device = OnDevice {
            parameters: gpu.zeros("parameters", lengths[0]).unwrap(),
            gradients: gpu.zeros("gradients", lengths[1]).unwrap(),
            moments: Moments::zeros(&gpu, lengths[2]).unwrap(),
        };
        let status = gpu.zeros("status", status_len).unwrap();
        let rates = Schedule::default().learning_rates(step, 1.0);
        let result = gpu.run("adam", |pass| {
            let step = AdamStep { step, rates: &rates, status: &status };
            adam.record(pass, step, PLANES, on_device.buffers())
        });
        assert!(result.is_err(), "{lengths:?} {status_len} {step}");
    }
}

#[test]
fn the_first_not_finite_value_is_found_at_every_position_and_none_if_all_are_finite() {
    let gpu = gpu();
    let mut check = FiniteCheck::new(&gpu).unwrap();
    for count in [1, 3, 4, 255, 1024, 1025, 4097] {
        // Extreme values are finite; values after the last one do not count.
        let mut values: Vec<f32> =
            (0..count + 4).map(|i| [f32::MAX, -f32::MAX, 1e-45, -0.0][i % 4]).collect();
        values[count] = f32::NAN;
        let buffer = gpu.buffer("values", &values).unwrap();
        assert_eq!(check.first(&gpu, &buffer, count).unwrap(), None, "{count}");
        for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN] {
            for at in [0, count / 2, count - 1] {
                let mut values = values.clone();
                values[at] = wrong;
                values[count - 1] = wrong;
                let buffer = gpu.buffer("values", &values).unwrap();
                let found = gpu.checked(|| check.first(&gpu, &buffer, count));
                found.1.agree().unwrap();
                assert_eq!(found.0.unwrap(), Some(at), "{wrong} at {at} of {count}");
            }
        }
        assert!(check.first(&gpu, &buffer, count + 5).is_err());
    }
}
