//! Unsupported keys of a listing that name files or change the result in other programs: reported once.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Map, Value};

/// Extensions of files that a key may name.
const ENDINGS: [&str; 17] = [
    "png", "jpg", "jpeg", "exr", "tif", "tiff", "webp", "npy", "npz", "pt", "bin", "ply", "pcd",
    "obj", "las", "mp4", "json",
];
/// Keys that change the result in other trainers.
const MEANT: [&str; 4] = ["rolling_shutter", "k5", "k6", "time"];

/// Collects such keys.
#[derive(Debug, Default)]
pub(super) struct Unsupported {
    /// Number of occurrences and first value of each.
    keys: BTreeMap<String, (usize, String)>,
}

impl Unsupported {
    /// Adds those of an object, from which supported keys are already removed.
    pub(super) fn add(&mut self, object: &Map<String, Value>) {
        for (key, value) in object {
            let named = file_of(key, value).or_else(|| meant(key, value));
            if let Some(named) = named {
                self.keys.entry(key.clone()).or_insert((0, named)).0 += 1;
            }
        }
    }

    /// One line that names them all; `None` if there are none.
    pub(super) fn remark(&self, path: &Path) -> Option<String> {
        let named = |(key, (count, value)): (&String, &(usize, String))| match count {
            1 => format!("{key} ({value})"),
            _ => format!("{key} ({count} times, {value} the first)"),
        };
        let keys: Vec<String> = self.keys.iter().map(named).collect();
        (!keys.is_empty()).then(|| {
            format!("{}: not supported, without effect: {}", path.display(), keys.join(", "))
        })
    }
}

/// Whether a frame is marked as bad: `is_bad` of `ScanNet++` and similar keys.
pub(super) fn is_marked_bad(frame: &Map<String, Value>) -> bool {
    const BAD: [&str; 5] = ["is_bad", "bad", "ignore", "skip", "excluded"];
    const GOOD: [&str; 3] = ["is_valid", "valid", "enabled"];
    let says = |keys: &[&str], value: bool| {
        let mut is_marked = false;
        for key in keys {
            let mark = frame
                .get(*key)
                .and_then(|mark| mark.as_bool().or(mark.as_u64().map(|mark| mark != 0)));
            is_marked |= mark == Some(value);
        }
        is_marked
    };
    says(&BAD, true) | says(&GOOD, false)
}

/// The file that a value names, judged by its extension or by its key.
fn file_of(key: &str, value: &Value) -> Option<String> {
    let text = match value {
        Value::Array(values) => values.iter().find_map(Value::as_str)?,
        _ => value.as_str()?,
    };
    let ending = text.rsplit_once('.').map(|(_, ending)| ending.to_ascii_lowercase());
    let is_file = ending.is_some_and(|ending| ENDINGS.contains(&ending.as_str()))
        || ["_path", "_file", "_filename"].iter().any(|end| key.ends_with(end));
    (is_file && !text.is_empty()).then(|| text.to_owned())
}

/// The value of a key that other trainers use, if it is not zero.
fn meant(key: &str, value: &Value) -> Option<String> {
    let is_zero = |value: &Value| value.is_null() || value.as_f64() == Some(0.0);
    let is_idle = match value {
        Value::Array(values) => values.iter().all(is_zero),
        value => is_zero(value),
    };
    (MEANT.contains(&key) && !is_idle).then(|| value.to_string())
}
