//! A tone law: the tone mapping of every photograph of a scene, measured once and recorded in a file.
//!
//! Runs on parts of a scene read it instead of measuring their own photographs. So a photograph has the same target in
//! each of them, and nothing photometric differs where their models meet.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::exposure::{Exposure, RecordedExposure};
use super::{ToneParameters, ToneSettings};
use crate::base::{input, output};
use crate::{Error, Result};

/// The version of the file's format.
const VERSION: u32 = 1;

/// How a photograph is tone-mapped to its target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToneMapping {
    /// The curve.
    pub parameters: ToneParameters,
    /// k of soft(x; k), whose mean luminance the target has, if it follows from the exposure.
    pub gain: Option<f64>,
}

/// The tone mapping of every photograph of a scene.
#[derive(Clone, Debug)]
pub(crate) struct ToneLaw {
    /// The curve with which it was measured.
    pub(crate) tone: ToneSettings,
    /// The exposure of the training photographs together, if the curve follows it; without the gains by camera, which
    /// the photographs' own mappings contain.
    pub(crate) exposure: Option<Exposure>,
    /// The gain at which the model renders, if the curve follows the exposure.
    pub(crate) model_gain: Option<f64>,
    /// By the name of the view.
    pub(crate) mappings: BTreeMap<String, ToneMapping>,
}

/// The head of the file, before the lines of the photographs.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Head {
    version: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    model_gain: Option<f64>,
    tone: ToneSettings,
    #[serde(skip_serializing_if = "Option::is_none")]
    exposure: Option<RecordedExposure>,
    #[serde(default, skip_serializing)]
    photographs: BTreeMap<String, Line>,
}

/// A photograph: the parameters of its curve, and its gain.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    gain: Option<f64>,
    white: f64,
    offset: f64,
    slope: f64,
    weight: f64,
    #[serde(default)]
    constants: Vec<f64>,
}

impl ToneLaw {
    /// Reads a law.
    pub(crate) fn load(path: &Path) -> Result<Self> {
        let wrong = |problem: String| Error::input(path, format!("is not a tone law: {problem}"));
        let head: Head = toml::from_str(&input::text(path)?)
            .map_err(|error| wrong(error.message().to_owned()))?;
        if head.version != VERSION {
            let version = head.version;
            return Err(wrong(format!("its version is {version}, this program reads {VERSION}")));
        }
        let mapping = |(name, line): (String, Line)| match line.mapping() {
            Some(mapping) => Ok((name, mapping)),
            None => Err(wrong(format!("a number of {name} is out of range"))),
        };
        Ok(Self {
            tone: head.tone,
            exposure: head.exposure.map(Exposure::from),
            model_gain: head.model_gain,
            mappings: head.photographs.into_iter().map(mapping).collect::<Result<_>>()?,
        })
    }

    /// Writes the law; every number is read back to the bit.
    pub(crate) fn save(&self, path: &Path) -> Result<()> {
        let head = Head {
            version: VERSION,
            model_gain: self.model_gain,
            tone: self.tone.clone(),
            exposure: self.exposure.as_ref().map(Exposure::recorded),
            photographs: BTreeMap::new(),
        };
        let mut text = toml::to_string(&head).map_err(|error| Error::Usage(error.to_string()))?;
        text.push_str("\n[photographs]\n");
        for (name, mapping) in &self.mappings {
            let name = toml::Value::String(name.clone());
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{name} = {}", Line::of(mapping).inline());
        }
        output::write_whole(path, text.as_bytes())
    }

    /// Refuses a law of another curve than a run's.
    pub(crate) fn check(self, path: &Path, tone: &ToneSettings) -> Result<Self> {
        let own = ToneSettings { law: None, ..tone.clone() };
        if self.tone == own {
            return Ok(self);
        }
        let problem = format!(
            "was measured for the curve `{}` with other settings than this run's; name it with --law, without other \
             options of the curve",
            self.tone.curve.name()
        );
        Err(Error::input(path, problem))
    }
}

impl Line {
    fn of(mapping: &ToneMapping) -> Self {
        let ToneParameters { white, offset, gain, weight, constants } = mapping.parameters;
        let used =
            constants.iter().rposition(|constant| *constant != 0.0).map_or(0, |last| last + 1);
        Self {
            gain: mapping.gain,
            white: white.into(),
            offset: offset.into(),
            slope: gain.into(),
            weight: weight.into(),
            constants: constants[..used].iter().copied().map(f64::from).collect(),
        }
    }

    fn inline(&self) -> String {
        let gain = self.gain.map(|gain| format!("gain = {gain:?}, ")).unwrap_or_default();
        let Self { white, offset, slope, weight, constants, .. } = self;
        let constants = match constants.as_slice() {
            [] => String::new(),
            some => format!(", constants = {some:?}"),
        };
        format!(
            "{{ {gain}white = {white:?}, offset = {offset:?}, slope = {slope:?}, weight = {weight:?}{constants} }}"
        )
    }

    /// `None` if a number is not finite, or there are too many constants.
    fn mapping(&self) -> Option<ToneMapping> {
        let mut constants = ToneParameters::default().constants;
        let own = constants.get_mut(..self.constants.len())?;
        own.iter_mut().zip(&self.constants).for_each(|(own, given)| *own = *given as f32);
        let [white, offset, gain, weight] =
            [self.white, self.offset, self.slope, self.weight].map(|number| number as f32);
        let numbers = [white, offset, gain, weight].into_iter().chain(constants);
        let is_finite = numbers.into_iter().all(f32::is_finite) && white > 0.0;
        let parameters = ToneParameters { white, offset, gain, weight, constants };
        let is_gain = self.gain.is_none_or(|gain| gain.is_finite() && gain > 0.0);
        (is_finite && is_gain).then_some(ToneMapping { parameters, gain: self.gain })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photographs::tone::{MeasuredPhotograph, ToneCurve};

    fn photograph(brightness: f32) -> MeasuredPhotograph {
        let values: Vec<f32> = (0..300).map(|i| brightness * (i % 17) as f32 / 17.0).collect();
        MeasuredPhotograph::of(&values)
    }

    fn law_of(tone: &ToneSettings) -> ToneLaw {
        let measured = [0.05, 0.11, 0.3].map(photograph);
        let scene = tone.scene(&measured).unwrap();
        let mapping = |(name, one)| (format!("view {name}\""), tone.tone_mapping(&scene, one));
        let mappings = (0..).zip(&measured).map(mapping).collect();
        let exposure = scene.exposure;
        ToneLaw {
            tone: tone.clone(),
            model_gain: exposure.as_ref().map(|own| own.gain),
            exposure,
            mappings,
        }
    }

    #[test]
    fn a_law_is_read_back_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("law.toml");
        for curve in [ToneCurve::Auto, ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::None] {
            let tone = ToneSettings::new(curve);
            let law = law_of(&tone);
            law.save(&path).unwrap();
            let read = ToneLaw::load(&path).unwrap().check(&path, &tone).unwrap();
            assert_eq!(read.mappings.len(), 3);
            for (read, own) in read.mappings.values().zip(law.mappings.values()) {
                assert_eq!(
                    bytemuck::bytes_of(&read.parameters),
                    bytemuck::bytes_of(&own.parameters)
                );
                assert_eq!(read.gain.map(f64::to_bits), own.gain.map(f64::to_bits));
            }
            assert_eq!(read.exposure.map(|one| one.reason()), law.exposure.map(|one| one.reason()));
            assert_eq!(read.model_gain, law.model_gain);
        }
    }

    #[test]
    fn a_law_of_another_curve_is_refused() {
        let law = law_of(&ToneSettings::new(ToneCurve::Ase));
        let refused = law.check(Path::new("law.toml"), &ToneSettings::default()).unwrap_err();
        assert!(refused.to_string().contains("measured for the curve `ase`"), "{refused}");
    }

    #[test]
    fn a_damaged_law_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("law.toml");
        law_of(&ToneSettings::default()).save(&path).unwrap();
        let good = std::fs::read_to_string(&path).unwrap();
        let bad = |from: &str, to: &str| {
            assert!(good.contains(from), "{good}");
            std::fs::write(&path, good.replace(from, to)).unwrap();
            ToneLaw::load(&path).unwrap_err().to_string()
        };
        assert!(bad("version = 1", "version = 2").contains("its version is 2"));
        assert!(bad("white = ", "white = -").contains("out of range"));
        assert!(bad("[tone]", "[tune]").contains("is not a tone law"));
    }
}
