//! The `nightsplat` command.

fn main() {}
