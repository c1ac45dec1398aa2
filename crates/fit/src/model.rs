//! A curve as a function of its fitted values.

use std::borrow::Cow;

use nightsplat_core::{Error, Result};
use nightsplat_photographs::tone::{
    ALPHA, BASE_GAIN, Constant, Constants, CurveNumbers, Dual, GAIN_C, Real, Statistics, THETA,
    Tone, ToneCurve, ToneSettings, clamped, curve_at,
};

use super::{FitOptions, Pair};

/// A setting that is not among the constants of a formula; it starts at the curve's value.
const fn setting(name: &'static str, low: f64, high: f64) -> Constant {
    Constant { name: Cow::Borrowed(name), default: low, start: low, bounds: [low, high] }
}

/// Those after the constants, in the order of [`CurveNumbers`].
const SETTINGS: [Constant; 4] = [
    setting("theta", 0.05, 1.0),
    setting("alpha", 0.0, 0.5),
    setting("gain_c", 0.0, 20.0),
    setting("base_gain", 0.1, 10.0),
];

/// A curve with the list of its fitted values.
#[derive(Clone, Debug)]
pub(super) struct FitModel {
    /// With the curve's own constants.
    pub(super) initial: ToneSettings,
    /// The positions of the fitted values among the numbers of the curve.
    slots: Vec<usize>,
    /// In the order of every vector of values.
    pub(super) free: Vec<Constant>,
}

/// The effect of a photograph's exposure on its curve.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChannelExposure {
    statistics: Statistics,
    channel: usize,
}

impl ChannelExposure {
    /// For several photographs together: only t matters.
    pub(super) const POOLED: Self = Self {
        statistics: Statistics {
            p10: 1.0,
            p80: 1.0,
            p90: 1.0,
            mean_luminance: 0.0,
            mean: 1.0,
            channel_means: [1.0; 3],
        },
        channel: 0,
    };

    pub(super) fn new(statistics: Statistics, channel: usize) -> Self {
        Self { statistics, channel }
    }

    pub(super) fn p90(&self) -> f64 {
        self.statistics.p90.into()
    }
}

impl FitModel {
    pub(super) fn new(curve: &Tone, options: &FitOptions) -> Result<Self> {
        let initial = own_settings(curve);
        let family = curve.family();
        if options.adapt && family.is_none() {
            return Err(Error::Usage(format!(
                "`{curve}` has no black level and gain to adapt; make them constants of the formula"
            )));
        }
        let mut slots: Vec<usize> = (0..initial.constants.len()).collect();
        if curve.is_of_t() {
            if options.adapt || initial.alpha > 0.0 || initial.gain_c > 0.0 {
                slots.extend([ALPHA, GAIN_C]);
                if family.is_some_and(|family| family.is_rescaled) {
                    slots.push(BASE_GAIN);
                }
            }
        } else if family.is_some_and(|family| family.curve != ToneCurve::None) {
            slots.push(THETA);
        }
        if slots.is_empty() {
            return Err(Error::Usage(format!("the curve `{curve}` has no constants to fit")));
        }
        let numbers = initial.numbers();
        let free = slots.iter().map(|&slot| match curve.constants().get(slot) {
            Some(constant) => Constant { default: numbers[slot], ..constant.clone() },
            None => {
                let setting = SETTINGS[slot - THETA].clone();
                Constant { default: numbers[slot], start: numbers[slot], ..setting }
            }
        });
        Ok(Self { free: free.collect(), initial, slots })
    }

    /// Whether photographs with different statistics have different curves of t.
    pub(super) fn differs_by_photograph(&self) -> bool {
        !self.initial.curve.is_of_t() || self.slots.iter().any(|&slot| slot >= THETA)
    }

    /// Whether the channels of a photograph have different curves.
    pub(super) fn differs_by_channel(&self) -> bool {
        self.initial.curve == ToneCurve::PerChannel
    }

    /// Whether the shape f has constants; otherwise the curve rises for any black level, white and gain.
    pub(super) fn has_shape(&self) -> bool {
        !self.initial.constants.is_empty()
    }

    /// The curve with these values.
    pub(super) fn settings(&self, values: &[f64]) -> ToneSettings {
        self.initial.with_numbers(&self.numbers(values))
    }

    /// The numbers of the curve with these values.
    fn numbers(&self, values: &[f64]) -> CurveNumbers<f64> {
        let mut numbers = self.initial.numbers();
        self.slots.iter().zip(values).for_each(|(&slot, &value)| numbers[slot] = value);
        numbers
    }

    /// The curve of a photograph of this exposure with these values.
    pub(super) fn curve(&self, values: &[f64], exposure: &ChannelExposure) -> CurveOfT<'_, f64> {
        CurveOfT::new(&self.initial, exposure, &self.numbers(values))
    }

    /// [`Self::curve`] with its derivatives with respect to every value.
    pub(super) fn slopes(&self, values: &[f64], exposure: &ChannelExposure) -> Slopes<'_> {
        let numbers = self.numbers(values).map(Dual::from_f64);
        let by = |&slot: &usize| {
            let mut numbers = numbers;
            numbers[slot].derivative = 1.0;
            CurveOfT::new(&self.initial, exposure, &numbers)
        };
        Slopes(self.slots.iter().map(by).collect())
    }
}

/// A curve with its own constants; where a formula gives none a value, that at which a fit starts.
pub(super) fn own_settings(curve: &Tone) -> ToneSettings {
    let mut settings = ToneSettings::new(curve.clone());
    for (value, constant) in settings.constants.iter_mut().zip(curve.constants()) {
        *value = if value.is_nan() { constant.start } else { *value };
    }
    settings
}

/// The curve of a photograph, or of one of its channels, as a function of t = x / p90.
#[derive(Clone, Copy, Debug)]
pub(super) struct CurveOfT<'a, T> {
    p90: f64,
    curve: &'a Tone,
    /// White, black level and gain.
    scale: [T; 3],
    constants: Constants<T>,
}

impl<'a, T: Real> CurveOfT<'a, T> {
    fn new(
        settings: &'a ToneSettings,
        exposure: &ChannelExposure,
        numbers: &CurveNumbers<T>,
    ) -> Self {
        let [constants @ .., _, _, _, _] = *numbers;
        let scale = settings.scale(&exposure.statistics, exposure.channel, numbers);
        Self { p90: exposure.p90(), curve: &settings.curve, scale, constants }
    }

    /// At t, clamped.
    pub(super) fn at(&self, t: f64) -> T {
        clamped(self.raw_at(t))
    }

    /// At t, unclamped.
    pub(super) fn raw_at(&self, t: f64) -> T {
        let [white, offset, gain] = self.scale;
        let t = T::from_f64(t * self.p90) / white;
        match self.curve {
            Tone::Expression(expression) => expression.at(t, &self.constants),
            curve => curve_at(curve.constant(), t, [offset, gain], &self.constants),
        }
    }
}

/// The derivatives of a curve with respect to every value of its model; those that are not finite count as 0.
#[derive(Clone, Debug)]
pub(super) struct Slopes<'a>(Vec<CurveOfT<'a, Dual>>);

impl Slopes<'_> {
    /// Of the clamped curve at t.
    pub(super) fn at(&self, t: f64) -> impl Iterator<Item = f64> {
        self.0.iter().map(move |curve| counted(curve.at(t)))
    }

    /// Of the unclamped curve at t.
    pub(super) fn raw_at(&self, t: f64) -> impl Iterator<Item = f64> {
        self.0.iter().map(move |curve| counted(curve.raw_at(t)))
    }
}

fn counted(number: Dual) -> f64 {
    if number.derivative.is_finite() { number.derivative } else { 0.0 }
}

/// The PSNR over all pixels and channels of the dark photograph tone-mapped with `settings`, dB.
pub fn psnr(settings: &ToneSettings, pair: &Pair) -> f64 {
    let [mut count, mut squares] = [0.0; 2];
    for (channel, histogram) in pair.channels.iter().enumerate() {
        let exposure = ChannelExposure::new(pair.statistics, channel);
        let curve = CurveOfT::new(settings, &exposure, &settings.numbers());
        squares += histogram.residuals(|x| curve.at(x / exposure.p90()))[1];
        count += histogram.count();
    }
    -10.0 * (squares.max(0.0) / count).log10()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_photographs::tone::FAMILIES;

    #[test]
    fn every_family_agrees_with_the_kernels() {
        let statistics = Statistics {
            p10: 0.01,
            p80: 0.11,
            p90: 0.13,
            mean_luminance: 0.06,
            mean: 0.055,
            channel_means: [0.05, 0.06, 0.055],
        };
        for family in &FAMILIES {
            let settings = ToneSettings::new(family.curve);
            let parameters = settings.parameters(&statistics);
            for x in [0.0, 0.004, 0.03, 0.13, 0.3, 0.9] {
                for channel in 0..3 {
                    let exposure = ChannelExposure::new(statistics, channel);
                    let curve = CurveOfT::new(&settings, &exposure, &settings.numbers());
                    let found = curve.at(x / exposure.p90());
                    let expected = if family.curve == ToneCurve::PerChannel {
                        clamped(x as f32 / parameters.constants[channel])
                    } else {
                        family.curve.apply(x as f32, &parameters)
                    };
                    let error = (found - f64::from(expected)).abs();
                    assert!(error < 2e-6, "{}({x}): {found}, not {expected}", family.name);
                }
            }
        }
    }

    #[test]
    fn gradients_agree_with_central_differences() {
        let statistics = Statistics {
            p10: 0.02,
            p80: 0.2,
            p90: 0.3,
            mean_luminance: 0.15,
            mean: 0.14,
            channel_means: [0.14; 3],
        };
        let exposure = ChannelExposure::new(statistics, 1);
        let families = FAMILIES.iter().filter(|family| family.curve != ToneCurve::None);
        let of_ones_own = "a*t^b/(t^b+exp(-c*t)); c = 0.3".parse().unwrap();
        let curves = families.map(|family| Tone::Formula(family.curve)).chain([of_ones_own]);
        for curve in curves {
            let adapt = curve.family().is_some();
            let options = FitOptions { adapt, ..FitOptions::default() };
            let model = FitModel::new(&curve, &options).unwrap();
            let values: Vec<f64> = model.free.iter().map(|constant| constant.start).collect();
            for t in [0.05, 0.17, 0.61] {
                for (index, exact) in model.slopes(&values, &exposure).raw_at(t).enumerate() {
                    let h = 1e-6 * values[index].abs().max(1e-3);
                    let at = |shift: f64| {
                        let mut values = values.clone();
                        values[index] += shift;
                        model.curve(&values, &exposure).raw_at(t)
                    };
                    let difference = (at(h) - at(-h)) / (2.0 * h);
                    let what = &model.free[index].name;
                    let error = (exact - difference).abs();
                    assert!(
                        error < 1e-6 * (1.0 + exact.abs()),
                        "{curve} by {what}: {exact}, not {difference}"
                    );
                }
            }
        }
    }
}
