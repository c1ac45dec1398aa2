//! The log: means of partial sums, in the right column, and the status word.

use nightsplat::gpu::Threads;
use nightsplat::gpu::testing::gpu;
use nightsplat::kernels::loss_log;
use nightsplat::loss::Term;

use super::{NOT_FINITE, assert_close, log_step};

#[test]
fn loss_log_matches_its_reference() {
    let partials: Vec<f32> = (0..1000).map(|i| 300.0 + (i as f32 * 0.7).sin()).collect();
    for partial_counts in [[0, 0], [1, 0], [0, 3], [7, 8], [9, 33], [1000, 999]] {
        for broken in [None, Some(f32::NAN), Some(f32::NEG_INFINITY)] {
            let (first_partials, mut second_partials) = (partials.clone(), partials.clone());
            second_partials[2] = broken.unwrap_or(second_partials[2]);
            let params = loss_log::Params {
                slot: 2,
                term_count: 3,
                terms: [2, 0].into(),
                partial_counts: partial_counts.into(),
                mean_scales: [1.0 / 300.0, 1.0 / 500.0].into(),
            };
            let constants = loss_log::Constants::default();
            let (log, statuses, status) = (vec![7.0f32; 12], vec![0u32; 4], vec![1u32, 0, 0, 0]);
            let expected = run_reference!(
                loss_log,
                constants,
                params,
                [first_partials, second_partials],
                [log, statuses, status]
            );
            let actual = run_kernel!(
                loss_log,
                constants,
                params,
                Threads::Workgroups([1, 1, 1]),
                [first_partials, second_partials],
                [log, statuses, status]
            );
            let has_broken = broken.is_some() && partial_counts[1] > 2;
            assert_eq!(actual.2[0], if has_broken { 1 | NOT_FINITE } else { 1 });
            assert_eq!((&actual.1, &actual.2), (&expected.1, &expected.2));
            if !has_broken {
                assert_close("log", &actual.0, &expected.0, 1e-3);
            }
        }
    }
}

#[test]
fn every_term_has_its_own_column_and_name() {
    for (i, term) in Term::all().enumerate() {
        assert_eq!(term.index(), i);
        assert!(Term::all().take(i).all(|other| other.name != term.name));
    }
    let logged = log_step(&gpu(), |_, _| Ok(())).unwrap();
    assert!(Term::all().all(|term| logged.losses.get(term) == 0.0));
    assert_eq!(logged.losses.first_not_finite(), None);
}
