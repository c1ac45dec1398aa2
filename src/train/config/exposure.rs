//! Settings of learned exposures.

use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::base::settings::{Rule, settings};
use crate::loss::exposure::ExposureRates;
use crate::{Error, Result};

/// A switch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnOff {
    /// Off: no buffer, no kernel.
    #[default]
    Off,
    /// On.
    On,
}

impl FromStr for OnOff {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "off" => Ok(Self::Off),
            "on" => Ok(Self::On),
            _ => Err(Error::Usage(format!("`{name}` is neither on nor off"))),
        }
    }
}

settings! {
"exposure."
/// Gain and bias of each channel of each training view.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureConfig {
    /// Learn gain and bias of each channel of each training view, for photographs of different exposure.
    learn: OnOff = OnOff::Off => Rule::OneOf(&["on", "off"]), "--exposure on|off";
    /// Initial exposures as CSV: `name,ev` or `name,gain_r,gain_g,gain_b,bias_r,bias_g,bias_b`.
    start: Option<PathBuf> = None, "the dataset's exposures.csv" => Rule::PATH, "--exposures FILE";
}
sections {
    /// Adam's learning rate.
    rates: ExposureRates;
}
}
