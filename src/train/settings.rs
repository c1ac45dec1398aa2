//! The table of all settings: keys, values, and errors for invalid ones.

use std::sync::LazyLock;

use nightsplat_core::camera::TrainingFrame;
use nightsplat_core::settings::{Rule, Setting, distance};
use nightsplat_models::gaussians::init::Initialization;
use nightsplat_photographs::tone::ToneSettings;
use toml::{Table, Value};

use super::config::{
    AntialiasingConfig, CheckConfig, DensityConfig, ExposureConfig, LampConfig, LampRates,
    StopConfig, TrainConfig,
};
use super::parts::{ModelConfig, NetworkRates};
use super::precision::PrecisionConfig;
use crate::Error;
use crate::loss::exposure::ExposureRates;
use crate::loss::{ParameterWeights, Weights};
use crate::networks::DenoiserSettings;
use crate::splats::optimizer::{LearningRates, Schedule};

/// Every setting, in the order of config.toml.
pub static SETTINGS: LazyLock<Vec<Setting>> = LazyLock::new(|| {
    let rates: Vec<Setting> = LearningRates::settings().collect();
    [
        TrainConfig::SETTINGS,
        TrainingFrame::SETTINGS,
        ToneSettings::SETTINGS,
        CheckConfig::SETTINGS,
        Initialization::SETTINGS,
        Schedule::SETTINGS,
        &rates,
        DensityConfig::SETTINGS,
        ModelConfig::SETTINGS,
        DenoiserSettings::SETTINGS,
        Weights::SETTINGS,
        NetworkRates::SETTINGS,
        ParameterWeights::SETTINGS,
        StopConfig::SETTINGS,
        ExposureConfig::SETTINGS,
        AntialiasingConfig::SETTINGS,
        ExposureRates::SETTINGS,
        LampConfig::SETTINGS,
        LampRates::SETTINGS,
        PrecisionConfig::SETTINGS,
    ]
    .concat()
});

/// The row of a setting.
pub fn setting(key: &str) -> Option<&'static Setting> {
    SETTINGS.iter().find(|row| row.key == key)
}

/// The keys and values of a table; a table that is the value of a setting is kept.
pub(super) fn flat(prefix: &str, table: Table) -> Vec<(String, Value)> {
    let of = |(name, value): (String, Value)| {
        let key = format!("{prefix}{name}");
        match value {
            Value::Table(inner) if setting(&key).is_none() && is_section(&key) => {
                flat(&format!("{key}."), inner)
            }
            value => vec![(key, value)],
        }
    };
    table.into_iter().flat_map(of).collect()
}

/// Whether the name is a section of settings.
fn is_section(name: &str) -> bool {
    SETTINGS.iter().any(|row| row.key.strip_prefix(name).is_some_and(|rest| rest.starts_with('.')))
}

/// Whether a rule accepts a value.
pub(super) fn takes(rule: &Rule, value: &Value) -> bool {
    match (rule, value) {
        (Rule::Flag, Value::Boolean(_)) | (Rule::Table(_), Value::Table(_)) => true,
        (Rule::Whole(..), Value::Integer(whole)) => {
            u64::try_from(*whole).is_ok_and(|whole| rule.takes_whole(whole))
        }
        (Rule::Number(..), value) => number(value).is_some_and(|number| rule.takes_number(number)),
        (Rule::List(least, most, rule), Value::Array(values)) => {
            (*least..=*most).contains(&values.len())
                && values.iter().all(|value| takes(rule, value))
        }
        (Rule::OneOf(_) | Rule::Text(..), Value::String(text)) => rule.takes_text(text),
        _ => false,
    }
}

pub(super) fn number(value: &Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64))
}

/// The text as a TOML value; `None` if it is not a single value.
pub(super) fn value(text: &str) -> Option<Value> {
    let mut table: Table = toml::from_str(&format!("value = {text}")).ok()?;
    (table.len() == 1).then(|| table.remove("value")).flatten()
}

/// The error for an unknown key: the settings of the section that it names, or the nearest setting, preferably in its
/// section.
pub(super) fn unknown(key: &str) -> Error {
    if is_section(key) {
        let keys = SETTINGS.iter().map(|row| row.key.as_ref());
        let inner: Vec<&str> =
            keys.filter(|inner_key| inner_key.starts_with(&format!("{key}."))).collect();
        return Error::Usage(format!("{key} is a section; set one of {}", inner.join(", ")));
    }
    let (section, name) = key.rsplit_once('.').unwrap_or(("", key));
    // A key without a section, or in an unknown one, is compared by its last name.
    let is_within = !section.is_empty() && is_section(section);
    let far = |row: &&Setting| {
        let (own_section, row_name) = row.key.rsplit_once('.').unwrap_or(("", &row.key));
        let is_elsewhere = own_section != section;
        (is_within && is_elsewhere, distance(name, row_name), is_elsewhere, row.key.len())
    };
    let nearest = SETTINGS.iter().min_by_key(far);
    let hint = nearest.map(|row| format!("; the nearest is `{}`", row.key)).unwrap_or_default();
    Error::Usage(format!("no setting is called `{key}`{hint}"))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::Result;
    use crate::splats::densify::DensityControl;
    use crate::train::NotFinite;
    use crate::train::layers::values;

    fn with(assignments: &[&str]) -> Result<TrainConfig> {
        let assignments: Vec<String> = assignments.iter().map(|&text| text.to_owned()).collect();
        TrainConfig::default().with(&assignments)
    }

    fn refused(assignment: &str, parts: &[&str]) {
        let message = with(&[assignment]).unwrap_err().to_string();
        for part in parts {
            assert!(message.contains(part), "no `{part}` in: {message}");
        }
    }

    /// A configuration with every optional setting.
    fn whole() -> TrainConfig {
        let files = ["images", "reference", "init", "exposure.start"];
        let folders = ["model.depth_folder", "model.normal_folder"];
        let mut set: Vec<String> =
            files.iter().chain(&folders).map(|key| format!("{key}=a")).collect();
        set.extend(["cache", "max_vram", "max_ram"].map(|key| format!("{key}=1G")));
        let rest = [
            "freeze=means",
            "patch_pixels=512",
            "test_every=8",
            "tile=[16,8]",
            "frame.scale=2",
            "up=[0,0,1]",
            "white_balance=5000",
            "tone.brightness=0.5",
            "tone.law=a",
            "extent=2",
            "light=linear",
            "falloff=1",
            "bands={}",
            "schedule.first_sh_degree=1",
            "schedule.resolution_steps=[0,1]",
            "density.gradient_threshold=0.001",
        ];
        set.extend(rest.map(str::to_owned));
        TrainConfig::default().with(&set).unwrap()
    }

    #[test]
    fn every_setting_of_a_configuration_has_one_row_and_every_row_is_a_setting() {
        let keys: Vec<&str> = SETTINGS.iter().map(|row| row.key.as_ref()).collect();
        let rows: BTreeSet<&str> = keys.iter().copied().collect();
        assert_eq!(keys.len(), rows.len(), "a key has two rows");
        let mut written: BTreeSet<String> = values(&whole()).unwrap().into_keys().collect();
        // These belong to a curve.
        let of_curves = ["constants", "bounds", "table", "profile", "targets"];
        written.extend(of_curves.map(|name| format!("tone.{name}")));
        assert_eq!(written, rows.into_iter().map(str::to_owned).collect());
        let options: Vec<_> =
            SETTINGS.iter().filter_map(|row| row.option()).map(|(name, _)| name).collect();
        assert_eq!(
            options.iter().collect::<BTreeSet<_>>().len(),
            options.len(),
            "an option sets two settings"
        );
    }

    #[test]
    fn the_threshold_of_density_control_is_stated_as_its_strategies_have_it() {
        let [conserving, paper] = [DensityControl::Conserving, DensityControl::Paper]
            .map(|control| control.strategy().gradient_threshold);
        let stated = setting("density.gradient_threshold").unwrap().absent;
        assert_eq!(stated, Some(&*format!("{conserving}; paper: {paper}")));
    }

    #[test]
    fn every_default_obeys_its_rule_and_every_word_of_a_rule_is_a_value_of_its_type() {
        for (key, value) in values(&whole()).unwrap() {
            let row = setting(&key).unwrap();
            assert!(takes(&row.rule, &value), "{key} = {value}: {}", row.rule);
            if let Rule::OneOf(words) = row.rule {
                for word in words {
                    let config = with(&[&format!("{key}={word}")]).unwrap();
                    assert_eq!(values(&config).unwrap()[&key].as_str(), Some(*word), "{key}");
                }
            }
            assert!(!row.help().is_empty() && !row.help().contains("[`"), "{key}");
        }
        TrainConfig::default().check().unwrap();
    }

    #[test]
    fn a_setting_without_a_default_is_set_and_refused_by_its_own_name() {
        assert_eq!(with(&["frame.scale=2"]).unwrap().frame.unwrap().scale, 2.0);
        assert_eq!(
            with(&["stop.not_finite=skip-view"]).unwrap().stop.not_finite,
            NotFinite::SkipView
        );
        refused("stop.not_finite=skip", &["stop.not_finite is \"skip\"", "stop or skip-view"]);
        refused("frame.scale=0", &["frame.scale is 0", "it must be at least"]);
        refused("patch_pixels=8", &["patch_pixels is 8", "at least 256"]);
        refused("cache=much", &["cache is \"much\"", "512M"]);
        refused("tile=[8]", &["tile is [8]", "2 to 5 of"]);
    }

    #[test]
    fn an_invalid_number_is_refused_in_every_setting() {
        let mut count = 0;
        for row in SETTINGS.iter() {
            let wrong: &[&str] = match row.rule {
                Rule::Number(..) => &["nan", "inf", "-inf", "\"1\"", "-1e300"],
                Rule::Whole(..) => &["-1", "1.5", "many"],
                Rule::Flag => &["1", "yes"],
                Rule::OneOf(_) => &["neither", "3"],
                _ => &[],
            };
            for value in wrong {
                refused(
                    &format!("{}={value}", row.key),
                    &[&format!("{} is ", row.key), "it must be "],
                );
                count += 1;
            }
        }
        assert!(count > 200, "{count}");
    }

    #[test]
    fn an_unknown_key_is_refused_with_the_nearest_of_its_section() {
        for (key, nearest) in [
            ("tone.alhpa", "tone.alpha"),
            ("alpha", "tone.alpha"),
            ("stepz", "steps"),
            ("density.gradient", "density.gradient_threshold"),
            ("density.gradent", "density.gradient_threshold"),
            ("density.foo", "density."),
            ("densty.depth_seeding", "density.depth_seeding"),
            ("stop.not-finite", "stop.not_finite"),
            ("frame.scal", "frame.scale"),
        ] {
            let is_nearest = format!("no setting is called `{key}`; the nearest is `{nearest}");
            refused(&format!("{key}=1"), &[&is_nearest]);
        }
        refused("steps.more=1", &["`steps.more`"]);
        refused("=1", &["``"]);
        refused("tone={}", &["tone is a section", "tone.beta"]);
        refused("steps=1\nseed=2", &["steps is ", "a whole number"]);
        refused("steps", &["KEY=VALUE"]);
    }
}
