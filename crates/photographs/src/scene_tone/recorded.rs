//! The tone law of a scene: the curve of every photograph, measured once and recorded in a file.
//!
//! Runs on parts of a scene read it instead of measuring their own photographs. So a photograph has the same target in
//! each of them, and nothing photometric differs where their models meet.

use std::collections::BTreeMap;
use std::path::Path;

use nightsplat_core::{Error, Result, output};
use serde::{Deserialize, Serialize};

use super::SceneTone;
use crate::dataset::Dataset;
use crate::tone::{Exposure, ToneParameters, ToneSettings};
use crate::tree;

/// The version of the file's format.
const VERSION: u32 = 1;

/// In place of a gain.
const NO_GAIN: &str = "-";

/// The file. The exposure lacks the gains by camera, which the photographs' own mappings contain.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    version: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    model_gain: Option<f64>,
    tone: ToneSettings,
    #[serde(skip_serializing_if = "Option::is_none")]
    exposure: Option<Exposure>,
    /// By the name of the view: its gain, if there is one, and the parameters of its curve.
    #[serde(default)]
    photographs: BTreeMap<String, String>,
}

impl SceneTone {
    /// The scene whose law these settings name, if they do; the law must be one of the same settings.
    pub fn recorded(settings: &ToneSettings) -> Result<Option<Self>> {
        let Some(path) = &settings.law else { return Ok(None) };
        let law = Self::load(path)?;
        if law.settings == (ToneSettings { law: None, ..settings.clone() }) {
            return Ok(Some(Self { settings: settings.clone(), ..law }));
        }
        let problem = format!(
            "was measured for the curve `{}` with other settings than this run's; name it with --law, without other \
             options of the curve",
            law.settings.curve.name()
        );
        Err(Error::input(path, problem))
    }

    /// The scene whose law these settings name, or else that of a dataset's training photographs.
    pub fn for_dataset(settings: &ToneSettings, dataset: &Dataset) -> Result<Self> {
        Self::recorded(settings)?.map_or_else(|| Self::measure(settings, dataset), Ok)
    }

    /// Reads a law.
    pub fn load(path: &Path) -> Result<Self> {
        let wrong = |problem: String| Error::input(path, format!("is not a tone law: {problem}"));
        let File { version, model_gain, tone, mut exposure, photographs } =
            toml::from_str(&tree::text(path)?)
                .map_err(|error: toml::de::Error| wrong(error.message().to_owned()))?;
        if version != VERSION {
            return Err(wrong(format!("its version is {version}, this program reads {VERSION}")));
        }
        if let Some(exposure) = &mut exposure {
            exposure.request(tone.brightness);
        }
        let mut law = Self { exposure, model_gain, is_recorded: true, ..Self::new(&tone) };
        for (name, text) in photographs {
            let out_of_range = || wrong(format!("a number of {name} is out of range"));
            let (gain, curve) = parsed(&text).ok_or_else(out_of_range)?;
            law.gains.extend(gain.map(|gain| (name.clone(), gain)));
            law.curves.insert(name, curve);
        }
        Ok(law)
    }

    /// Writes the law; every number is read back to the bit.
    pub fn save(&self, path: &Path) -> Result<()> {
        let line = |(name, curve): (&String, &ToneParameters)| {
            let gain = self.gains.get(name).map_or_else(|| NO_GAIN.to_owned(), f64::to_string);
            (name.clone(), format!("{gain} {curve}"))
        };
        let file = File {
            version: VERSION,
            model_gain: self.model_gain,
            tone: self.settings.clone(),
            exposure: self.exposure.clone(),
            photographs: self.curves.iter().map(line).collect(),
        };
        let text = toml::to_string(&file).map_err(|error| Error::Usage(error.to_string()))?;
        output::write_whole(path, text.as_bytes())
    }
}

/// The gain of a photograph and its curve; `None` if a number is out of range, or there are too many.
fn parsed(text: &str) -> Option<(Option<f64>, ToneParameters)> {
    let mut words = text.split(' ');
    let gain = match words.next()? {
        NO_GAIN => None,
        gain => Some(gain.parse().ok().filter(|gain: &f64| gain.is_finite() && *gain > 0.0)?),
    };
    Some((gain, ToneParameters::parse(words)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tone::{MeasuredPhotograph, Tone, ToneCurve};

    fn photograph(brightness: f32) -> MeasuredPhotograph {
        let values: Vec<f32> = (0..300).map(|i| brightness * (i % 17) as f32 / 17.0).collect();
        MeasuredPhotograph::measure(&values)
    }

    fn law_of(tone: &ToneSettings) -> SceneTone {
        let measured = [0.05, 0.11, 0.3].map(photograph);
        let scene = SceneTone::from_photographs(tone, &measured).unwrap();
        let model_gain = scene.exposure.as_ref().map(|set_exposure| set_exposure.gain);
        let mut law = SceneTone { model_gain, ..scene };
        let named = measured.iter().enumerate();
        named.for_each(|(at, one)| law.add(&format!("view {at}\""), one));
        law
    }

    #[test]
    fn a_law_is_read_back_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("law.toml");
        let formulas = [ToneCurve::Ase, ToneCurve::Ap3, ToneCurve::None].map(Tone::Formula);
        for curve in formulas.into_iter().chain([Tone::Auto]) {
            let tone = ToneSettings::new(curve);
            let law = law_of(&tone);
            law.save(&path).unwrap();
            let named = ToneSettings { law: Some(path.clone()), ..tone };
            let read = SceneTone::recorded(&named).unwrap().unwrap();
            assert_eq!(read.curves.len(), 3);
            for (read, written) in read.curves.values().zip(law.curves.values()) {
                assert_eq!(bytemuck::bytes_of(read), bytemuck::bytes_of(written));
            }
            let bits =
                |scene: &SceneTone| Vec::from_iter(scene.gains.values().map(|k| k.to_bits()));
            assert_eq!(bits(&read), bits(&law));
            assert_eq!(read.exposure.map(|one| one.reason()), law.exposure.map(|one| one.reason()));
            assert_eq!(read.model_gain, law.model_gain);
        }
    }

    #[test]
    fn a_law_of_another_curve_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("law.toml");
        law_of(&ToneSettings::new(ToneCurve::Ase)).save(&path).unwrap();
        let other = ToneSettings { law: Some(path), ..ToneSettings::default() };
        let refused = SceneTone::recorded(&other).unwrap_err();
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
            SceneTone::load(&path).unwrap_err().to_string()
        };
        assert!(bad("version = 1", "version = 2").contains("its version is 2"));
        assert!(bad(" 0.075 1 ", " NaN 1 ").contains("out of range"));
        assert!(bad("[tone]", "[tune]").contains("is not a tone law"));
    }
}
