//! The diagnosis of all photographs together.

use nightsplat_photographs::image::srgb_from_linear;
use nightsplat_photographs::tone::Exposure;
use serde::Serialize;

use super::geometry::{SceneGeometry, deviation, median};
use super::lamp::bands::BandsDiagnosis;
use super::lamp::falloff::FalloffDiagnosis;
use super::lamp::{LampDiagnosis, LampObservations};
use super::noise::{self, ChannelNoise};
use super::photograph::{PhotographStatistics, darkening};
use super::{TargetNoise, ViewDiagnosis};

/// The diagnosis of all training photographs except black ones; means over the views unless stated otherwise.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs, reason = "as in `ViewDiagnosis`")]
pub struct SceneDiagnosis {
    pub p10: f64,
    pub p90: f64,
    pub r: f64,
    pub mean_luminance: f64,
    pub cubic_mean: f64,
    pub light: f64,
    /// 0.18 over the mean light.
    pub darkening: f64,
    /// The brightness of the targets over that of the photographs; below 1.5 no curve is needed.
    pub brightening: f64,
    /// The share of pixels that `--curve auto` brings near white, 0.94 or more.
    pub brought_near_white: f64,
    /// The mean share of a photograph that is black sky.
    pub black_sky: f64,
    /// The gain of `--curve auto`, for encoded values.
    pub gain: f64,
    /// The standard deviation of the views' exposures, in stops; of their gains, if the points do not determine
    /// exposures.
    pub exposure_spread: f64,
    /// Whether the spread is measured at shared points.
    pub spread_is_measured: bool,
    /// The fraction of a view's exposure that its own gain compensates.
    pub exposure_share: f64,
    pub near_white_fraction: f64,
    pub zero_fraction: f64,
    pub code_values: f64,
    /// Fitted to the patches of all views.
    pub noise: Option<ChannelNoise>,
    /// The medians over the views.
    pub noise_in_target: Option<TargetNoise>,
    /// The noise left in a target after averaging the views of a point, as a standard deviation of encoded values.
    pub target_noise: f64,
    /// The median over the views.
    pub blur: Option<f64>,
    pub unevenness: f64,
    pub overlap: f64,
    /// The mean number of training views that see a point.
    pub views_per_point: f64,
    /// The number of points in the dataset.
    pub points: usize,
    /// How much a lamp that moves with the camera explains; `None` if the points do not show it.
    pub lamp: Option<LampDiagnosis>,
    /// Why they do not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lamp_unknown: Option<String>,
    /// The fall-off of the lens, before it was corrected; `None` if the points do not show it.
    pub falloff: Option<FalloffDiagnosis>,
    /// Bands of rows, before they were corrected; `None` if the points do not show them.
    pub bands: Option<BandsDiagnosis>,
}

impl SceneDiagnosis {
    pub(super) fn new(
        views: &[ViewDiagnosis],
        photographs: Vec<PhotographStatistics>,
        shared: &SceneGeometry,
        shading: Result<(FalloffDiagnosis, BandsDiagnosis, LampObservations), String>,
        exposure: &Exposure,
        points: usize,
    ) -> Self {
        let patches = photographs.into_iter().zip(views).filter(|(_, view)| !view.is_black);
        let patches = patches.flat_map(|(one, _)| one.patches);
        let lit: Vec<&ViewDiagnosis> = views.iter().filter(|view| !view.is_black).collect();
        let mean = |of: fn(&ViewDiagnosis) -> f64| {
            lit.iter().map(|view| of(view)).sum::<f64>() / lit.len().max(1) as f64
        };
        let tracks = shading.as_ref().map(|(.., tracks)| tracks).map_err(Clone::clone);
        let (noise, lamp) =
            rayon::join(|| noise::fit(patches.collect()), || tracks.and_then(LampDiagnosis::new));
        let (falloff, bands) = shading.ok().map(|(falloff, bands, _)| (falloff, bands)).unzip();
        let is_lamp = lamp.as_ref().is_ok_and(LampDiagnosis::is_found);
        let measured = deviation(lit.iter().filter_map(|view| view.exposure));
        let light = mean(|view| view.light);
        Self {
            p10: mean(|view| view.p10),
            p90: mean(|view| view.p90),
            r: mean(|view| view.r),
            mean_luminance: mean(|view| view.mean_luminance),
            cubic_mean: mean(|view| view.cubic_mean),
            light,
            darkening: darkening(light),
            brightening: exposure.brightening(),
            brought_near_white: 0.0,
            black_sky: exposure.sky,
            gain: exposure.gain,
            exposure_spread: measured.unwrap_or(exposure.spread / std::f64::consts::LN_2),
            spread_is_measured: measured.is_some(),
            exposure_share: exposure.share,
            near_white_fraction: mean(|view| view.near_white_fraction),
            zero_fraction: mean(|view| view.zero_fraction),
            code_values: mean(|view| view.code_values as f64),
            noise,
            noise_in_target: TargetNoise::median(lit.iter().filter_map(|one| one.noise_in_target)),
            target_noise: noise.map_or(0.0, |noise| target_noise(noise, light, exposure, shared)),
            blur: median(lit.iter().filter_map(|view| view.blur).collect()),
            unevenness: mean(|view| view.unevenness),
            overlap: mean(|view| view.overlap),
            views_per_point: shared.views_per_point,
            points,
            lamp_unknown: lamp.as_ref().err().cloned(),
            lamp: lamp.ok(),
            // A lamp's light falls as well.
            falloff: falloff.filter(|_| !is_lamp),
            bands,
        }
    }
}

/// The noise of a target at the mean light, averaged over the views of a point.
fn target_noise(
    noise: ChannelNoise,
    light: f64,
    exposure: &Exposure,
    shared: &SceneGeometry,
) -> f64 {
    let encoded = f64::from(srgb_from_linear(light as f32));
    let weight = exposure.weight();
    // The curve's slope at the photograph's mean; 1 without a curve.
    let soft = |x: f64| exposure.ends.soft(x, exposure.gain);
    let step = 1e-4;
    let slope = (soft(encoded + step) - soft(encoded - step)) / (2.0 * step);
    let slope = weight * slope + (1.0 - weight);
    slope * noise.deviation(light) / noise::slope(light) / shared.views_per_point.max(1.0).sqrt()
}
