//! Settings of learned exposures.

use std::path::PathBuf;

use nightsplat_core::settings;
use nightsplat_core::settings::Rule;

use crate::loss::exposure::ExposureRates;

settings! {
"exposure."
/// Gain and bias of each channel of each training view.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureConfig {
    /// Learn gain and bias of each channel of each training view, for photographs of different exposure.
    learn: bool = false => Rule::Flag, "--exposure on|off";
    /// Initial exposures as CSV: `name,ev` or `name,gain_r,gain_g,gain_b,bias_r,bias_g,bias_b`.
    start: Option<PathBuf> = None, "the dataset's exposures.csv" => Rule::PATH, "--exposures FILE";
}
sections {
    /// Adam's learning rate.
    rates: ExposureRates;
}
}
