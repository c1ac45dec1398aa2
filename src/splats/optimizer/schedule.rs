//! Schedules by step: learning rates, SH degree, gradient damping, density control.

use std::collections::BTreeMap;
use std::ops::{Index, IndexMut};

use nightsplat_core::settings;
use nightsplat_core::settings::{Rule, Setting};
use nightsplat_models::attributes::{ATTRIBUTES, Attribute};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::Result;
use crate::kernels::sh::MAX_SH_DEGREE;

/// Adam's learning rate of each attribute, by its name in TOML; that of the means in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRates(pub [f64; ATTRIBUTES.len()]);

impl LearningRates {
    /// The same rate for every attribute.
    #[doc(hidden)]
    pub const fn uniform(rate: f64) -> Self {
        Self([rate; ATTRIBUTES.len()])
    }

    /// Every rate times `factor`.
    pub(crate) fn scaled(self, factor: f64) -> Self {
        Self(self.0.map(|rate| factor * rate))
    }
}

/// The initial rates of the table.
impl Default for LearningRates {
    fn default() -> Self {
        Self(ATTRIBUTES.each_ref().map(|spec| spec.learning_rate))
    }
}

impl Index<Attribute> for LearningRates {
    type Output = f64;

    fn index(&self, attribute: Attribute) -> &f64 {
        &self.0[attribute as usize]
    }
}

impl IndexMut<Attribute> for LearningRates {
    fn index_mut(&mut self, attribute: Attribute) -> &mut f64 {
        &mut self.0[attribute as usize]
    }
}

impl Serialize for LearningRates {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(ATTRIBUTES.iter().map(|spec| spec.name).zip(self.0))
    }
}

impl<'de> Deserialize<'de> for LearningRates {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut rates = Self::default();
        for (name, rate) in BTreeMap::<String, f64>::deserialize(deserializer)? {
            let spec = ATTRIBUTES.iter().find(|spec| spec.name == name).ok_or_else(|| {
                let names = ATTRIBUTES.each_ref().map(|spec| spec.name).join(", ");
                D::Error::custom(format!("unknown attribute `{name}`, expected one of {names}"))
            })?;
            rates[spec.attribute] = rate;
        }
        Ok(rates)
    }
}

settings! {
"schedule."
/// The schedules as functions of the step, counted from 1. The defaults are those of 3DGS (Kerbl et al. 2023), except
/// for density control, which starts early, for the first steps, which see small views, and for the cooldown.
#[derive(Clone, Debug, PartialEq)]
pub struct Schedule {
    /// The learning rate of the means at the end of its decay, for a scene of extent 1.
    final_means_rate: f64 = 1.6e-6 => Rule::above(0.0, MAX_RATE);
    /// Steps over which the learning rate of the means decays exponentially.
    means_rate_steps: u64 = 30_000 => Rule::COUNT, in "steps";
    /// All learning rates but the opacity's start at this multiple and decay exponentially to 1.
    initial_rate_factor: f64 = 4.0 => Rule::from_to(1e-3, 1e3);
    /// Steps over which that multiple decays.
    initial_rate_steps: u64 = 600 => Rule::COUNT, in "steps";
    /// The SH degree in use in the first step.
    first_sh_degree: Option<u32> = None, "0; that of the model where `init` gives one"
        => Rule::Whole(0, MAX_SH_DEGREE as u64);
    /// The SH degree in use grows by one after each interval of this many steps.
    sh_degree_interval: u64 = 1_000 => Rule::COUNT, in "steps";
    /// Density control acts after this step.
    densify_after: u64 = 50 => Rule::COUNT;
    /// Density control acts before this step.
    densify_before: u64 = 3_000 => Rule::COUNT;
    /// Steps from one round of density control to the next.
    densify_interval: u64 = 100 => Rule::COUNT, in "steps";
    /// The cooldown: the last steps of a run, at most a third of it, without density control and with exponentially
    /// decaying learning rates.
    cooldown_steps: u64 = 250 => Rule::COUNT, in "steps";
    /// The factor on the learning rates at the end of the cooldown.
    cooldown_rate: f64 = 0.05 => Rule::above(0.0, 1.0);
    /// Views have a quarter of their width and height before the first of these steps, half before the second.
    resolution_steps: Option<[u64; 2]> = None, "0, and a fifth of the steps, at most 1000"
        => Rule::List(2, 2, &Rule::COUNT), in "steps";
    /// The weight of the near-camera damping is 1 before the first of these steps, 1/2 before the second, then 0.
    damping_steps: [u64; 2] = [4_000, 7_000] => Rule::List(2, 2, &Rule::COUNT), in "steps";
}
sections {
    /// Initial learning rates; that of the means for a scene of extent 1.
    initial_rates: LearningRates;
}
}

/// Far above any useful rate, and a step with it cannot overflow.
const MAX_RATE: f64 = 100.0;

impl LearningRates {
    /// A row for each rate.
    pub(crate) fn settings() -> impl Iterator<Item = Setting> {
        ATTRIBUTES.iter().map(|spec| Setting {
            key: format!("schedule.initial_rates.{}", spec.name).into(),
            rule: match spec.attribute {
                // The decay of the means' rate divides by it.
                Attribute::Means => Rule::above(0.0, MAX_RATE),
                _ => Rule::from_to(0.0, MAX_RATE),
            },
            unit: "",
            help: &["Adam's rate at the start; that of the means is for a scene of extent 1."],
            absent: None,
            option: None,
        })
    }
}

impl Schedule {
    /// Checks the values.
    pub(crate) fn check(&self) -> Result<()> {
        self.check_rows()?;
        LearningRates::settings()
            .zip(&self.initial_rates.0)
            .try_for_each(|(row, rate)| row.check(rate))
    }

    /// Density control acts between steps 500 and 5 000, every 200 steps, and every step has full resolution (LITA-GS).
    #[cfg(test)]
    pub(crate) fn paper() -> Self {
        Self {
            initial_rate_factor: 1.0,
            initial_rate_steps: 0,
            densify_after: 500,
            densify_before: 5_000,
            densify_interval: 200,
            resolution_steps: Some([0, 0]),
            cooldown_steps: 0,
            ..Self::default()
        }
    }

    /// The learning rates of `step` in a scene of `extent`: that of the means decays log-linearly, the others are
    /// constant.
    #[doc(hidden)]
    pub fn learning_rates(&self, step: u64, extent: f64) -> LearningRates {
        let mut rates = self.initial_rates;
        rates[Attribute::Means] = self.means_rate(step) * extent;
        let initial_rate_factor = self.rate_factor(step);
        if initial_rate_factor != 1.0 {
            let opacity = rates[Attribute::RawOpacities];
            rates.0.iter_mut().for_each(|rate| *rate *= initial_rate_factor);
            rates[Attribute::RawOpacities] = opacity;
        }
        rates
    }

    /// The learning rate of the means at `step`, for a scene of extent 1, without the factor of the first steps.
    fn means_rate(&self, step: u64) -> f64 {
        let done = (step as f64 / self.means_rate_steps.max(1) as f64).min(1.0);
        let initial = self.initial_rates[Attribute::Means];
        initial * (self.final_means_rate / initial).powf(done)
    }

    /// The factor on all learning rates but the opacity's at `step`.
    fn rate_factor(&self, step: u64) -> f64 {
        let left = 1.0 - (step as f64 / self.initial_rate_steps.max(1) as f64).min(1.0);
        if left > 0.0 { self.initial_rate_factor.powf(left) } else { 1.0 }
    }

    /// What is left of the schedule after `step`, with `factor` steps for each of this schedule's. With fewer views, a
    /// Gaussian is in more of the steps. Adam divides by the root mean square of the gradients of all steps, also those
    /// that do not show it, and so moves it less in each: rates rise by the root of `factor`.
    pub(crate) fn after_step(&self, step: u64, factor: f64) -> Self {
        let scaled = |steps: u64| (steps as f64 * factor).round() as u64;
        let left = |until: u64| scaled(until.saturating_sub(step));
        let by = factor.sqrt().recip();
        let mut initial_rates = self.initial_rates;
        initial_rates[Attribute::Means] = self.means_rate(step);
        Self {
            final_means_rate: by * self.final_means_rate,
            means_rate_steps: left(self.means_rate_steps),
            initial_rate_factor: self.rate_factor(step),
            initial_rate_steps: left(self.initial_rate_steps),
            first_sh_degree: Some(self.sh_degree(step, MAX_SH_DEGREE)),
            sh_degree_interval: scaled(self.sh_degree_interval).max(1),
            densify_after: left(self.densify_after),
            densify_before: left(self.densify_before),
            densify_interval: scaled(self.densify_interval).max(1),
            cooldown_steps: scaled(self.cooldown_steps),
            resolution_steps: Some(self.resolution_steps.unwrap_or_default().map(left)),
            damping_steps: self.damping_steps.map(left),
            initial_rates: initial_rates.scaled(by),
            ..self.clone()
        }
    }

    /// The SH degree in use in `step`, at most `max`.
    #[doc(hidden)]
    pub fn sh_degree(&self, step: u64, max: u32) -> u32 {
        let first = u64::from(self.first_sh_degree.unwrap_or_default());
        let degree = first.saturating_add(step / self.sh_degree_interval.max(1));
        degree.min(u64::from(max)) as u32
    }

    /// Whether a round of density control follows `step`.
    pub(crate) fn densifies_at(&self, step: u64) -> bool {
        step > self.densify_after
            && step < self.densify_before
            && step.is_multiple_of(self.densify_interval.max(1))
    }

    /// The step that the first round of density control follows, if there is one.
    pub(crate) fn first_round(&self) -> u64 {
        let interval = self.densify_interval.max(1);
        (self.densify_after / interval).saturating_add(1).saturating_mul(interval)
    }

    /// The factor on the learning rates after this fraction of the cooldown.
    pub(crate) fn cooldown_factor(&self, done: f64) -> f64 {
        self.cooldown_rate.powf(done.clamp(0.0, 1.0))
    }

    /// The number of rounds of density control from the end of `step` on, that one included, up to step `last`.
    pub(crate) fn rounds_left(&self, step: u64, last: u64) -> u64 {
        let interval = self.densify_interval.max(1);
        self.densify_before.saturating_sub(1).min(last).saturating_sub(step) / interval + 1
    }

    /// The weight w of the near-camera damping of the screen gradients that density control reads: they are
    /// multiplied by w min(1, (z / extent)^2) + 1 - w (Pixel-GS).
    pub(crate) fn damping_weight(&self, step: u64) -> f32 {
        match self.damping_steps {
            [full, _] if step < full => 1.0,
            [_, half] if step < half => 0.5,
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_means_rate_decays_a_hundredfold_and_stays() {
        let schedule = Schedule::paper();
        let rate = |step| schedule.learning_rates(step, 2.0)[Attribute::Means];
        assert!((rate(0) - 3.2e-4).abs() < 1e-12);
        assert!((rate(15_000) - 3.2e-5).abs() < 1e-12);
        assert!((rate(30_000) - 3.2e-6).abs() < 1e-12);
        assert!((rate(90_000) - 3.2e-6).abs() < 1e-12);
        assert_eq!(schedule.learning_rates(7, 2.0)[Attribute::Quats], 0.001);
    }

    #[test]
    fn the_rest_of_a_schedule_goes_on_where_the_whole_is_at_any_pace() {
        let whole = Schedule { means_rate_steps: 2_000, ..Schedule::default() };
        for (step, factor) in [(400, 0.25), (1_000, 1.0), (2_500, 0.1)] {
            let rest = whole.after_step(step, factor);
            for later in [0_u32, 200, 1_000] {
                let rates = rest.learning_rates((f64::from(later) * factor) as u64, 3.0);
                let expected = whole.learning_rates(step + u64::from(later), 3.0);
                for (rate, expected) in rates.0.into_iter().zip(expected.0) {
                    let by = factor.sqrt().recip();
                    assert!((rate / expected / by - 1.0).abs() < 1e-9, "{step} {factor} {later}");
                }
            }
            assert_eq!(rest.sh_degree(0, 3), whole.sh_degree(step, 3));
            assert_eq!(rest.resolution_steps, Some([0, 0]));
        }
        assert_eq!(whole.after_step(1_000, 0.1).densify_interval, 10);
        assert_eq!(whole.after_step(1_000, 0.1).densify_before, 200);
    }

    #[test]
    fn the_sh_degree_grows_every_thousand_steps() {
        let schedule = Schedule::default();
        let degrees =
            [1, 999, 1_000, 2_999, 3_000, 100_000].map(|step| schedule.sh_degree(step, 3));
        assert_eq!(degrees, [0, 0, 1, 2, 3, 3]);
        assert_eq!(schedule.sh_degree(5_000, 1), 1);
        let later = Schedule { first_sh_degree: Some(2), ..schedule };
        assert_eq!([1, 1_000, 2_000].map(|step| later.sh_degree(step, 3)), [2, 3, 3]);
    }

    #[test]
    fn density_control_acts_strictly_inside_its_window() {
        let schedule = Schedule::paper();
        let steps: Vec<u64> = (0..=6_000).filter(|&step| schedule.densifies_at(step)).collect();
        assert_eq!((steps[0], steps[1], *steps.last().unwrap()), (600, 800, 4_800));
        assert!(!Schedule { densify_after: 600, ..schedule.clone() }.densifies_at(600));
        for (densify_after, densify_interval) in [(500, 200), (600, 200), (50, 100), (0, 1), (7, 0)]
        {
            let schedule = Schedule { densify_after, densify_interval, ..schedule.clone() };
            let first = (1..).find(|&step| schedule.densifies_at(step));
            assert_eq!(first, Some(schedule.first_round()));
        }
    }

    #[test]
    fn the_rounds_left_fall_to_one() {
        let schedule = Schedule::paper();
        assert_eq!(
            [600, 800, 4_600, 4_800].map(|step| schedule.rounds_left(step, 9_000)),
            [22, 21, 2, 1]
        );
        assert_eq!([600, 800].map(|step| schedule.rounds_left(step, 1_100)), [3, 2]);
    }

    #[test]
    fn the_initial_rate_factor_decays_to_one() {
        let schedule =
            Schedule { initial_rate_factor: 4.0, initial_rate_steps: 100, ..Schedule::paper() };
        let rate = |step| schedule.learning_rates(step, 1.0)[Attribute::Quats];
        assert_eq!(schedule.learning_rates(0, 1.0)[Attribute::RawOpacities], 0.05);
        assert!((rate(0) - 0.004).abs() < 1e-12 && (rate(50) - 0.002).abs() < 1e-12);
        for step in [100, 5_000] {
            assert_eq!(
                schedule.learning_rates(step, 1.0),
                Schedule::paper().learning_rates(step, 1.0)
            );
        }
    }

    #[test]
    fn damping_decreases_in_two_steps() {
        let schedule = Schedule::default();
        let weights = [1, 3_999, 4_000, 6_999, 7_000].map(|step| schedule.damping_weight(step));
        assert_eq!(weights, [1.0, 1.0, 0.5, 0.5, 0.0]);
    }

    #[test]
    fn an_interval_of_zero_does_not_divide_by_zero() {
        let schedule = Schedule {
            means_rate_steps: 0,
            sh_degree_interval: 0,
            densify_interval: 0,
            ..Default::default()
        };
        assert!(schedule.learning_rates(1, 1.0)[Attribute::Means].is_finite());
        assert_eq!(schedule.sh_degree(2, 3), 2);
        assert!(schedule.densifies_at(501));
        assert!(schedule.rounds_left(1, 1) > 0);
    }
}
