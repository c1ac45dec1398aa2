//! Arbitrary input for tests of properties.

#![allow(dead_code, reason = "no test binary uses everything")]

use glam::{DAffine3, DQuat, DVec3, EulerRot};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// The same cases in every run; a failure prints its input.
pub(crate) fn cases(cases: u32) -> ProptestConfig {
    let (failure_persistence, rng_seed) = (None, RngSeed::Fixed(7));
    ProptestConfig { cases, failure_persistence, rng_seed, ..ProptestConfig::default() }
}

pub(crate) fn position(size: f64) -> impl Strategy<Value = DVec3> {
    [-size..size, -size..size, -size..size].prop_map(DVec3::from_array)
}

pub(crate) fn pose() -> impl Strategy<Value = DAffine3> {
    ([-3.1..3.1, -1.5..1.5, -3.1..3.1], position(10.0)).prop_map(|([a, b, c], translation)| {
        DAffine3::from_rotation_translation(DQuat::from_euler(EulerRot::XYZ, a, b, c), translation)
    })
}
