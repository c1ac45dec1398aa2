//! The parser that the program is named after.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../parsers.rs"]
mod parsers;

fuzz_target!(|bytes: &[u8]| {
    let name = env!("CARGO_BIN_NAME");
    let (_, parse) =
        parsers::PARSERS.iter().find(|(parser, _)| *parser == name).expect("a parser of this name");
    parse(bytes);
});
