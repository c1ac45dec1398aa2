//! Verdicts in a sentence: on a set of photographs, and on a trained model.

use super::eval::{After, Evaluation, MAX_RESIDUAL_TRANSMITTANCE, Metric, ReferenceKind};
use nightsplat_diagnose::{Diagnosis, SceneDiagnosis};

/// What a set of photographs is like, and whether anything needs attention.
pub(crate) fn of_set(diagnosis: &Diagnosis) -> String {
    let Diagnosis { scene, views, remarks, .. } = diagnosis;
    let attention = match remarks.len() {
        0 => "nothing needs your attention".to_owned(),
        1 => "one thing needs your attention".to_owned(),
        count => format!("{count} things need your attention"),
    };
    let is_weak = views.len() < 3 || scene.overlap < 0.3 || sharpness(scene) == "blurred";
    let grade = match remarks.len() {
        _ if is_weak => "Weak",
        0 => "Good",
        _ => "Usable",
    };
    let photographs = if views.len() == 1 { "photograph" } else { "photographs" };
    format!(
        "{grade} set: {} {} {photographs}, {}, {}; {attention}",
        views.len(),
        sharpness(scene),
        brightness(scene),
        light(scene)
    )
}

/// Edges of a sharp photograph have half a pixel.
fn sharpness(scene: &SceneDiagnosis) -> &'static str {
    match scene.blur {
        Some(blur) if blur > 3.5 => "blurred",
        Some(blur) if blur > 1.8 => "soft",
        Some(_) => "sharp",
        None => "plain",
    }
}

fn brightness(scene: &SceneDiagnosis) -> String {
    let word = match scene.darkening {
        times if times < 2.0 => return "well lit".to_owned(),
        times if times < 8.0 => "dark",
        _ => "very dark",
    };
    format!("{word} ({:.0} times)", scene.darkening)
}

fn light(scene: &SceneDiagnosis) -> String {
    let lamp = scene.lamp.as_ref().is_some_and(|lamp| lamp.is_found());
    match (scene.exposure_spread, scene.unevenness) {
        _ if lamp => "lit by a lamp that moves with the camera".to_owned(),
        (stops, _) if stops >= 0.3 => format!("exposures that vary by {stops:.1} stops"),
        (_, uneven) if uneven >= 3.0 => format!("light that varies by {uneven:.0} stops in a view"),
        _ => "even light".to_owned(),
    }
}

/// From which PSNR, dB, and SSIM on a score is good, and from which it is fair.
fn grades(against: ReferenceKind) -> [[f64; 2]; 2] {
    match against {
        ReferenceKind::References | ReferenceKind::LitByLamp => [[20.0, 0.75], [16.0, 0.55]],
        ReferenceKind::PseudoGt | ReferenceKind::ExternalTargets | ReferenceKind::Photographs => {
            [[26.0, 0.75], [21.0, 0.55]]
        }
    }
}

/// A view is far below the others from this many dB, and this many standard deviations.
const FAR_BELOW: [f64; 2] = [3.0, 2.0];

/// Whether a model is good, against what, and which views are not; `None` if nothing was scored.
pub(crate) fn of_model(evaluation: &Evaluation) -> Option<String> {
    let mean = |metric, after| evaluation.mean(metric, after);
    let psnr = mean(Metric::Psnr, After::Model)?;
    let ssim = mean(Metric::Ssim, After::Model)?;
    let against = evaluation.against();
    let aligned = mean(Metric::Psnr, After::GainAndBias);
    let let_through = mean(Metric::ResidualTransmittance, After::Model);
    let is_open = let_through.is_some_and(|share| share > MAX_RESIDUAL_TRANSMITTANCE);
    let has_holes = is_open && !evaluation.shows_sky;
    let [good, fair] = grades(against);
    // A gain is a matter of taste, unless it hides everything else.
    let is_at_least = |[least, least_ssim]: [f64; 2]| {
        aligned.unwrap_or(psnr).max(psnr) >= least && ssim >= least_ssim
    };
    let grade = match (is_at_least(good), is_at_least(fair)) {
        (true, _) if !has_holes => "Good",
        (_, true) => "Fair",
        _ => "Poor",
    };
    let images = match against {
        ReferenceKind::References => "the reference images in normal light",
        ReferenceKind::PseudoGt => "their targets, the brightened photographs",
        ReferenceKind::ExternalTargets => "their targets, which another program made",
        ReferenceKind::Photographs => "the photographs themselves",
        ReferenceKind::LitByLamp => "the images in the light of the lamp",
    };
    let views = match evaluation.views().len() {
        1 => "1 test view matches".to_owned(),
        count => format!("{count} test views match"),
    };
    let mut sentence = format!("{grade}: {views} {images}, with PSNR {psnr:.2} dB");
    if let Some(aligned) = aligned {
        sentence += &format!(" ({aligned:.2} after gain and bias)");
    }
    sentence += &format!(", SSIM {ssim:.3}");
    if let Some(share) = let_through {
        let sky = if evaluation.shows_sky { ", as sky" } else { "" };
        sentence += &format!(", {:.1} % of the background shows through{sky}", 100.0 * share);
    }
    let below = far_below(evaluation);
    if let Some((name, psnr)) = below.first() {
        let others = match below.len() {
            1 => String::new(),
            more => format!(" and {} more are", more - 1),
        };
        let is = if others.is_empty() { " is" } else { "" };
        sentence += &format!("; {name}{others}{is} far below, at {psnr:.2} dB");
    }
    Some(sentence)
}

/// The views that are far below the others, the worst first, with their PSNR.
fn far_below(evaluation: &Evaluation) -> Vec<(&str, f64)> {
    let psnr = |name| evaluation.value(Some(name), Metric::Psnr, After::Model);
    let scored = evaluation.views().into_iter().filter_map(|name| Some((name, psnr(name)?)));
    let all: Vec<(&str, f64)> = scored.filter(|(_, psnr)| psnr.is_finite()).collect();
    let count = all.len() as f64;
    let mean = all.iter().map(|(_, psnr)| psnr).sum::<f64>() / count;
    let variance = all.iter().map(|(_, psnr)| (psnr - mean).powi(2)).sum::<f64>() / count;
    let [least, deviations] = FAR_BELOW;
    let limit = mean - least.max(deviations * variance.sqrt());
    let mut below: Vec<(&str, f64)> = all.into_iter().filter(|(_, psnr)| *psnr < limit).collect();
    below.sort_by(|a, b| a.1.total_cmp(&b.1));
    below
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::eval::Score;

    fn evaluation(against: ReferenceKind, psnr: &[f64], ssim: f64, holes: f64) -> Evaluation {
        let of_view = |(index, &psnr): (usize, &f64)| {
            let all = [
                (Metric::Psnr, psnr),
                (Metric::Ssim, ssim),
                (Metric::ResidualTransmittance, holes),
            ];
            let view = format!("v{index}");
            let after = After::Model;
            all.map(|(metric, value)| Score { view: view.clone(), metric, against, after, value })
        };
        let mut evaluation = Evaluation::default();
        evaluation.scores.extend(psnr.iter().enumerate().flat_map(of_view));
        evaluation
    }

    #[test]
    fn a_model_is_good_fair_or_poor_against_what_it_is_scored_with() {
        let of = |against, psnr: &[f64], ssim, holes| {
            of_model(&evaluation(against, psnr, ssim, holes)).unwrap()
        };
        let good = of(ReferenceKind::PseudoGt, &[32.0, 33.22], 0.934, 0.004);
        let expected = "Good: 2 test views match their targets, the brightened photographs, with PSNR 32.61 dB, \
                        SSIM 0.934, 0.4 % of the background shows through";
        assert_eq!(good, expected);
        assert!(
            of(ReferenceKind::References, &[22.0], 0.8, 0.0)
                .starts_with("Good: 1 test view matches")
        );
        assert!(of(ReferenceKind::PseudoGt, &[22.0], 0.8, 0.0).starts_with("Fair"));
        assert!(of(ReferenceKind::PseudoGt, &[32.0], 0.9, 0.3).starts_with("Fair"), "holes");
        let mut open = evaluation(ReferenceKind::PseudoGt, &[32.0], 0.9, 0.3);
        open.shows_sky = true;
        let sky = of_model(&open).unwrap();
        assert!(sky.starts_with("Good") && sky.ends_with("shows through, as sky"), "{sky}");
        assert!(of(ReferenceKind::Photographs, &[12.0], 0.9, 0.0).starts_with("Poor"));
        let far = of(ReferenceKind::References, &[25.0, 26.0, 25.5, 25.5, 26.0, 14.0], 0.8, 0.0);
        assert!(far.ends_with("; v5 is far below, at 14.00 dB"), "{far}");
        assert_eq!(of_model(&Evaluation::default()), None);
    }

    #[test]
    fn a_set_is_good_if_nothing_is_wrong_with_it() {
        let scene = SceneDiagnosis {
            darkening: 40.2,
            blur: Some(0.7),
            overlap: 0.8,
            ..SceneDiagnosis::default()
        };
        assert_eq!(
            [sharpness(&scene), &brightness(&scene), &light(&scene)],
            ["sharp", "very dark (40 times)", "even light"]
        );
        let odd = SceneDiagnosis {
            darkening: 1.2,
            blur: Some(2.0),
            exposure_spread: 1.25,
            ..SceneDiagnosis::default()
        };
        let words = [sharpness(&odd), &brightness(&odd), &light(&odd)];
        assert_eq!(words, ["soft", "well lit", "exposures that vary by 1.2 stops"]);
    }
}
