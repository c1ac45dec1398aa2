//! Curves from files: settings in TOML, tables in CSV or .cube.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use nightsplat_core::{Error, Result};

use super::{Profile, Table, Tone, ToneCurve, ToneSettings, is_word};
use crate::tree;

/// The value of `--curve`, also of `--family`.
#[derive(Clone, Debug, PartialEq)]
pub enum CurveChoice {
    /// A curve of the table, or a formula of one's own.
    Named(Tone),
    /// A TOML file with settings (also a run's config.toml), or a CSV or .cube file with values.
    File(PathBuf),
}

/// The extensions of curve files.
const EXTENSIONS: [&str; 3] = ["toml", "csv", "cube"];

impl FromStr for CurveChoice {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if EXTENSIONS.contains(&extension(Path::new(text)).as_str()) {
            return Ok(Self::File(text.into()));
        }
        match text.parse() {
            Ok(curve) => Ok(Self::Named(curve)),
            Err(error) if Tone::OF_FILES.contains(&text) || !is_word(text) => Err(error),
            Err(error) => Err(Error::Usage(format!("{error}, or a .toml, .csv or .cube file"))),
        }
    }
}

impl fmt::Display for CurveChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Named(curve) => curve.fmt(f),
            Self::File(path) => f.pad(&path.file_stem().unwrap_or_default().to_string_lossy()),
        }
    }
}

impl From<Tone> for CurveChoice {
    fn from(curve: Tone) -> Self {
        Self::Named(curve)
    }
}

impl From<ToneCurve> for CurveChoice {
    fn from(curve: ToneCurve) -> Self {
        Self::Named(curve.into())
    }
}

impl CurveChoice {
    /// The curve with the constants of its row or file.
    pub fn settings(&self) -> Result<ToneSettings> {
        match self {
            Self::Named(curve) => {
                let settings = ToneSettings::new(curve.clone());
                settings.check().map(|()| settings)
            }
            Self::File(path) => ToneSettings::load(path),
        }
    }
}

impl ToneSettings {
    /// Reads a curve from a file: a [`Table`] from `.csv` and `.cube`, otherwise settings from TOML, at the top or in
    /// `[tone]`.
    ///
    /// # Errors
    /// [`Error::Input`] with the file and its problem.
    pub fn load(path: &Path) -> Result<Self> {
        let text = tree::text(path)?;
        let wrong = |problem: String| Error::input(path, format!("is not a tone curve: {problem}"));
        let settings = match extension(path).as_str() {
            "csv" => Self::new(Tone::Table(Table::from_csv(&text).map_err(wrong)?)),
            "cube" => Self::new(Tone::Table(Table::from_cube(&text).map_err(wrong)?)),
            _ => from_toml(&text).map_err(wrong)?,
        };
        settings.check().map_err(|error| wrong(error.to_string()))?;
        Ok(settings)
    }
}

impl Profile {
    /// Reads a profile written by `nightsplat tone fit --profile`.
    ///
    /// # Errors
    /// [`Error::Input`] with the file and its problem.
    pub fn load(path: &Path) -> Result<Self> {
        let text = tree::text(path)?;
        let wrong =
            |problem: String| Error::input(path, format!("is not a camera profile: {problem}"));
        let profile: Self =
            toml::from_str(&text).map_err(|error| wrong(error.message().replace('\n', " ")))?;
        profile.check().map_err(wrong)?;
        Ok(profile)
    }
}

fn from_toml(text: &str) -> Result<ToneSettings, String> {
    let one_line = |error: &toml::de::Error| error.message().replace('\n', " ");
    let mut whole: toml::Table = text.parse().map_err(|error| one_line(&error))?;
    let tone = match whole.remove("tone") {
        Some(toml::Value::Table(tone)) => tone,
        Some(_) => return Err("`tone` is not a table".to_owned()),
        None => whole,
    };
    if tone.contains_key("segments") {
        return Err("it is a camera profile; name it with --profile".to_owned());
    }
    if !["curve", "table", "profile"].iter().any(|key| tone.contains_key(*key)) {
        return Err("it names no curve; add curve = \"NAME\"".to_owned());
    }
    tone.try_into().map_err(|error| one_line(&error))
}

fn extension(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}
