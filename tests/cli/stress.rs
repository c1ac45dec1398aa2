//! Hostile inputs: the rows of `bench --stress` that stand for all.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::cli::bench::stress::{CASES, Effort};
use nightsplat::gpu::testing::gpu;

/// Runs every second one of them, so that the cores share them.
fn run_half(half: usize) {
    let quick = CASES.iter().filter(|case| case.effort == Effort::Quick);
    let rows = quick.skip(half).step_by(2).map(|case| case.run(&gpu()));
    let wrong: Vec<String> = rows
        .filter_map(|row| row.problem.map(|problem| format!("{}: {problem}", row.name)))
        .collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn what_comes_of_a_hostile_input_is_what_the_table_says() {
    run_half(0);
}

#[test]
fn what_comes_of_another_hostile_input_is_what_the_table_says() {
    run_half(1);
}

#[test]
fn every_input_of_the_table_is_named_once() {
    let mut names: Vec<_> = CASES.iter().map(|case| case.name).collect();
    names.sort_unstable();
    assert!(names.windows(2).all(|pair| pair[0] != pair[1]));
}
