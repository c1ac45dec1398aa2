//! The scores of test views, a row each.

use nightsplat_core::natural;
use nightsplat_photographs::metrics::Scores;
use nightsplat_photographs::tone::ToneSettings;
use nightsplat_report::{Best, Column, NumberTable};
use serde_json::{Map, Value, json};

use super::ReferenceKind;
use crate::networks::lpips::LpipsVersion;

/// What a score measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// PSNR of the mean squared error over all channels, dB.
    Psnr,
    /// The mean of the three channels' PSNRs, dB.
    PsnrChannelMean,
    /// Mean structural similarity.
    Ssim,
    /// Mean structural similarity with a uniform window of 7x7 and sample covariances.
    SsimUniform,
    /// LPIPS.
    Lpips,
    /// The share of the background that shows through, the mean over the unmasked pixels.
    ResidualTransmittance,
    /// The 99 % quantile of these pixels.
    ResidualTransmittanceQ99,
    /// By how many stops of linear light the render is brighter.
    Stops,
    /// The factor by which the tone curve multiplies small differences of photographs.
    Slope,
}

impl Metric {
    /// Those that compare two images.
    const OF_IMAGES: [Self; 3] = [Self::Psnr, Self::PsnrChannelMean, Self::Ssim];
    /// Those of the model's own renders.
    const OF_MODEL: [Self; 4] = [Self::Psnr, Self::PsnrChannelMean, Self::Ssim, Self::SsimUniform];
    /// Those of the background.
    const OF_BACKGROUND: [Self; 2] = [Self::ResidualTransmittance, Self::ResidualTransmittanceQ99];

    /// The key in `metrics.json`.
    fn key(self) -> &'static str {
        match self {
            Self::Psnr => "psnr",
            Self::PsnrChannelMean => "psnr_channel_mean",
            Self::Ssim => "ssim",
            Self::SsimUniform => "ssim_uniform",
            Self::Lpips => "lpips",
            Self::ResidualTransmittance => "mean",
            Self::ResidualTransmittanceQ99 => "q99",
            Self::Stops => "stops",
            Self::Slope => "slope",
        }
    }
}

/// The last step of an image before it is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// The whole model: R_K, or R_0 without a denoiser.
    Model,
    /// The Gaussians without the denoiser that the model has: R_0.
    Gaussians,
    /// The least-squares gain and bias of each channel.
    GainAndBias,
    /// The exposure of the view's photograph, relative to the mean of the training views.
    OwnExposure,
    /// Light by the lamp at the camera, then the least-squares gain and bias of each channel.
    LampLight,
    /// The inverse of the tone curve.
    InverseCurve,
}

impl After {
    /// The steps with a part of `metrics.json`: its key, its description and its metrics.
    const PARTS: [(Self, &str, &str, &[Metric]); 4] = [
        (
            Self::GainAndBias,
            "aligned_with_reference",
            "after the least-squares gain and bias of each channel of each test view against its reference image",
            &Metric::OF_IMAGES,
        ),
        (
            Self::OwnExposure,
            "at_own_exposure",
            "at each test view's own exposure, from EXIF or exposures.csv: the render is brighter by those \
             stops of linear light; no pixel of a test view is used",
            &Metric::OF_IMAGES,
        ),
        (
            Self::LampLight,
            "lit_by_lamp",
            "in the light of the lamp at the camera, against the dataset's lit/, after the least-squares gain \
             and bias of each channel",
            &Metric::OF_IMAGES,
        ),
        (
            Self::InverseCurve,
            "as_photographs",
            "renders through the inverse of the tone curve, against the dark photographs",
            &[Metric::Psnr, Metric::Stops, Metric::Slope],
        ),
    ];
}

/// A score of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// The view's name.
    pub view: String,
    /// What is measured.
    pub metric: Metric,
    /// The images that the views are compared with.
    pub against: ReferenceKind,
    /// What is done before.
    pub after: After,
    /// The value.
    pub value: f64,
}

/// The scores of test views.
#[derive(Clone, Debug, Default)]
pub struct Evaluation {
    /// A row for each view, metric and step, the views in the order of the dataset.
    pub scores: Vec<Score>,
    /// Whether the background that shows is black sky, and no hole.
    pub(crate) shows_sky: bool,
    /// The version of LPIPS.
    pub(crate) lpips: Option<LpipsVersion>,
    /// The steps whose part of `metrics.json` is written even if no view has it.
    pub(super) requested: Vec<After>,
}

impl Evaluation {
    /// The names of the scored views.
    pub fn views(&self) -> Vec<&str> {
        let is_first = |score: &&Score| (score.metric, score.after) == (Metric::Psnr, After::Model);
        self.scores.iter().filter(is_first).map(|score| score.view.as_str()).collect()
    }

    /// The mean of a metric over the views that have it; `None` without any.
    pub fn mean(&self, metric: Metric, after: After) -> Option<f64> {
        self.value(None, metric, after)
    }

    /// The value of a view or, without a name, the mean over the views.
    pub(crate) fn value(&self, view: Option<&str>, metric: Metric, after: After) -> Option<f64> {
        let is_in_group = |score: &&Score| {
            score.metric == metric
                && score.after == after
                && view.is_none_or(|name| score.view == name)
        };
        let values: Vec<f64> =
            self.scores.iter().filter(is_in_group).map(|score| score.value).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    }

    /// What the renders are compared with; references without any view.
    pub(crate) fn against(&self) -> ReferenceKind {
        self.scores.first().map_or(ReferenceKind::References, |score| score.against)
    }

    /// Note for readers of the scores, unless they are against reference images.
    pub(crate) fn label(&self) -> Option<&'static str> {
        self.against().label()
    }

    /// Adds a row for each of the scores of an image.
    pub(super) fn add(
        &mut self,
        view: &str,
        scores: &Scores,
        against: ReferenceKind,
        after: After,
    ) {
        let Scores { psnr, psnr_channel_mean, ssim } = *scores;
        for (metric, value) in Metric::OF_IMAGES.into_iter().zip([psnr, psnr_channel_mean, ssim]) {
            self.scores.push(Score { view: view.to_owned(), metric, against, after, value });
        }
    }

    /// `metrics.json`: means, views, and the resources of the run; unknown values are null.
    pub(crate) fn json(
        &self,
        seconds: Option<f64>,
        gaussians: Option<usize>,
        steps: Option<u64>,
    ) -> Value {
        let entry = |view: Option<&str>| {
            let mut entry = self.entry(view, After::Model, &Metric::OF_MODEL);
            let before_denoiser = self.entry(view, After::Gaussians, &Metric::OF_IMAGES);
            if !before_denoiser.is_null() {
                entry["r0"] = before_denoiser;
            }
            entry
        };
        let views = self.views().into_iter().map(|name| (name.to_owned(), entry(Some(name))));
        let mut metrics = json!({
            "mean": entry(None),
            "views": views.collect::<Map<_, _>>(),
            "seconds": seconds,
            "gaussians": gaussians,
            "steps": steps,
        });
        if let Some(label) = self.label() {
            metrics[AGAINST] = json!(label);
        }
        if self.mean(Metric::ResidualTransmittance, After::Model).is_some() {
            let mut part = self.part(After::Model, &Metric::OF_BACKGROUND);
            part["views"].as_object_mut().into_iter().for_each(Map::sort_keys);
            metrics["residual_transmittance"] = part;
        }
        self.add_lpips(&mut metrics);
        metrics
    }

    /// Adds LPIPS to `metrics.json`, with the version of the measure.
    pub(crate) fn add_lpips(&self, metrics: &mut Value) {
        let Some(measure) = self.lpips else { return };
        let key = measure.key();
        let LpipsVersion { network, range } = measure;
        metrics["lpips"] = json!({ "network": network.name(), "range": range.name(), "key": key });
        let value = |view| self.value(view, Metric::Lpips, After::Model);
        if let Some(mean) = value(None) {
            metrics["mean"][&key] = json!(mean);
        }
        for name in self.views() {
            if let Some(value) = value(Some(name)) {
                metrics["views"][name][&key] = json!(value);
            }
        }
    }

    /// Adds the scores after other steps to `metrics.json`. Test views have no learned exposure: a model with learned
    /// exposures is scored at the neutral one.
    pub(crate) fn add_other_steps(&self, metrics: &mut Value, learns_exposures: bool) {
        if learns_exposures {
            metrics["exposure"] = json!("neutral: the mean of the training views' in stops");
        }
        for (after, key, what, of) in After::PARTS {
            let has_any = self.scores.iter().any(|score| score.after == after);
            if has_any || self.requested.contains(&after) {
                let part = self.part(after, of);
                metrics[key] =
                    json!({ "what": what, "mean": part["mean"], "views": part["views"] });
            }
        }
    }

    /// The means of some metrics and the values of each view that has them.
    fn part(&self, after: After, of: &[Metric]) -> Value {
        let views = self.views().into_iter();
        let views = views.map(|name| (name.to_owned(), self.entry(Some(name), after, of)));
        let views: Map<String, Value> = views.filter(|(_, entry)| !entry.is_null()).collect();
        json!({ "mean": self.entry(None, after, of), "views": views })
    }

    /// Some metrics of a view, or their means; null without any. The infinite PSNR of equal images is null.
    fn entry(&self, view: Option<&str>, after: After, of: &[Metric]) -> Value {
        let value = |metric: &Metric| Some((metric.key(), self.value(view, *metric, after)?));
        let mut entry = Value::Null;
        of.iter().filter_map(value).for_each(|(key, value)| entry[key] = json!(value));
        entry
    }

    /// The scores of each view, and their means.
    pub(crate) fn table(&self) -> NumberTable {
        let lpips = self.lpips.map(LpipsVersion::title).unwrap_or_default();
        let all = [
            ("PSNR", 2, Metric::Psnr, After::Model),
            ("channel mean", 2, Metric::PsnrChannelMean, After::Model),
            ("SSIM", 4, Metric::Ssim, After::Model),
            ("SSIM, uniform", 4, Metric::SsimUniform, After::Model),
            (lpips.as_str(), 4, Metric::Lpips, After::Model),
            // R_0 is the render before the denoiser.
            ("PSNR of R_0", 2, Metric::Psnr, After::Gaussians),
            ("SSIM of R_0", 4, Metric::Ssim, After::Gaussians),
            ("residual transmittance", 4, Metric::ResidualTransmittance, After::Model),
            ("99 %", 4, Metric::ResidualTransmittanceQ99, After::Model),
            ("PSNR, aligned", 2, Metric::Psnr, After::GainAndBias),
            ("SSIM, aligned", 4, Metric::Ssim, After::GainAndBias),
            ("PSNR, dark", 2, Metric::Psnr, After::InverseCurve),
            ("stops", 3, Metric::Stops, After::InverseCurve),
            ("PSNR, own exposure", 2, Metric::Psnr, After::OwnExposure),
        ];
        let shown = all.iter().filter(|(_, _, metric, after)| self.mean(*metric, *after).is_some());
        let shown: Vec<_> = shown.collect();
        let column = |&&(name, digits, ..): &&(&str, usize, Metric, After)| Column {
            name: name.to_owned(),
            digits,
            best: Best::Unmarked,
        };
        let row = |view: Option<&str>| {
            let values = shown.iter().map(|(.., metric, after)| self.value(view, *metric, *after));
            (view.unwrap_or("mean").to_owned(), values.collect())
        };
        let mean = (!self.scores.is_empty()).then_some(None);
        let mut views = self.views();
        views.sort_by(|a, b| natural::compare(a, b));
        NumberTable {
            title: "Test views".to_owned(),
            label: "view".to_owned(),
            columns: shown.iter().map(column).collect(),
            rows: views.into_iter().map(Some).chain(mean).map(row).collect(),
            ..NumberTable::default()
        }
    }
}

/// Key in `metrics.json` for what the scores are against, unless it is reference images.
pub(crate) const AGAINST: &str = "against";

/// Key in `metrics.json` for targets that another program made.
const TARGETS: &str = "targets";

/// Key in `metrics.json` for what the targets take from reference images, if anything.
pub(crate) const WITH_REFERENCE: &str = "with_reference";

/// The note next to scores whose targets depend on reference images.
pub(crate) fn with_reference(settings: &str) -> String {
    format!(
        "with reference: the targets depend on {settings}; not comparable with scores without reference"
    )
}

/// Adds [`WITH_REFERENCE`] to `metrics.json` if the targets depend on reference images, and their origin if another
/// program made them.
pub(crate) fn add_reference(metrics: &mut Value, tone: &ToneSettings) {
    if tone.targets().is_some() {
        metrics[TARGETS] = json!(tone.curve.to_string());
    }
    if let Some(settings) = tone.knows_references() {
        metrics[WITH_REFERENCE] = json!(settings);
    }
}
