//! Hostile files: no parser panics, hangs or prints more than a line for any content.
//!
//! The parsers and seeds are those of the fuzz targets; here, seeds are mutated by a fixed stream of random numbers,
//! the same in every run. `NIGHTSPLAT_ROUNDS` sets the number of rounds; findings of fuzzing are among the seeds.

use std::panic::catch_unwind;

#[path = "../../fuzz/parsers.rs"]
mod parsers;
use parsers::{PARSERS, Parser};

use crate::common::prelude::*;

/// Replacements for numbers and words of text formats.
const WORDS: [&str; 12] = [
    "NaN",
    "-inf",
    "1e999",
    "-1",
    "0",
    "18446744073709551616",
    "4294967295",
    "\"",
    "\n",
    "[",
    "{}",
    "\u{0}",
];
/// Replacements for numbers of binary formats.
const NUMBERS: [u64; 6] = [0, 1, 0x7f7f_ffff, 0x7ff8_0000_0000_0000, u64::MAX, i64::MAX as u64];

/// A seed with a few mutations.
fn changed(seed: &[u8], stream: Stream, round: u64) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    let mut draws = (0..).map(|draw| stream.bits(64 * round + draw));
    let mut below = |limit: usize| (draws.next().unwrap() % limit.max(1) as u64) as usize;
    for _ in 0..=below(4) {
        let at = below(bytes.len() + 1);
        let end = (at + below(24)).min(bytes.len());
        match below(7) {
            0 => bytes.truncate(at),
            1 => drop(bytes.drain(at..end)),
            2 => {
                let piece = bytes[at..end].repeat(1 + below(8));
                drop(bytes.splice(at..at, piece));
            }
            3 => drop(bytes.splice(at..end, WORDS[below(WORDS.len())].bytes())),
            4 => {
                let number = NUMBERS[below(NUMBERS.len())].to_le_bytes();
                bytes.iter_mut().skip(at).zip(&number[..1 << below(4)]).for_each(|(b, n)| *b = *n);
            }
            5 => bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= 1 << below(8)),
            _ => bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte = below(256) as u8),
        }
    }
    bytes
}

fn survives((name, parse): Parser, bytes: &[u8], what: &str) {
    if catch_unwind(|| parse(bytes)).is_err() {
        let kept = std::env::temp_dir().join(format!("nightsplat-{name}"));
        fs::write(&kept, bytes).unwrap();
        panic!("{name}: {what}; the bytes are in {}", kept.display());
    }
}

/// Runs every parser on its seeds, unchanged and mutated.
fn assert_survive(wanted: fn(&str) -> bool, rounds: u64) {
    let rounds =
        std::env::var("NIGHTSPLAT_ROUNDS").map_or(rounds, |rounds| rounds.parse().unwrap());
    let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    for parser @ (name, _) in PARSERS.into_iter().filter(|(name, _)| wanted(name)) {
        survives(parser, b"", "nothing");
        let mut files: Vec<_> =
            fs::read_dir(seeds.join(name)).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        assert!(!files.is_empty(), "{name} has no seed");
        for (number, file) in files.iter().enumerate() {
            let (seed, stream) = (fs::read(file).unwrap(), Stream::new(number as u64, 99));
            survives(parser, &seed, &file.display().to_string());
            for round in 0..rounds {
                let bytes = changed(&seed, stream, round);
                survives(parser, &bytes, &format!("{}, round {round}", file.display()));
            }
        }
    }
}

#[test]
fn no_bytes_of_a_dataset_listing_make_its_loader_panic() {
    assert_survive(|name| name.starts_with("colmap") || name.starts_with("transforms"), 60);
}

#[test]
fn no_bytes_of_an_image_make_its_decoder_panic() {
    assert_survive(|name| ["exr", "jpeg"].contains(&name), 150);
}

#[test]
fn no_bytes_of_a_model_a_checkpoint_or_settings_make_their_parser_panic() {
    assert_survive(
        |name| name.starts_with("curve") || ["ply", "checkpoint", "config_toml"].contains(&name),
        400,
    );
    assert_survive(|name| ["spz", "sog"].contains(&name), 100);
}
