//! Hostile inputs: the rows of `bench --stress` that take little, and the whole renderer against its chain in f64.
#![cfg(feature = "cli")]
#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use nightsplat::cli::bench::stress::{CASES, Effort};
use nightsplat::gpu::testing::gpu;

/// Runs every third of the small cases, so that the cores share them.
fn run_third(third: usize) {
    let small = CASES.iter().filter(|case| case.effort == Effort::Small);
    let rows = small.skip(third).step_by(3).map(|case| case.run(&gpu()));
    let wrong: Vec<String> = rows
        .filter_map(|row| row.problem.map(|problem| format!("{}: {problem}", row.name)))
        .collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn what_comes_of_a_hostile_input_is_what_the_table_says_of_the_first_third() {
    run_third(0);
}

#[test]
fn what_comes_of_a_hostile_input_is_what_the_table_says_of_the_second_third() {
    run_third(1);
}

#[test]
fn what_comes_of_a_hostile_input_is_what_the_table_says_of_the_last_third() {
    run_third(2);
}

#[test]
fn every_input_of_the_table_is_named_once() {
    let mut names: Vec<_> = CASES.iter().map(|case| case.name).collect();
    names.sort_unstable();
    assert!(names.windows(2).all(|pair| pair[0] != pair[1]));
}
