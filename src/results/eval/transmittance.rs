//! Residual transmittance: how much of the background a model lets through.
//!
//! Over a black background, a dark surface needs no Gaussians, and neither loss nor score tells a hole from a dark
//! surface. The residual transmittance of the blend does: the product of 1 - alpha over all splats of a pixel.

use nightsplat_photographs::dataset::{Dataset, View};
use nightsplat_photographs::scene_tone::SceneTone;
use nightsplat_photographs::tone::Tone;
use serde::Serialize;

use super::{Evaluation, Metric};
use crate::Result;
use crate::train::{Background, Rendered, TrainConfig};

/// A view with a higher mean has a hole. No view of a model of a real scene exceeds 0.095 after 400 to 3 500 steps over
/// black (docs/measurements.md).
pub const MAX_RESIDUAL_TRANSMITTANCE: f64 = 0.1;

/// The residual transmittance of a view: 0 if the model is opaque, 1 if it is empty.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ResidualTransmittance {
    /// Mean over the unmasked pixels.
    pub mean: f64,
    /// The 99 % quantile of these pixels.
    pub q99: f64,
}

impl ResidualTransmittance {
    /// Residual transmittance of a render over the pixels that the view's mask keeps; `None` without any, or if the
    /// image is not a render.
    pub fn measure(rendered: &Rendered, view: &View) -> Option<Self> {
        let mut counted = rendered.transmittances.clone()?;
        if let Some(mask) = &view.mask {
            let mask = mask.resized(rendered.colors.width, rendered.colors.height);
            let mut weights = mask.weights.iter();
            counted.retain(|_| weights.next().is_some_and(|&weight| weight >= 0.5));
        }
        Self::of_pixels(&mut counted)
    }

    /// Partially sorts `pixels`.
    fn of_pixels(pixels: &mut [f32]) -> Option<Self> {
        let rank = (99 * pixels.len()).div_ceil(100).checked_sub(1)?;
        let mean = pixels.iter().copied().map(f64::from).sum::<f64>() / pixels.len() as f64;
        let (_, q99, _) = pixels.select_nth_unstable_by(rank, f32::total_cmp);
        Some(Self { mean, q99: (*q99).into() })
    }
}

/// A warning about the view with the largest hole, with a remedy, for a model trained over `background`; `None` if the
/// mean residual transmittance of no view exceeds [`MAX_RESIDUAL_TRANSMITTANCE`].
pub fn hole_warning<'a>(
    views: impl IntoIterator<Item = (&'a str, f64)>,
    background: Background,
) -> Option<String> {
    let views: Vec<(&str, f64)> = views.into_iter().collect();
    let open = views.iter().filter(|(_, mean)| *mean > MAX_RESIDUAL_TRANSMITTANCE);
    let (name, worst) = open.clone().max_by(|(_, a), (_, b)| a.total_cmp(b))?;
    let cause = match background {
        Background::Black => {
            "dark surfaces can stay empty over black; train with `--background random`"
        }
        Background::Random => "no photograph shows this area; take some that do",
    };
    Some(format!(
        "view {name}: {:.0} % of the background shows through the model (above {:.0} % in {} of {} views): {cause}, or \
         mask what is to stay empty",
        100.0 * worst,
        100.0 * MAX_RESIDUAL_TRANSMITTANCE,
        open.count(),
        views.len()
    ))
}

/// Whether the background of a run over black shows as the sky of its photographs, which is no hole.
/// `has_black_sky` is asked only if it can.
pub fn shows_sky(config: &TrainConfig, has_black_sky: impl FnOnce() -> bool) -> bool {
    let can = config.background == Background::Black && config.tone.curve == Tone::Auto;
    can && has_black_sky()
}

/// [`shows_sky`] for a run whose photographs have yet to be measured.
pub fn photographs_show_sky(config: &TrainConfig, dataset: &Dataset) -> bool {
    let scene = || SceneTone::for_dataset(&config.tone, dataset);
    shows_sky(config, || scene().is_ok_and(|scene| scene.has_black_sky()))
}

/// Warns of holes in the scored views of a run's model; without scored views, in some of the training views, which
/// `render` renders.
pub(crate) fn warn_of_holes(
    evaluation: &Evaluation,
    dataset: &Dataset,
    background: Background,
    mut render: impl FnMut(&View) -> Result<Rendered>,
) -> Result<()> {
    /// The maximum number of training views to render, evenly spread.
    const MOST: usize = 8;
    if evaluation.shows_sky {
        return Ok(());
    }
    let scores = evaluation.scores.iter();
    let means = scores.filter(|score| score.metric == Metric::ResidualTransmittance);
    let mut means: Vec<(&str, f64)> =
        means.map(|score| (score.view.as_str(), score.value)).collect();
    if means.is_empty() {
        let views: Vec<&View> = dataset.views.iter().filter(|v| v.is_for_training()).collect();
        for view in views.iter().step_by(views.len().div_ceil(MOST).max(1)) {
            let found = ResidualTransmittance::measure(&render(view)?, view);
            means.extend(found.map(|found| (view.name.as_str(), found.mean)));
        }
    }
    if let Some(warning) = hole_warning(means, background) {
        tracing::warn!("{warning}");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn residual_transmittance_has_the_mean_and_the_99_percent_quantile_of_the_pixels() {
        let mut pixels: Vec<f32> = (0..200).rev().map(|k| k as f32 / 256.0).collect();
        let residual_transmittance = ResidualTransmittance::of_pixels(&mut pixels).unwrap();
        // 198 of 200 have at most 197 / 256.
        assert_eq!(
            residual_transmittance,
            ResidualTransmittance { mean: 99.5 / 256.0, q99: 197.0 / 256.0 }
        );
        assert_eq!(
            ResidualTransmittance::of_pixels(&mut [0.25]),
            Some(ResidualTransmittance { mean: 0.25, q99: 0.25 })
        );
        assert_eq!(ResidualTransmittance::of_pixels(&mut []), None);
    }

    #[test]
    fn the_warning_names_the_worst_view_and_a_remedy() {
        let views = [("a", 0.3), ("b", 0.62), ("c", 0.1)];
        let message = hole_warning(views, Background::Black).unwrap();
        for part in ["view b: 62 %", "above 10 % in 2 of 3 views", "--background random", "mask"] {
            assert!(message.contains(part), "{message}");
        }
        assert!(!message.contains('\n'), "{message}");
        let message = hole_warning(views, Background::Random).unwrap();
        assert!(message.contains("view b") && !message.contains("--background"), "{message}");
        assert_eq!(hole_warning([("c", 0.1)], Background::Black), None);
        assert_eq!(hole_warning([], Background::Black), None);
    }
}
