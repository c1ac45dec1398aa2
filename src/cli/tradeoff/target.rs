//! What test views are scored against: reference images, or else their own pseudo-GT.

use std::path::Path;

use crate::cli::tone::{self, ToneArgs};
use crate::photographs::dataset::{Dataset, View};
use crate::photographs::tone::ToneSettings;
use crate::{Error, Result};

/// What test views are scored against.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Target {
    /// Normal-light photographs.
    References,
    /// What the curve of the base makes of the test views' own photographs; the same for every point.
    PseudoGt,
}

impl Target {
    /// References where there are some.
    ///
    /// # Errors
    /// There is no test view with a photograph of any kind.
    pub(super) fn of(dataset: &Dataset) -> Result<Self> {
        if dataset.test_views().any(View::has_reference) {
            return Ok(Self::References);
        }
        if dataset.test_views().any(View::has_photograph) {
            return Ok(Self::PseudoGt);
        }
        let problem = "has no held-out view to score; list one in transforms_test.json or test.txt, or add photographs: \
                       of eight, one is held out";
        Err(Error::input(&dataset.root, problem))
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::References => "normal-light reference",
            Self::PseudoGt => "pseudo-GT",
        }
    }

    pub(super) fn described(self) -> &'static str {
        match self {
            Self::References => "against their reference images",
            Self::PseudoGt => {
                "against their own pseudo-GT, as there are no reference images: they say how well a model shows its targets, \
                 not how right these are"
            }
        }
    }

    /// As `--json` names it.
    pub(super) fn key(self) -> &'static str {
        match self {
            Self::References => "references",
            Self::PseudoGt => "pseudo_gt",
        }
    }
}

/// Writes what a curve makes of the photographs of a dataset to a folder, which then serves as `--reference`.
///
/// # Errors
/// Those of `nightsplat tone`.
pub(super) fn write_pseudo_gt(
    dataset: &Path,
    settings: ToneSettings,
    device: &str,
    folder: &Path,
) -> Result<()> {
    let args = ToneArgs {
        invert_masks: false,
        profile: None,
        input: dataset.to_owned(),
        curve: settings.curve.into(),
        out: Some(folder.to_owned()),
        gain: None,
        brightness: None,
        colour: None,
        theta: None,
        scene_statistics: false,
        reference: None,
        json: false,
        report: None,
        compare: vec![],
        format: crate::cli::ImageFormat::Png,
        device: Some(device.parse()?),
    };
    tone::apply_settings(&args, settings).map(|_| ())
}
