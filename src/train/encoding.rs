//! The tone mapping of a scene, as a lamp needs it: from linear light to the colours of a model.

use nightsplat_photographs::image::{Image, linear_from_srgb};

use crate::Result;
use crate::splats::lamp::Lamp;
use crate::targets::Targets;

/// The tone curve of a lamp's colours; [`Lamp`] has its formula.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LampToneLaw {
    /// The target of no light.
    pub(super) black: f64,
    /// d ln(target - black) / d ln light near black.
    pub(super) slope: f64,
    /// The target above black to which it saturates; 0: it does not.
    pub(super) reach: f64,
}

impl LampToneLaw {
    /// That of grey, fitted to the targets of all photographs together; light is linear.
    pub(super) fn measured(targets: &Targets) -> Result<Self> {
        /// The shares of the pixels that are darker than the greys that it is fitted to.
        const SHARES: [f64; 9] = [0.05, 0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9, 0.99];
        let together = targets.scene.together();
        let luminance = &together.luminance;
        let mut greys = SHARES.map(|share| luminance.quantile(share) as f32).to_vec();
        greys.retain(|&grey| grey > 0.0);
        greys.dedup();
        if greys.len() < 2 {
            let mean = luminance.mean() as f32;
            greys = vec![0.5 * mean, mean];
        }
        let row: Vec<f32> = [0.0].into_iter().chain(greys.iter().copied()).collect();
        let grey = Image { width: row.len() as u32, height: 1, data: row.repeat(3) };
        let target = targets.tone_mapped(&grey, together)?.data;
        let black = f64::from(target[0]);
        let light = |grey: f32| f64::from(linear_from_srgb(grey)).ln();
        let above = target[1..].iter().map(|&value| f64::from(value) - black);
        let known: Vec<[f64; 2]> = (greys.iter().map(|&grey| light(grey)).zip(above))
            .filter(|&(light, above)| light.is_finite() && above > 0.0 && above + black < 0.999)
            .map(|(light, above)| [light, above])
            .collect();
        Ok(Self::fitted(black, &known))
    }

    /// That which is nearest to (ln light, target above black) in the logarithm, by least squares.
    fn fitted(black: f64, samples: &[[f64; 2]]) -> Self {
        /// The reaches that are tried, over the largest target: a curve beyond the last one is as good as a power.
        const REACHES: i32 = 24;
        /// Of a curve that is flat, and of one that is steeper than light.
        const SLOPES: [f64; 2] = [0.1, 2.0];
        let largest = samples.iter().fold(0.0_f64, |largest, point| largest.max(point[1]));
        let reaches = (0..REACHES).map(|k| largest * (1.0 + 0.02 * 1.4_f64.powi(k)));
        let fit = |reach: f64| {
            let x =
                |above: f64| if reach == 0.0 { above } else { -reach * (-above / reach).ln_1p() };
            let points = samples.iter().map(|&[light, above]| [light, x(above).ln()]);
            let (slope, residual) = line(&points.collect::<Vec<_>>());
            (residual, Self { black, slope, reach })
        };
        let all = [0.0].into_iter().chain(reaches).map(fit);
        let best =
            all.filter(|(residual, _)| residual.is_finite()).min_by(|a, b| a.0.total_cmp(&b.0));
        let usual = Self { black, slope: Lamp::AT_CAMERA.slope, reach: 0.0 };
        let encoding = best.map_or(usual, |(_, encoding)| encoding);
        Self { slope: encoding.slope.clamp(SLOPES[0], SLOPES[1]), ..encoding }
    }
}

/// The slope of the line of least squares through points, and the sum of its squared residuals.
fn line(points: &[[f64; 2]]) -> (f64, f64) {
    let mean =
        |axis: usize| points.iter().map(|point| point[axis]).sum::<f64>() / points.len() as f64;
    let middle = [0, 1].map(mean);
    let product = |a: usize, b: usize| {
        points.iter().map(|point| (point[a] - middle[a]) * (point[b] - middle[b])).sum::<f64>()
    };
    let slope = product(0, 1) / product(0, 0);
    (slope, product(1, 1) - slope * product(0, 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_that_saturates_is_found_and_a_power_does_not() {
        let lights = (0..9).map(|k| 0.002 * 2.0_f64.powi(k));
        let curve = |reach: f64| {
            let bent = lights.clone().map(|light| (light, 1.8 * light.powf(0.6)));
            let target = |x: f64| if reach == 0.0 { x } else { reach * (1.0 - (-x / reach).exp()) };
            bent.map(|(light, x)| [light.ln(), target(x)]).collect::<Vec<_>>()
        };
        let found = LampToneLaw::fitted(0.07, &curve(0.8));
        assert!((found.slope - 0.6).abs() < 0.02 && (found.reach - 0.8).abs() < 0.05, "{found:?}");
        let power = LampToneLaw::fitted(0.07, &curve(0.0));
        assert!((power.slope - 0.6).abs() < 1e-9 && power.reach == 0.0, "{power:?}");
    }

    #[test]
    fn a_curve_of_which_hardly_anything_is_known_has_the_slope_of_a_display() {
        let usual = LampToneLaw { black: 0.0, slope: Lamp::AT_CAMERA.slope, reach: 0.0 };
        for known in [&[][..], &[[0.0, 0.5]], &[[0.0, 0.5], [0.0, 0.5]]] {
            assert_eq!(LampToneLaw::fitted(0.0, known), usual, "{known:?}");
        }
    }
}
