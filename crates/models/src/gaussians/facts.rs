//! Facts that a model file states in addition to its Gaussians.

use std::fmt::Display;
use std::str::FromStr;

use glam::DVec3;
use nightsplat_core::curves::SceneLaw;
use serde_json::{Map, Value};

/// Facts that a file states about its model, each with a key and a value, such as `near 0.1`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ModelFacts {
    /// The near plane, in world units.
    pub near: Option<f32>,
    /// The largest alpha of a splat on a pixel.
    pub max_alpha: Option<f32>,
    /// Whether colours are the raw SH sum. Files contain the colours that viewers show, which are 0.5 lower.
    pub raw_colors: Option<bool>,
    /// Opacities are those of a renderer that compensates them for the dilation.
    pub antialiased: bool,
    /// Colours are linear light, the photographs' raised by this many stops; `None`: as displayed.
    pub linear: Option<f32>,
    /// The curve from the photographs to the displayed colours.
    pub law: Option<SceneLaw>,
    /// The settings of the run that make its targets from photographs, as JSON without blanks.
    pub targets: Option<String>,
    /// The world position that positions are relative to.
    pub origin: DVec3,
}

impl ModelFacts {
    /// Prefix of a line of text that states a fact.
    pub const PREFIX: &str = "nightsplat ";

    /// Keys and values; without the origin if it is the world's, and of antialiasing only where it is on.
    fn entries(&self) -> Vec<(&'static str, String)> {
        let Self { near, max_alpha, raw_colors, antialiased, linear, law, targets, origin } = self;
        let DVec3 { x, y, z } = origin;
        let entry = |key, value: Option<&dyn Display>| Some((key, value?.to_string()));
        let entries = [
            entry("near", near.as_ref().map(|value| value as _)),
            entry("max_alpha", max_alpha.as_ref().map(|value| value as _)),
            entry("raw_colors", raw_colors.as_ref().map(|value| value as _)),
            antialiased.then(|| ("antialiased", antialiased.to_string())),
            entry("linear", linear.as_ref().map(|value| value as _)),
            entry("law", law.as_ref().map(|value| value as _)),
            entry("targets", targets.as_ref().map(|value| value as _)),
            (self.origin != DVec3::ZERO).then(|| ("origin", format!("{x} {y} {z}"))),
        ];
        entries.into_iter().flatten().collect()
    }

    /// As lines of text.
    pub fn lines(&self) -> Vec<String> {
        let line = |(key, value)| format!("{}{key} {value}", Self::PREFIX);
        self.entries().into_iter().map(line).collect()
    }

    /// As comments of a PLY, which has the origin in one of its own.
    pub fn comments(&self) -> Vec<String> {
        Self { origin: DVec3::ZERO, ..self.clone() }.lines()
    }

    /// As an object of JSON.
    pub fn json(&self) -> Value {
        let value = |text: &str| {
            let word = |word: &str| word.parse().unwrap_or_else(|_| Value::from(word));
            let mut words = text.split(' ').map(word);
            match words.clone().count() {
                1 => words.next().unwrap_or_default(),
                _ => words.collect(),
            }
        };
        let entries = self.entries().into_iter();
        entries.map(|(key, text)| (key.to_owned(), value(&text))).collect::<Map<_, _>>().into()
    }

    /// The facts of a JSON object; empty for any other value.
    pub fn of_json(json: &Value) -> Result<Self, String> {
        let mut facts = Self::default();
        let word = |word: &Value| word.as_str().map_or_else(|| word.to_string(), str::to_owned);
        for (key, value) in json.as_object().into_iter().flatten() {
            let words = value.as_array().map(|words| words.iter().map(word));
            let text = words.map(|words| words.collect::<Vec<_>>().join(" "));
            facts.set(key, &text.unwrap_or_else(|| value.to_string()))?;
        }
        Ok(facts)
    }

    /// Sets a fact; keys of later versions are skipped.
    pub fn set(&mut self, key: &str, value: &str) -> Result<(), String> {
        match key {
            "near" => self.near = Some(number(key, value, "above 0", |near| near > 0.0)?),
            "max_alpha" => {
                let is_valid = |alpha| 0.0 < alpha && alpha < 1.0;
                self.max_alpha = Some(number(key, value, "between 0 and 1", is_valid)?);
            }
            "raw_colors" => {
                self.raw_colors = Some(flag(key, value)?);
            }
            "antialiased" => self.antialiased = flag(key, value)?,
            "linear" => self.linear = Some(number(key, value, "of stops", |_| true)?),
            "law" => self.law = Some(law(value)?),
            // A reader of JSON has resolved the blanks within names.
            "targets" => self.targets = Some(value.trim().replace(' ', "\\u0020")),
            "origin" => self.origin = origin(value)?,
            _ => {}
        }
        Ok(())
    }

    /// Sets the fact of a line of text, if it states one.
    pub fn set_line(&mut self, line: &str) -> Result<(), String> {
        let Some(fact) = line.trim().strip_prefix(Self::PREFIX) else { return Ok(()) };
        let (key, value) = fact.split_once(' ').unwrap_or((fact, ""));
        self.set(key, value)
    }
}

/// true or false.
fn flag(key: &str, text: &str) -> Result<bool, String> {
    let refused = |_| format!("states {key} `{}`, which is neither true nor false", text.trim());
    text.trim().parse().map_err(refused)
}

/// A finite number that satisfies the rule.
fn number(key: &str, text: &str, rule: &str, holds: impl Fn(f32) -> bool) -> Result<f32, String> {
    let number = f32::from_str(text.trim()).ok();
    number.filter(|number| number.is_finite() && holds(*number)).ok_or_else(|| {
        format!("states {key} `{}`, which is not a finite number {rule}", text.trim())
    })
}

/// A curve and its numbers.
fn law(text: &str) -> Result<SceneLaw, String> {
    let refused =
        || format!("states the law `{}`, which is no curve with its numbers", text.trim());
    SceneLaw::parse(text).ok_or_else(refused)
}

/// Three finite numbers.
fn origin(text: &str) -> Result<DVec3, String> {
    let numbers: Result<Vec<f64>, _> = text.split_whitespace().map(f64::from_str).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z]) if [x, y, z].iter().all(|number| number.is_finite()) => {
            Ok(DVec3::new(x, y, z))
        }
        _ => Err(format!("names the origin `{}`, which is not three finite numbers", text.trim())),
    }
}
