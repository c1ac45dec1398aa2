//! The point of a sweep as arguments of `train`.

use std::path::Path;

use crate::results::sweep::{
    ADAPTIVE, ALL_PARTS, OFFSET, PARTS, PLAIN, PRESET, SEED, SweepPoint, setting_of,
};
use crate::train::Part;

/// The arguments that set what a point differs in.
pub(super) fn arguments_of(point: &SweepPoint) -> Vec<String> {
    let set = |key: &str, value: &str| pair("set", &format!("{key}={value}"));
    let of = |(key, value): &(String, String)| match key.as_str() {
        "curve" => pair(key, &curve(value)),
        PARTS if value == PLAIN => pair("model", PLAIN),
        PARTS if value == ALL_PARTS => pair(key, &Part::LITA.map(Part::name).join(",")),
        PRESET | PARTS | "gain" | "theta" | SEED => pair(key, value),
        OFFSET if value == ADAPTIVE => vec![],
        OFFSET => [set("tone.alpha", value), set("tone.beta", "0")].concat(),
        key => set(setting_of(key), value),
    };
    point.values.iter().flat_map(of).collect()
}

/// The argument for a curve: an absolute path if it is a file, else its name.
fn curve(name: &str) -> String {
    let is_file = name.contains(['.', '/']) && Path::new(name).is_file();
    let path = is_file.then(|| std::path::absolute(name).ok()).flatten();
    path.and_then(|path| path.to_str().map(str::to_owned)).unwrap_or_else(|| name.to_owned())
}

/// An option and its value as arguments, joined if the value looks like an option.
pub(super) fn pair(long: &str, value: &str) -> Vec<String> {
    if value.starts_with('-') {
        vec![format!("--{long}={value}")]
    } else {
        vec![format!("--{long}"), value.to_owned()]
    }
}
