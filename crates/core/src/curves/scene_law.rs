//! The tone law of a scene as one curve, as a model file states it.

use std::fmt;

use super::{CURVE_AUTO, Family, ToneParameters, name_of};

/// The curve from the values of a scene's photographs to the colours of its model, at the exposure of all photographs
/// together. The file of a trained model states it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneLaw {
    /// The curve's number in `include/curves.glsl`.
    #[doc(hidden)]
    pub curve: u32,
    /// The numbers of the curve.
    #[doc(hidden)]
    pub parameters: ToneParameters,
    /// See [`Self::stops`].
    #[doc(hidden)]
    pub stops: f32,
}

impl SceneLaw {
    /// By how many stops the linear light of the photographs has to be raised for the brightness of the model's
    /// colours: for a grey that reflects 18 %.
    pub fn stops(&self) -> f32 {
        self.stops
    }

    /// What [`fmt::Display`] writes; `None` if it is not that.
    #[doc(hidden)]
    pub fn parse(text: &str) -> Option<Self> {
        let mut words = text.split_whitespace();
        let curve = match words.next()? {
            name if name == name_of(CURVE_AUTO) => CURVE_AUTO,
            name => Family::find(name)?.curve.constant(),
        };
        let stops = finite(words.next()?)?;
        Some(Self { curve, parameters: ToneParameters::parse(words)?, stops })
    }
}

fn finite(word: &str) -> Option<f32> {
    word.parse().ok().filter(|number: &f32| number.is_finite())
}

impl ToneParameters {
    /// What [`fmt::Display`] writes; `None` if it is not that.
    pub fn parse<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<Self> {
        let mut number = || finite(words.next()?);
        let [white, offset, gain, weight] = [number()?, number()?, number()?, number()?];
        let mut parameters = Self { white, offset, gain, weight, ..Self::default() };
        let mut constants = parameters.constants.iter_mut();
        for word in words {
            *constants.next()? = finite(word)?;
        }
        (white > 0.0).then_some(parameters)
    }
}

/// White, offset, gain, weight, and the constants that are not zero at the end.
impl fmt::Display for ToneParameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { white, offset, gain, weight, constants } = self;
        write!(f, "{white} {offset} {gain} {weight}")?;
        let used =
            constants.iter().rposition(|constant| *constant != 0.0).map_or(0, |last| last + 1);
        constants[..used].iter().try_for_each(|constant| write!(f, " {constant}"))
    }
}

/// The name of the curve, stops, and the parameters.
impl fmt::Display for SceneLaw {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {}", name_of(self.curve), self.stops, self.parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::curves::{CURVE_AP3, CURVE_HABLE};

    #[test]
    fn a_law_is_read_back_to_the_bit_and_anything_else_is_refused() {
        let mut parameters = ToneParameters {
            white: 0.1,
            offset: 1e-7,
            gain: 1.0,
            weight: 0.3,
            ..Default::default()
        };
        for (curve, constants) in [(CURVE_AUTO, 1), (CURVE_AP3, 0), (CURVE_HABLE, 6)] {
            parameters.constants[..constants].fill(1.0 / 3.0);
            let law = SceneLaw { curve, parameters, stops: 4.123_456_7 };
            assert_eq!(SceneLaw::parse(&law.to_string()), Some(law));
            parameters.constants = Default::default();
        }
        let good = "auto 4 0.1 0.075 1 1 0.3";
        assert!(SceneLaw::parse(good).is_some());
        let bad = [
            "",
            "auto",
            "bright 4 0.1 0.075 1 1",
            "table 4 0.1 0.075 1 1",
            "profile 4 0.1 0.075 1 1",
            "auto 4 0 0.075 1 1",
            "auto 4 NaN 0.075 1 1",
            "auto 4 0.1 0.075 1",
            "auto 4 0.1 0.075 1 1 x",
            "auto 4 0.1 0.075 1 1 1 1 1 1 1 1 1 1 1",
        ];
        for text in bad {
            assert_eq!(SceneLaw::parse(text), None, "{text}");
        }
    }
}
