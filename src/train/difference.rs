//! Differences between the settings of two runs that affect results.

use std::collections::BTreeMap;

use nightsplat_core::hash::{self, Hasher};
use toml::Value;

use super::config::TrainConfig;
use super::layers::values;
use super::settings::setting;
use crate::Result;

/// Settings that affect no result beyond rounding: the dataset's path, saving and logging, time limits, and values that
/// a run determines itself.
const FREE: [&str; 17] = [
    "dataset",
    "device",
    "tile",
    "frame.center",
    "frame.scale",
    "up",
    "cache",
    "max_vram",
    "max_ram",
    "tensorboard",
    "eval_every",
    "checkpoint_every",
    "checkpoint_minutes",
    "max_minutes",
    "hash_every",
    "check.every",
    "check.stops",
];

impl TrainConfig {
    /// The first setting that differs from `other`'s, with both values: `tone.alpha = 0.1, not 0.12`; the curve before
    /// its constants. Settings that change no step beyond rounding do not count: the number of steps, paths, scoring
    /// and saving, device and tiles. Nor does a lower limit of the Gaussians, so that a run that ran out of memory can
    /// resume.
    pub(crate) fn difference(&self, other: &Self) -> Option<String> {
        const ALSO: [&str; 6] =
            ["steps", "reference", "stop.every", "stop.gain", "stop.detail_gain", "stop.margin"];
        let values = [self, other].map(values);
        let [values_here, others] = match &values {
            [Ok(values_here), Ok(others)] => [values_here, others],
            [Err(error), _] | [_, Err(error)] => {
                return Some(format!("a setting that cannot be compared ({error})"));
            }
        };
        let value = |settings: &BTreeMap<String, Value>, key: &str| {
            settings.get(key).map_or_else(|| "nothing".to_owned(), Value::to_string)
        };
        let is_lower_limit =
            |key: &String| key == "max_gaussians" && other.max_gaussians <= self.max_gaussians;
        let keys = values_here.keys().chain(others.keys());
        let is_free = |key: &str| FREE.contains(&key) || ALSO.contains(&key);
        let differs = |key: &&String| {
            !is_free(key) && !is_lower_limit(key) && values_here.get(*key) != others.get(*key)
        };
        // Another curve has other constants.
        let key = keys.filter(differs).min_by_key(|key| *key != "tone.curve")?;
        let option = setting(key).and_then(|row| row.option());
        let option = option.map(|(option, _)| format!(" (--{option})")).unwrap_or_default();
        Some(format!("{key}{option} = {}, not {}", value(values_here, key), value(others, key)))
    }

    /// A checksum of every setting that affects results.
    pub(crate) fn checksum(&self) -> Result<String> {
        let config = self.clone().with_absolute_paths();
        let mut hasher = Hasher::default();
        for (key, value) in values(&config)? {
            if !FREE.contains(&key.as_str()) {
                hasher.write(key.as_bytes());
                hasher.write(value.to_string().as_bytes());
            }
        }
        Ok(hash::text(hasher.finish()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_named_if_it_changes_a_step() {
        let config = TrainConfig::default();
        let free = TrainConfig {
            steps: 9,
            device: "0".to_owned(),
            dataset: "b".into(),
            ..TrainConfig::default()
        };
        assert_eq!(config.difference(&free), None);
        let mut other = free;
        other.tone.alpha = 0.25;
        assert_eq!(
            config.difference(&other).unwrap(),
            format!("tone.alpha = {}, not 0.25", config.tone.alpha)
        );
        let tone = nightsplat_photographs::tone::ToneSettings::new(
            nightsplat_photographs::tone::ToneCurve::Ap3,
        );
        let curve = TrainConfig { tone, ..TrainConfig::default() };
        assert_eq!(
            config.difference(&curve).unwrap(),
            "tone.curve (--curve) = \"auto\", not \"ap3\"",
            "what the user gave, and not its constants"
        );
        let other = TrainConfig {
            model: crate::train::ModelConfig {
                depth_folder: Some("d".into()),
                ..Default::default()
            },
            ..TrainConfig::default()
        };
        assert_eq!(
            config.difference(&other).unwrap(),
            "model.depth_folder (--depth) = nothing, not \"d\""
        );
    }

    #[test]
    fn a_value_that_toml_cannot_represent_is_a_difference() {
        let huge = TrainConfig { seed: u64::MAX, ..TrainConfig::default() };
        assert!(huge.difference(&TrainConfig::default()).is_some());
        assert!(TrainConfig::default().difference(&huge).is_some());
        let message = huge.check().unwrap_err().to_string();
        assert!(message.contains("seed is 18446744073709551615"), "{message}");
    }
}
