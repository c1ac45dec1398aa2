//! Adam over whole Gaussians: its guards, in every format.

use nightsplat_models::attributes::Attribute;

use nightsplat::splats::optimizer::LearningRates;

use crate::common::prelude::*;
use crate::common::setup::features;
use crate::learned::Learned;

/// Learning rates of means, quats, log scales, raw opacities, dc, features, rest.
const RATES: LearningRates = LearningRates([0.01, 0.02, 0.03, 0.04, 0.05, 0.015, 0.06]);
const SINGLE: [StorageFormat; 2] = [StorageFormat::Single; 2];
const HALF: [StorageFormat; 2] = [StorageFormat::Half; 2];
/// Floats per Gaussian of [`learned`].
const COLUMNS: usize = 25;

/// Gaussians with two features and SH of degree 1.
fn learned(count: usize, formats: [StorageFormat; 2], frozen_columns: u32) -> Learned {
    let shape = Shape { sh_degree: 1, features: features(5) };
    let mut learned = Learned::new(count, shape, formats, frozen_columns);
    learned.rates = RATES;
    learned
}

/// A vector of four can begin in a frozen column.
#[test]
fn frozen_columns_have_no_moments_and_keep_their_parameters() {
    for (frozen, count) in [(3, 1), (10, 3), (11, 2), (11, 1025), (14, 7)] {
        let [mut trained, mut whole] = [frozen, 0].map(|frozen| learned(count, SINGLE, frozen));
        let before = trained.parameters();
        agreeing(|| trained.step(3));
        whole.step(3);
        let begin = frozen as usize * count;
        let [stepped, expected] = [&trained, &whole].map(|learned| learned.parameters());
        assert!(stepped[..begin] == before[..begin]);
        assert!(stepped[begin..] == expected[begin..]);
        let [moments, expected] = [&trained, &whole].map(|learned| learned.moments());
        assert!(moments[begin..] == expected[begin..]);
        // Also those of frozen parameters in the first vector.
        assert!(moments[..begin].iter().all(|moments| *moments == [0.0; 2]));
    }
}

#[test]
fn the_first_step_moves_every_attribute_by_its_own_learning_rate() {
    let count = 5;
    let mut learned = learned(count, SINGLE, 0);
    let before = learned.parameters();
    learned.step(1);
    let after = learned.parameters();
    for (columns, attribute) in [
        ([0, 2], Attribute::Means),
        ([3, 6], Attribute::Quats),
        ([7, 9], Attribute::LogScales),
        ([10, 10], Attribute::RawOpacities),
        ([11, 13], Attribute::Dc),
        ([14, 15], Attribute::Features),
        ([16, COLUMNS - 1], Attribute::Rest),
    ] {
        for i in columns[0] * count..(columns[1] + 1) * count {
            let moved = f64::from((after[i] - before[i]).abs());
            assert!((moved - RATES[attribute]).abs() < 1e-5, "{attribute:?} {i}: {moved}");
        }
    }
}

#[test]
fn coefficients_do_not_change_while_their_degree_is_not_in_use() {
    for formats in [SINGLE, HALF] {
        let mut learned = learned(10, formats, 0);
        learned.sh_degree = 0;
        let before = learned.parameters();
        agreeing(|| learned.step(3));
        let after = learned.parameters();
        assert_eq!(after[160..], before[160..]);
        assert!(after[..160].iter().zip(&before).all(|(after, before)| after != before));
    }
}

#[test]
fn nothing_changes_while_the_status_is_set() {
    let gpu = gpu();
    for formats in [SINGLE, HALF] {
        let mut learned = learned(300, formats, 0);
        let before = learned.bits();
        gpu.write(&mut learned.status, &[4]).unwrap();
        agreeing(|| learned.step(3));
        assert!(learned.bits() == before);
    }
}

/// Also of a colour, from which those of others are computed.
#[test]
fn a_gradient_that_is_not_finite_counts_as_zero() {
    let gpu = gpu();
    let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN];
    for formats in [SINGLE, HALF] {
        let [mut expected, mut actual] = [(); 2].map(|()| learned(64, formats, 0));
        let mut gradients = gpu.read(&expected.gradients).unwrap();
        // The last three are of colours.
        let indices = [200, 700, 64 * 16, 64 * 18, 64 * 17 + 1];
        for (learned, is_wild) in [(&mut expected, false), (&mut actual, true)] {
            for (&i, value) in indices.iter().zip(wild.into_iter().cycle()) {
                gradients[i] = if is_wild { value } else { 0.0 };
            }
            gpu.write(&mut learned.gradients, &gradients).unwrap();
            learned.step(5);
        }
        assert!(actual.bits() == expected.bits(), "{formats:?}");
    }
}

/// Also of a colour, which is multiplied by coefficients before the gradient of the mean is bounded.
#[test]
fn a_huge_gradient_gives_finite_moments() {
    let gpu = gpu();
    for formats in [SINGLE, HALF] {
        let mut learned = learned(4, formats, 0);
        let mut parameters = learned.parameters();
        parameters[16 * 4..].fill(6e4);
        learned.gaussians.write(&gpu, &parameters).unwrap();
        gpu.write(&mut learned.gradients, &[3e30; 4 * COLUMNS]).unwrap();
        agreeing(|| learned.step(2));
        let moments = learned.moments();
        assert!(moments.iter().all(|[m, v]| m.is_finite() && v.is_finite() && *v > 0.0));
        assert!(learned.parameters().iter().all(|x| x.is_finite()));
    }
}

#[test]
fn log_scales_stay_where_exp_is_finite() {
    let gpu = gpu();
    let mut learned = learned(2, SINGLE, 0);
    let mut parameters = [100.0; 2 * COLUMNS];
    parameters[7 * 2] = -100.0;
    learned.gaussians.write(&gpu, &parameters).unwrap();
    learned.step(1);
    let after = learned.parameters();
    assert_eq!(after[7 * 2..10 * 2], [-30.0, 13.0, 13.0, 13.0, 13.0, 13.0]);
    assert!(after[..7 * 2].iter().chain(&after[10 * 2..]).all(|x| *x > 99.0));
}

#[test]
fn gaussians_are_refused_if_a_buffer_is_too_short() {
    let gpu = gpu();
    for formats in [SINGLE, HALF] {
        for which in 0..4 {
            let mut learned = learned(3, formats, 0);
            match which {
                0 => {}
                1 => learned.gradients = gpu.zeros("gradients", 3 * COLUMNS - 1).unwrap(),
                2 => learned.moments = Moments::zeros(&gpu, 3 * COLUMNS - 1).unwrap(),
                _ => learned.status = gpu.zeros("status", 0).unwrap(),
            }
            let layout = learned.gaussians.layout;
            let result = gpu.run("adam", |pass| learned.record(pass, 1, layout));
            assert_eq!(result.is_ok(), which == 0, "{formats:?} {which}");
        }
        let mut learned = learned(3, formats, 0);
        let longer = Layout { count: 4, ..learned.gaussians.layout };
        assert!(gpu.run("adam", |pass| learned.record(pass, 1, longer)).is_err());
    }
}
