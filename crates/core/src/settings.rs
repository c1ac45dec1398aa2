//! Settings, one row each: key in config.toml, default, valid values, unit, help, option.
//!
//! `settings!` declares a struct of settings together with its rows. Reading, writing, checking and explaining a
//! setting follow from the row: config.toml and `--set`, the options of `train` and their help, the reference page of
//! settings.

use std::any::Any;
use std::borrow::Cow;
use std::fmt;
use std::ops::{Bound, RangeBounds};

use crate::{Error, Result};

/// The description of a setting. Its default is that of the struct.
#[derive(Clone, Debug)]
pub struct Setting {
    /// Its dotted path in config.toml.
    pub key: Cow<'static, str>,
    /// The values that it takes.
    pub rule: Rule,
    /// The unit of a number; empty if it has none.
    pub unit: &'static str,
    /// What it does, in lines.
    pub help: &'static [&'static str],
    /// The value in effect if it is omitted, if it can be.
    pub absent: Option<&'static str>,
    /// The option of `train` with the name of its value: `--steps N`; a flag has no value.
    pub option: Option<&'static str>,
}

/// The valid values of a setting.
#[derive(Clone, Copy, Debug)]
pub enum Rule {
    /// true or false.
    Flag,
    /// A whole number, from the first to the second.
    Whole(u64, u64),
    /// A finite number within bounds.
    Number(Bound<f64>, Bound<f64>),
    /// A list whose length is from the first to the second number, of values that obey a rule.
    List(usize, usize, &'static Self),
    /// One of these words.
    OneOf(&'static [&'static str]),
    /// A text: its description, and its check.
    Text(&'static str, fn(&str) -> bool),
    /// Several values in a format that their type checks.
    Table(&'static str),
}

impl Rule {
    /// Any whole number that TOML can represent.
    pub const COUNT: Self = Self::at_least(0);
    /// 0 or more.
    pub const POSITIVE_OR_0: Self = Self::Number(Bound::Included(0.0), Bound::Unbounded);
    /// Above 0.
    pub const POSITIVE: Self = Self::Number(Bound::Excluded(0.0), Bound::Unbounded);
    /// 0 to 1.
    pub const SHARE: Self = Self::from_to(0.0, 1.0);
    /// The path of a file or a folder.
    pub const PATH: Self = Self::Text("a path", |_| true);

    /// A whole number, at least `least`.
    pub const fn at_least(least: u64) -> Self {
        Self::Whole(least, i64::MAX as u64)
    }

    /// A number from `least` to `most`, both included.
    pub const fn from_to(least: f64, most: f64) -> Self {
        Self::Number(Bound::Included(least), Bound::Included(most))
    }

    /// A number above `least` and at most `most`.
    pub const fn above(least: f64, most: f64) -> Self {
        Self::Number(Bound::Excluded(least), Bound::Included(most))
    }

    /// Whether it takes this number.
    pub fn takes_number(&self, number: f64) -> bool {
        match self {
            Self::Number(least, most) => number.is_finite() && (*least, *most).contains(&number),
            Self::Whole(..) if number >= 0.0 && number.fract() == 0.0 => {
                self.takes_whole(number as u64)
            }
            _ => false,
        }
    }

    /// Whether it takes this whole number.
    pub fn takes_whole(&self, number: u64) -> bool {
        match self {
            Self::Whole(least, most) => (*least..=*most).contains(&number),
            _ => self.takes_number(number as f64),
        }
    }

    /// Whether it takes this text.
    pub fn takes_text(&self, text: &str) -> bool {
        match self {
            Self::OneOf(words) => words.contains(&text),
            Self::Text(_, is_one) => is_one(text),
            _ => false,
        }
    }

    /// Whether its values are text, which an option need not quote.
    pub fn is_text(&self) -> bool {
        matches!(self, Self::OneOf(_) | Self::Text(..))
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        use Bound::{Excluded, Included, Unbounded};
        match self {
            Self::Flag => out.write_str("true or false"),
            Self::Whole(least, most) if *most >= u32::MAX.into() => {
                write!(out, "a whole number, at least {least}")
            }
            Self::Whole(least, most) => write!(out, "a whole number, {least} to {most}"),
            Self::Number(Included(least), Included(most)) => {
                write!(out, "{} to {}", short(*least), short(*most))
            }
            Self::Number(Unbounded, Unbounded) => out.write_str("a finite number"),
            Self::Number(least, most) => {
                let least = match least {
                    Included(least) => Some(format!("at least {}", short(*least))),
                    Excluded(least) => Some(format!("above {}", short(*least))),
                    Unbounded => None,
                };
                let most = match most {
                    Included(most) => Some(format!("at most {}", short(*most))),
                    Excluded(most) => Some(format!("below {}", short(*most))),
                    Unbounded => Some("finite".to_owned()),
                };
                let bounds: Vec<String> = least.into_iter().chain(most).collect();
                out.write_str(&bounds.join(" and "))
            }
            Self::List(least, most, rule) if least == most => write!(out, "{least} of: {rule}"),
            Self::List(least, most, rule) => write!(out, "{least} to {most} of: {rule}"),
            Self::OneOf([first, second]) => write!(out, "{first} or {second}"),
            Self::OneOf(words) => write!(out, "one of {}", words.join(", ")),
            Self::Text(form, _) | Self::Table(form) => out.write_str(form),
        }
    }
}

/// A number without a long row of zeros.
fn short(number: f64) -> String {
    let is_plain = number == 0.0 || (1e-6..1e7).contains(&number.abs());
    if is_plain { number.to_string() } else { format!("{number:e}") }
}

impl Setting {
    /// Its help, in one line.
    pub fn help(&self) -> String {
        let lines: Vec<&str> = self.help.iter().map(|line| line.trim()).collect();
        lines.join(" ").trim_end_matches('.').to_owned()
    }

    /// The values that it takes, with their unit.
    pub fn takes(&self) -> String {
        let Self { rule, unit, .. } = self;
        if unit.is_empty() { rule.to_string() } else { format!("{rule}, in {unit}") }
    }

    /// The option's name without its dashes, and the name of its value; `None` for a flag.
    pub fn option(&self) -> Option<(&'static str, Option<&'static str>)> {
        let text = self.option?.trim_start_matches('-');
        Some(text.split_once(' ').map_or((text, None), |(name, value)| (name, Some(value))))
    }

    /// The error for a value that it does not take.
    pub fn refused(&self, value: impl fmt::Display) -> Error {
        let (key, rule) = (self.key.to_string(), self.takes());
        Error::Setting { key, value: value.to_string(), rule }
    }

    /// Checks a value; values of a special type, such as an enum, are valid by their type.
    pub fn check(&self, value: &dyn Any) -> Result<()> {
        let rule = match self.rule {
            Rule::List(_, _, rule) => *rule,
            rule => rule,
        };
        let number = |number: &f64| (!rule.takes_number(*number)).then(|| number.to_string());
        let whole = |number: u64| (!rule.takes_whole(number)).then(|| number.to_string());
        let wrong = if let Some(value) = value.downcast_ref::<f64>() {
            number(value)
        } else if let Some(value) = value.downcast_ref::<Option<f64>>() {
            value.as_ref().and_then(number)
        } else if let Some(values) = value.downcast_ref::<[f64; 3]>() {
            values.iter().find_map(number)
        } else if let Some(values) = value.downcast_ref::<Option<[f64; 3]>>() {
            values.iter().flatten().find_map(number)
        } else if let Some(value) = value.downcast_ref::<u64>() {
            whole(*value)
        } else if let Some(values) = value.downcast_ref::<[u64; 2]>() {
            values.iter().find_map(|value| whole(*value))
        } else if let Some(value) = value.downcast_ref::<Option<u64>>() {
            value.and_then(whole)
        } else if let Some(value) = value.downcast_ref::<u32>() {
            whole((*value).into())
        } else if let Some(value) = value.downcast_ref::<usize>() {
            whole(*value as u64)
        } else if let Some(value) = value.downcast_ref::<Option<usize>>() {
            value.and_then(|value| whole(value as u64))
        } else {
            None
        };
        wrong.map_or(Ok(()), |wrong| Err(self.refused(wrong)))
    }
}

/// The row of `key` among `rows`.
pub fn row<'a>(rows: &'a [Setting], key: &str) -> Option<&'a Setting> {
    rows.iter().find(|row| row.key == key)
}

/// The Damerau-Levenshtein distance of a name to the nearest beginning of another, so that half a name is close to the
/// whole, and to the whole.
pub fn distance(from: &str, to: &str) -> [usize; 2] {
    let beginnings = to.char_indices().map(|(end, _)| &to[..end]).chain([to]);
    let distances = beginnings.map(|beginning| strsim::damerau_levenshtein(from, beginning));
    [distances.min().unwrap_or_default(), strsim::damerau_levenshtein(from, to)]
}

/// Declares a struct of settings with its defaults, its rows and the check of its values.
///
/// A field is `name: type = default => rule;`, and its documentation is its help. `default, "value in effect"` is for
/// an optional setting; `rule, in "unit", "--option VALUE"` adds unit and option. Fields of `sections` have rows of
/// their own, or none.
#[macro_export]
macro_rules! settings {
    (
        $section:literal
        $(#[$meta:meta])*
        pub struct $name:ident {
            $(
                $(#[doc = $help:literal])+
                $field:ident: $type:ty = $default:expr $(, $absent:literal)?
                    => $rule:expr $(, in $unit:literal)? $(, $option:literal)?;
            )*
        }
        $(sections {
            $($(#[$inner_meta:meta])* $inner:ident: $inner_type:ty;)*
        })?
    ) => {
        $(#[$meta])*
        #[derive(serde::Serialize, serde::Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct $name {
            $($(#[doc = $help])+ pub $field: $type,)*
            $($($(#[$inner_meta])* pub $inner: $inner_type,)*)?
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default,)* $($($inner: Default::default(),)*)? }
            }
        }

        impl $name {
            /// A row for each setting, except those of inner sections.
            #[doc(hidden)]
            pub const SETTINGS: &'static [$crate::settings::Setting] = $crate::settings! {
                rows $section
                $($(#[doc = $help])+ $field $(, $absent)? => $rule $(, in $unit)? $(, $option)?;)*
            };

            /// Checks every value by its row.
            #[doc(hidden)]
            pub fn check_rows(&self) -> $crate::Result<()> {
                let values = [$(&self.$field as &dyn std::any::Any),*];
                let mut rows = Self::SETTINGS.iter().zip(values);
                rows.try_for_each(|(row, value)| row.check(value))
            }
        }
    };
    // Only the rows, for settings with another representation in memory.
    (
        rows $section:literal
        $(
            $(#[doc = $help:literal])+
            $field:ident $(, $absent:literal)? => $rule:expr $(, in $unit:literal)? $(, $option:literal)?;
        )*
    ) => {
        &[$($crate::settings::Setting {
            key: std::borrow::Cow::Borrowed(concat!($section, stringify!($field))),
            rule: $rule,
            unit: concat!("" $(, $unit)?),
            help: &[$($help),+],
            absent: $crate::settings!(@option $($absent)?),
            option: $crate::settings!(@option $($option)?),
        },)*]
    };
    (@option) => { None };
    (@option $value:literal) => { Some($value) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rule_accepts_the_values_that_it_describes() {
        use Bound::{Excluded, Included, Unbounded};
        let open = Rule::Number(Excluded(0.0), Excluded(1.0));
        for (rule, printed, taken, refused) in [
            (open, "above 0 and below 1", 0.5, 1.0),
            (Rule::above(0.0, 100.0), "above 0 and at most 100", 100.0, 0.0),
            (Rule::from_to(0.1, 0.9), "0.1 to 0.9", 0.1, 0.95),
            (Rule::POSITIVE_OR_0, "at least 0 and finite", 0.0, f64::INFINITY),
            (Rule::Number(Included(1.0), Unbounded), "at least 1 and finite", 1.0, f64::NAN),
            (Rule::Number(Unbounded, Unbounded), "a finite number", -3.0, f64::NAN),
            (Rule::at_least(1), "a whole number, at least 1", 3.0, 2.5),
            (Rule::Whole(0, 3), "a whole number, 0 to 3", 3.0, 4.0),
        ] {
            assert_eq!(rule.to_string(), printed);
            assert!(rule.takes_number(taken) && !rule.takes_number(refused), "{printed}");
        }
        assert!(
            Rule::OneOf(&["on", "off"]).takes_text("on") && !Rule::OneOf(&["a"]).takes_text("b")
        );
        assert!(!Rule::COUNT.takes_whole(u64::MAX), "TOML has no more than i64::MAX");
    }
}
