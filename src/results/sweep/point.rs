//! A point of a sweep: the settings in which its run differs from the others.

use nightsplat_photographs::tone::ToneCurve;

use crate::{Error, Result};

/// The axis of presets, which other settings override.
pub const PRESET: &str = "preset";
/// The axis of model parts: [`PLAIN`], [`ALL_PARTS`], or parts by name.
pub const PARTS: &str = "parts";
/// On that axis: no part.
pub const PLAIN: &str = "plain";
/// On that axis: every part.
pub const ALL_PARTS: &str = "all";
/// The axis of renders of other programs, and the key of their folder in `metrics.json`.
pub const RENDERS: &str = "renders";
/// The axis that is averaged over.
pub const SEED: &str = "seed";
/// The axis of fixed black levels.
pub const OFFSET: &str = "offset";
/// On that axis: the black level of alpha and beta.
pub const ADAPTIVE: &str = "adaptive";

/// Short names of axes, in the order of a point's name, with their settings.
const AXES: [(&str, &str); 10] = [
    (PRESET, PRESET),
    (PARTS, PARTS),
    ("curve", "tone.curve"),
    ("alpha", "tone.alpha"),
    ("beta", "tone.beta"),
    ("gain", "tone.gain_c"),
    ("base_gain", "tone.base_gain"),
    ("theta", "tone.theta"),
    (OFFSET, OFFSET),
    (SEED, SEED),
];

/// The setting of an axis.
pub fn setting_of(axis: &str) -> &str {
    AXES.iter().find(|(name, _)| *name == axis).map_or(axis, |(_, setting)| setting)
}

/// A setting with a list of values.
#[derive(Clone, Debug, PartialEq)]
pub struct SweepAxis {
    /// A name of `AXES`, or the key of any other setting.
    pub key: String,
    pub values: Vec<String>,
}

impl SweepAxis {
    /// The axis of a comma-separated list; commas within brackets or quotes do not separate.
    pub fn new(key: &str, list: &str) -> Result<Self> {
        let key = key.trim();
        let name = AXES.iter().find(|(_, setting)| *setting == key).map_or(key, |(name, _)| name);
        let mut axis = Self { key: name.to_owned(), values: vec![] };
        for value in split(list) {
            let all = if name == "curve" && value == "all" { all_curves() } else { vec![value] };
            for value in all {
                let refused =
                    |problem| Err(Error::Usage(format!("{name} takes {list}: {problem}")));
                if value.is_empty() {
                    return refused(
                        "a value is empty; separate values by single commas".to_owned(),
                    );
                }
                if axis.values.contains(&value) {
                    return refused(format!("{value} is given twice"));
                }
                axis.values.push(value);
            }
        }
        Ok(axis)
    }

    pub fn from_values(key: &str, values: &[&str]) -> Self {
        Self { key: key.to_owned(), values: values.iter().map(|&value| value.to_owned()).collect() }
    }

    /// The axis of `KEY=LIST`, as `--grid` takes it.
    pub fn parse(text: &str) -> Result<Self> {
        let (key, list) = text
            .split_once('=')
            .ok_or_else(|| Error::Usage(format!("--grid {text} has no values; write KEY=V1,V2")))?;
        Self::new(key, list)
    }

    /// Sort key of axes in a point's name: those of [`AXES`] first, the seed last.
    pub fn order(&self) -> (usize, &str) {
        let named = AXES.iter().position(|(name, _)| *name == self.key && *name != SEED);
        (named.unwrap_or(AXES.len() + usize::from(self.key == SEED)), &self.key)
    }
}

/// Splits a list at commas outside of brackets and quotes.
fn split(list: &str) -> Vec<String> {
    let (mut parts, mut depth, mut quote) = (vec![String::new()], 0, None);
    for character in list.chars() {
        match (character, quote) {
            ('"' | '\'', None) => quote = Some(character),
            (_, Some(open)) if character == open => quote = None,
            ('(' | '[' | '{', None) => depth += 1,
            (')' | ']' | '}', None) => depth -= 1,
            (',', None) if depth == 0 => {
                parts.push(String::new());
                continue;
            }
            _ => {}
        }
        if let Some(part) = parts.last_mut() {
            part.push(character);
        }
    }
    parts.iter().map(|part| part.trim().to_owned()).collect()
}

/// The names of all curves.
pub fn all_curves() -> Vec<String> {
    ToneCurve::ALL.iter().map(|curve| curve.name().to_owned()).collect()
}

/// The settings of a point.
#[derive(Clone, Debug, PartialEq)]
pub struct SweepPoint {
    /// Axes and values, in the order of the name.
    pub values: Vec<(String, String)>,
}

impl SweepPoint {
    pub fn value(&self, key: &str) -> Option<&str> {
        self.values.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
    }

    /// The point without its seed.
    pub fn seedless(&self) -> Self {
        let values = self.values.iter().filter(|(key, _)| key != SEED);
        Self { values: values.cloned().collect() }
    }

    /// The unique name of its run directory, such as `curve=ap3,seed=10`, the same in every sweep.
    pub fn name(&self) -> String {
        const LONGEST: usize = 120;
        let pairs: Vec<String> =
            self.values.iter().map(|(key, value)| format!("{key}={value}")).collect();
        let exact = pairs.join(",");
        let plain =
            |c: char| if c.is_ascii_alphanumeric() || "-_.=,+".contains(c) { c } else { '_' };
        let name: String = exact.chars().map(plain).take(LONGEST).collect();
        if name == exact {
            return name;
        }
        // The FNV-1a hash keeps names unique after replacements.
        let hash = exact
            .bytes()
            .fold(0x811c_9dc5_u32, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193));
        format!("{name}-{hash:08x}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_is_split_outside_of_brackets_and_quotes() {
        assert_eq!(split("[1,2], [3,4]"), ["[1,2]", "[3,4]"]);
        assert_eq!(split("\"a,b\",'c,]',d"), ["\"a,b\"", "'c,]'", "d"]);
        assert_eq!(split("a,,b"), ["a", "", "b"]);
    }
}
