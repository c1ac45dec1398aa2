//! The axes of the plots.

/// A range of values and where it lies on the drawing.
pub(super) struct Axis {
    low: f64,
    high: f64,
    /// Between ticks; a round number.
    step: f64,
    from: f64,
    to: f64,
}

impl Axis {
    /// The axis from `from` to `to` that holds all of the values, with round ends.
    pub(super) fn around(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        const TICKS: f64 = 5.0;
        let (low, high) = values
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let (low, high) = match (low <= high, low < high) {
            (false, _) => (0.0, 1.0),
            // All values are one; the margin must not vanish in rounding.
            (true, false) => (low - 0.5 - 0.01 * low.abs(), high + 0.5 + 0.01 * high.abs()),
            (true, true) => (low, high),
        };
        let rough = high / TICKS - low / TICKS;
        let power = 10f64.powf(rough.log10().floor());
        let step = power
            * [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= rough).unwrap_or(10.0);
        Self { low: (low / step).floor() * step, high: (high / step).ceil() * step, step, from, to }
    }

    /// Whether a value lies on the axis.
    pub(super) fn contains(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    pub(super) fn ticks(&self) -> impl Iterator<Item = f64> {
        let count = ((self.high - self.low) / self.step).round() as u32;
        (0..=count).map(|tick| self.low + f64::from(tick) * self.step)
    }

    pub(super) fn place(&self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    pub(super) fn label(&self, tick: f64) -> String {
        let digits = (-self.step.log10().floor()).clamp(0.0, 6.0) as usize;
        let label = format!("{tick:.digits$}");
        if label.trim_start_matches('-').chars().all(|digit| matches!(digit, '0' | '.')) {
            "0".to_owned()
        } else {
            label
        }
    }
}
