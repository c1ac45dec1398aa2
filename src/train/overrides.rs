//! `KEY=VALUE`: any one setting of a run by its dotted path, as `config.toml` spells it.

use std::collections::BTreeMap;

use toml::{Table, Value};

use super::TrainConfig;
use crate::base::hash::{self, Hasher};
use crate::{Error, Result};

/// The settings that no result depends on beyond its rounding: where the dataset lies, what is kept and logged and when,
/// how long the run may take, and what it finds for itself.
const FREE: [&str; 16] = [
    "dataset",
    "device",
    "tile",
    "frame.center",
    "frame.scale",
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
    /// The configuration with each `KEY=VALUE` of `assignments` in turn, such as `tone.alpha=0.1`. A value is TOML, or
    /// else a string; nothing is checked but its type.
    ///
    /// # Errors
    /// [`Error::Usage`] for a key that no configuration has, with the nearest one that it has, or a value of another
    /// type.
    pub fn with(&self, assignments: &[String]) -> Result<Self> {
        let mut config = self.clone();
        for assignment in assignments {
            let (key, value) = assignment.split_once('=').ok_or_else(|| {
                Error::Usage(format!(
                    "`{assignment}` sets nothing; write KEY=VALUE, as in tone.alpha=0.1"
                ))
            })?;
            config = config.with_one(key.trim(), value.trim())?;
        }
        Ok(config)
    }

    /// The configuration with every setting that a TOML text has.
    ///
    /// # Errors
    /// [`Error::Usage`] for text that is no TOML, a setting that no configuration has, or a value of another type.
    pub(super) fn overlaid(&self, text: &str) -> Result<Self> {
        let refused = |error: toml::de::Error| Error::Usage(error.message().to_owned());
        let over: Table = toml::from_str(text).map_err(refused)?;
        let mut table = Table::try_from(self).map_err(|error| Error::Usage(error.to_string()))?;
        overlay(&mut table, over);
        table.try_into().map_err(refused)
    }

    /// The first setting in which a run of `self` differs from one of `other`, with both values: `tone.alpha = 0.1, not
    /// 0.12`. Left out is what changes no step beyond its rounding: how long the run is, where the photographs lie, when it
    /// is scored and saved, on which device and by which tiles. A lower limit of the Gaussians is no difference either: a
    /// run that outgrows its machine goes on with what it has.
    pub fn difference(&self, other: &Self) -> Option<String> {
        const ALSO: [&str; 5] = ["steps", "reference", "stop.every", "stop.gain", "stop.margin"];
        let tables = [self, other].map(Table::try_from);
        let [own, others] = match &tables {
            [Ok(own), Ok(others)] => [own, others].map(|table| settings("", table)),
            [Err(error), _] | [_, Err(error)] => {
                return Some(format!("a setting that cannot be compared ({error})"));
            }
        };
        let value = |settings: &BTreeMap<String, Value>, key: &str| {
            settings.get(key).map_or_else(|| "nothing".to_owned(), Value::to_string)
        };
        let is_lower_limit =
            |key: &String| key == "max_gaussians" && other.max_gaussians <= self.max_gaussians;
        let keys = own.keys().chain(others.keys());
        let is_free = |key: &str| FREE.contains(&key) || ALSO.contains(&key);
        let mut keys = keys.filter(|key| !is_free(key) && !is_lower_limit(key));
        keys.find(|&key| own.get(key) != others.get(key))
            .map(|key| format!("{key} = {}, not {}", value(&own, key), value(&others, key)))
    }

    /// A checksum of every setting that a result depends on: all but where the dataset lies, when the run is saved and
    /// checked, how long it may take, and what it finds for itself.
    ///
    /// # Errors
    /// None for a configuration that [`TrainConfig::check`] accepts.
    pub fn checksum(&self) -> Result<String> {
        let own = self.clone().with_absolute_paths();
        let table = Table::try_from(own).map_err(|error| Error::Usage(error.to_string()))?;
        let mut hasher = Hasher::default();
        for (key, value) in settings("", &table) {
            if !FREE.contains(&key.as_str()) {
                hasher.write(key.as_bytes());
                hasher.write(value.to_string().as_bytes());
            }
        }
        Ok(hash::text(hasher.finish()))
    }

    /// Refuses numbers that are none, wherever they stand.
    pub(super) fn check_finite(&self) -> Result<()> {
        let table = Table::try_from(self).map_err(|error| Error::Usage(error.to_string()))?;
        match settings("", &table).iter().find_map(|(key, value)| Some((key, not_finite(value)?))) {
            Some((key, number)) => {
                Err(Error::Usage(format!("{key} is {number}; it must be finite")))
            }
            None => Ok(()),
        }
    }

    fn with_one(&self, key: &str, text: &str) -> Result<Self> {
        let refused = |problem: &str| Error::Usage(format!("{key}={text}: {problem}"));
        let mut table = Table::try_from(self).map_err(|error| Error::Usage(error.to_string()))?;
        let known = keys("", &table);
        let (sections, name) = key.rsplit_once('.').map_or(("", key), |(path, name)| (path, name));
        let path = sections.split('.').filter(|_| !sections.is_empty());
        let section = path
            .into_iter()
            .try_fold(&mut table, |table, name| table.get_mut(name).and_then(Value::as_table_mut));
        let Some(section) = section else { return Err(unknown(key, &known)) };
        let value = match section.get(name) {
            Some(Value::Table(inner)) => {
                let inner = keys(&format!("{key}."), inner).join(", ");
                return Err(refused(&format!("this is a section; set one of {inner}")));
            }
            // A device may be named 0.
            Some(Value::String(_)) => string(text),
            _ => value(text).unwrap_or_else(|| Value::String(text.to_owned())),
        };
        section.insert(name.to_owned(), value);
        table.try_into().map_err(|error: toml::de::Error| {
            let is_known = known.iter().any(|known| known == key);
            if is_known { refused(error.message().trim()) } else { unknown(key, &known) }
        })
    }
}

/// The first number of a value that is NaN or infinite.
fn not_finite(value: &Value) -> Option<f64> {
    match value {
        Value::Float(number) => Some(*number).filter(|number| !number.is_finite()),
        Value::Array(values) => values.iter().find_map(not_finite),
        _ => None,
    }
}

/// Puts the values of one table in place of another's, section by section.
fn overlay(table: &mut Table, over: Table) {
    for (name, value) in over {
        match (table.get_mut(&name), value) {
            (Some(Value::Table(section)), Value::Table(over)) => overlay(section, over),
            (_, value) => {
                table.insert(name, value);
            }
        }
    }
}

/// A TOML value; none where the text is no single one.
fn value(text: &str) -> Option<Value> {
    let mut table: Table = toml::from_str(&format!("value = {text}")).ok()?;
    (table.len() == 1).then(|| table.remove("value")).flatten()
}

/// The text, without the quotes it may have.
fn string(text: &str) -> Value {
    value(text).filter(Value::is_str).unwrap_or_else(|| Value::String(text.to_owned()))
}

/// Every setting that is not a section itself, under its dotted path.
fn settings(prefix: &str, table: &Table) -> BTreeMap<String, Value> {
    let of = |(name, value): (&String, &Value)| match value {
        Value::Table(inner) => settings(&format!("{prefix}{name}."), inner),
        _ => BTreeMap::from([(format!("{prefix}{name}"), value.clone())]),
    };
    table.iter().flat_map(of).collect()
}

/// The dotted path of every setting.
fn keys(prefix: &str, table: &Table) -> Vec<String> {
    settings(prefix, table).into_keys().collect()
}

fn unknown(key: &str, known: &[String]) -> Error {
    let name = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    // Whoever forgets the section means the key of that name.
    let far = |known: &&String| distance(key, known).min(distance(&name(key), &name(known)));
    let nearest = known.iter().min_by_key(|known| (far(known), known.len()));
    let hint = nearest.map(|nearest| format!("; the nearest is `{nearest}`")).unwrap_or_default();
    Error::Usage(format!("no setting is called `{key}`{hint}"))
}

/// Levenshtein's distance: the insertions, deletions and replacements that turn one text into the other.
fn distance(from: &str, to: &str) -> usize {
    let to: Vec<char> = to.chars().collect();
    let mut row: Vec<usize> = (0..=to.len()).collect();
    for (deleted, from) in from.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], deleted + 1);
        for (column, &to) in to.iter().enumerate() {
            let replaced = diagonal + usize::from(from != to);
            diagonal = row[column + 1];
            row[column + 1] = replaced.min(diagonal + 1).min(row[column] + 1);
        }
    }
    row[to.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_named_unless_it_changes_no_step() {
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
        let other = TrainConfig {
            model: crate::train::ModelConfig {
                depth_folder: Some("d".into()),
                ..Default::default()
            },
            ..TrainConfig::default()
        };
        assert_eq!(config.difference(&other).unwrap(), "model.depth_folder = nothing, not \"d\"");
    }

    #[test]
    fn no_setting_is_nan_or_infinite_unnoticed() {
        let table = Table::try_from(TrainConfig::default()).unwrap();
        let all = settings("", &table);
        let numbers = all.iter().filter(|(_, value)| value.is_float());
        let mut count = 0;
        for (key, _) in numbers {
            for wrong in ["nan", "inf", "-inf"] {
                let config = with(&[&format!("{key}={wrong}")]).unwrap();
                let checked = config.check();
                let message = checked.expect_err(key).to_string();
                let name = key.rsplit('.').next().unwrap();
                let is_named = message.contains(name) || message.contains(&name.replace("_c", ""));
                assert!(is_named, "{key}={wrong}: {message}");
            }
            count += 1;
        }
        assert!(count > 30, "{count}");
    }

    #[test]
    fn what_toml_cannot_hold_is_a_difference() {
        let huge = TrainConfig { seed: u64::MAX, ..TrainConfig::default() };
        assert!(huge.difference(&TrainConfig::default()).is_some());
        assert!(TrainConfig::default().difference(&huge).is_some());
        let message = huge.check().unwrap_err().to_string();
        assert!(message.contains("`TrainConfig::seed` is 18446744073709551615"), "{message}");
    }

    fn with(assignments: &[&str]) -> Result<TrainConfig> {
        let assignments: Vec<String> = assignments.iter().map(|&text| text.to_owned()).collect();
        TrainConfig::default().with(&assignments)
    }

    #[test]
    fn a_setting_is_set_and_nothing_else() {
        let config = with(&[
            "tone.alpha=0.25",
            "density.gradient_threshold = 1e-4",
            "downscale=4",
            "background=random",
            "device=0",
            "schedule.damping_steps=[1, 2]",
            "reference=pictures/high",
            "steps=3",
            "steps=4",
        ])
        .unwrap();
        let mut expected = TrainConfig::default();
        expected.tone.alpha = 0.25;
        expected.density.gradient_threshold = 1e-4;
        expected.downscale = 4.0;
        expected.background = crate::train::Background::Random;
        expected.device = "0".to_owned();
        expected.schedule.damping_steps = [1, 2];
        expected.reference = Some("pictures/high".into());
        expected.steps = 4;
        assert_eq!(config, expected);
        assert_eq!(with(&[]).unwrap(), TrainConfig::default());
    }

    #[test]
    fn what_cannot_be_set_is_named_with_its_neighbour() {
        let refused = |assignment: &str, parts: &[&str]| {
            let message = with(&[assignment]).unwrap_err().to_string();
            for part in parts {
                assert!(message.contains(part), "no `{part}` in: {message}");
            }
        };
        refused("tone.alhpa=0.1", &["`tone.alhpa`", "`tone.alpha`"]);
        refused("alpha=0.1", &["`alpha`", "`tone.alpha`"]);
        refused("stepz=1", &["`steps`"]);
        refused("steps.more=1", &["`steps.more`"]);
        refused("nothing.at.all=1", &["`nothing.at.all`"]);
        refused("=1", &["``"]);
        refused("tone={}", &["section", "tone.beta"]);
        refused("steps=many", &["steps=many", "string"]);
        refused("steps=1\nseed=2", &["string"]);
        refused("background=blue", &["blue", "random"]);
        refused("steps", &["KEY=VALUE"]);
    }

    #[test]
    fn distances_count_edits() {
        assert_eq!(distance("kitten", "sitting"), 3);
        assert_eq!(distance("", "abc"), 3);
        assert_eq!(distance("abc", ""), 3);
    }
}
