//! The settings that a model file states of its run, by which it is scored as the run is.

use std::collections::BTreeMap;

use nightsplat_photographs::tone::ToneSettings;
use toml::Value;

use super::config::TrainConfig;
use super::layers::{Origin, SettingsLayer, values};
use crate::{Error, Result};

/// The settings, outside the section `tone`, on which the views of a dataset and their targets depend.
const KEYS: [&str; 15] = [
    "downscale",
    "exclude",
    "exposure.learn",
    "falloff",
    "falloff_squared",
    "invert_masks",
    "light",
    "mask_borders",
    "mask_overlays",
    "max_resolution",
    "orientation",
    "stop.views",
    "test_every",
    "undistort",
    "white_balance",
];

/// Those that are stated even if they are the defaults: a curve has its own.
const CURVE: [&str; 3] = ["tone.curve", "tone.table", "tone.profile"];

fn makes_targets(key: &str) -> bool {
    // The file of a law is another machine's.
    (key.starts_with("tone.") && key != "tone.law") || KEYS.contains(&key)
}

impl TrainConfig {
    /// The settings that make the targets, where they differ from the defaults, as JSON without blanks.
    pub(crate) fn stated_targets(&self) -> Option<String> {
        let tone = ToneSettings::new(self.tone.curve.clone());
        let usual = values(&Self { tone, ..Self::default() }).ok()?;
        let is_stated = |(key, value): &(String, Value)| {
            makes_targets(key) && (CURVE.contains(&key.as_str()) || usual.get(key) != Some(value))
        };
        let stated: BTreeMap<String, Value> =
            values(self).ok()?.into_iter().filter(is_stated).collect();
        Some(serde_json::to_string(&stated).ok()?.replace(' ', "\\u0020"))
    }

    /// The configuration with the settings of such a text.
    ///
    /// # Errors
    /// It is none, or has settings that this version does not know.
    pub(crate) fn with_targets(&self, stated: &str) -> Result<Self> {
        let stated: BTreeMap<String, Value> =
            serde_json::from_str(stated).map_err(|error| Error::Usage(error.to_string()))?;
        let mut layer = SettingsLayer::default();
        for (key, value) in stated.into_iter().filter(|(key, _)| makes_targets(key)) {
            layer.push(&key, value, Origin::Run)?;
        }
        self.overlaid(&layer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_photographs::tone::{Tone, ToneCurve};

    #[test]
    fn the_settings_of_targets_are_read_back_and_others_are_not_stated() {
        let curves = [Tone::Auto, ToneCurve::Ase.into(), ToneCurve::Hable.into()];
        for (curve, steps) in curves.into_iter().zip(1..) {
            let mut config = TrainConfig {
                tone: ToneSettings { theta: 0.4, ..ToneSettings::new(curve) },
                downscale: 4.0,
                test_every: Some(5),
                exclude: vec!["a b*.jpg".to_owned()],
                steps,
                ..TrainConfig::default()
            };
            config.stop.views = 0;
            let stated = config.stated_targets().unwrap();
            assert!(!stated.contains(' ') && !stated.contains("steps"), "{stated}");
            let read = TrainConfig { steps, ..TrainConfig::default() };
            assert_eq!(read.with_targets(&stated).unwrap(), config, "{stated}");
        }
        let usual = TrainConfig::default().stated_targets().unwrap();
        assert_eq!(usual, r#"{"tone.curve":"auto"}"#);
        let unknown = TrainConfig::default().with_targets(r#"{"tone.new":1}"#).unwrap_err();
        assert!(unknown.to_string().contains("tone.new"), "{unknown}");
    }
}
