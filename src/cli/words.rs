//! Values of options that are words: listed in completions and man pages, and parsed by their type.

use std::ffi::OsStr;
use std::fmt::Display;
use std::marker::PhantomData;
use std::str::FromStr;

use clap::builder::{PossibleValue, StringValueParser, TypedValueParser};
use clap::{Arg, Command, Error};
use nightsplat_core::curves::{CURVE_AUTO, name_of};
use nightsplat_models::export::Format;
use nightsplat_photographs::tone::ToneCurve;

use crate::train::{Part, Preset};

/// Parses a `T`, of which some values have names. Others may exist, such as files.
#[derive(Clone, Debug)]
pub(super) struct NamedValues<T>(Vec<&'static str>, PhantomData<fn() -> T>);

impl<T> NamedValues<T> {
    pub(super) fn new(names: impl IntoIterator<Item = &'static str>) -> Self {
        Self(names.into_iter().collect(), PhantomData)
    }
}

/// The names of all curves.
pub(super) fn curves<T>() -> NamedValues<T> {
    let auto = name_of(CURVE_AUTO);
    NamedValues::new(std::iter::once(auto).chain(ToneCurve::ALL.map(ToneCurve::name)))
}

/// The names of all presets.
pub(super) fn presets() -> NamedValues<Preset> {
    NamedValues::new(Preset::ALL.map(Preset::name))
}

/// The names of all formats of a model.
pub(super) fn formats() -> NamedValues<Format> {
    NamedValues::new(Format::ALL.map(Format::name))
}

/// The names of all parts of the model.
pub(super) fn parts() -> NamedValues<Part> {
    NamedValues::new(Part::ALL.map(Part::name))
}

impl<T> TypedValueParser for NamedValues<T>
where
    T: FromStr<Err: Display> + Clone + Send + Sync + 'static,
{
    type Value = T;

    fn parse_ref(&self, command: &Command, arg: Option<&Arg>, text: &OsStr) -> Result<T, Error> {
        let parser = StringValueParser::new();
        parser
            .try_map(|text| text.parse::<T>().map_err(|error| error.to_string()))
            .parse_ref(command, arg, text)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(self.0.iter().map(|name| PossibleValue::new(*name))))
    }
}
