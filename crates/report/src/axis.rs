//! The axes of the charts.

/// A range of values and its position in the drawing.
pub(super) struct Axis {
    low: f64,
    high: f64,
    /// Distance of ticks, a round number; `None` on a logarithmic axis.
    step: Option<f64>,
    pub(super) from: f64,
    to: f64,
}

impl Axis {
    /// The axis from `from` to `to` with round ends that contains all values.
    pub(super) fn around(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        const TICKS: f64 = 5.0;
        let (low, high) = values
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let (low, high) = match (low <= high, low < high) {
            (false, _) => (0.0, 1.0),
            // All values are equal; the margin must survive rounding.
            (true, false) => (low - 0.5 - 0.01 * low.abs(), high + 0.5 + 0.01 * high.abs()),
            (true, true) => (low, high),
        };
        let rough = high / TICKS - low / TICKS;
        let power = 10f64.powf(rough.log10().floor());
        let step = power
            * [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= rough).unwrap_or(10.0);
        let (low, high) = ((low / step).floor() * step, (high / step).ceil() * step);
        Self { low, high, step: Some(step), from, to }
    }

    /// [`Self::around`] on a logarithmic scale, for values above 1e-9; from 1 to 10 without any.
    pub(super) fn logarithmic(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let (low, high) = values
            .filter(|value| *value > 1e-9)
            .fold((f64::INFINITY, 0.0), |(low, high): (f64, f64), v| (low.min(v), high.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (1.0, 10.0) };
        // A value equal to a tick must not add a decade by rounding.
        let below = round_values(low / 10.0).filter(|tick| *tick <= low * (1.0 + 1e-9)).last();
        let above = round_values(low).find(|tick| *tick >= high * (1.0 - 1e-9) && *tick > low);
        let (low, high) = (below.unwrap_or(low), above.unwrap_or(10.0 * high));
        Self { low, high, step: None, from, to }
    }

    /// The axis of rows from `from` to `to`, each of length 1.
    pub(super) fn rows(count: usize, from: f64, to: f64) -> Self {
        Self { low: 0.0, high: count as f64, step: Some(1.0), from, to }
    }

    pub(super) fn is_logarithmic(&self) -> bool {
        self.step.is_none()
    }

    /// Whether a value lies on the axis.
    pub(super) fn contains(&self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }

    /// The lowest value.
    pub(super) fn start(&self) -> f64 {
        self.low
    }

    pub(super) fn ticks(&self) -> Vec<f64> {
        let Some(step) = self.step else {
            let ticks: Vec<f64> = round_values(self.low)
                .skip_while(|tick| *tick < self.low * 0.999)
                .take_while(|tick| *tick <= self.high * 1.001)
                .collect();
            // Many ticks are reduced to decades.
            let is_shown = |tick: &f64| ticks.len() <= 9 || (tick.log10().fract()).abs() < 1e-6;
            return ticks.iter().copied().filter(is_shown).collect();
        };
        let count = ((self.high - self.low) / step).round() as u32;
        (0..=count).map(|tick| self.low + f64::from(tick) * step).collect()
    }

    pub(super) fn position(&self, value: f64) -> f64 {
        let scaled = |value: f64| if self.step.is_some() { value } else { value.max(1e-30).ln() };
        let (low, high) = (scaled(self.low), scaled(self.high));
        self.from + (scaled(value) - low) / (high - low) * (self.to - self.from)
    }

    pub(super) fn label(&self, tick: f64) -> String {
        let digits = self.step.map_or(-tick.log10().floor(), |step| -step.log10().floor());
        let digits = digits.clamp(0.0, 6.0) as usize;
        let label = format!("{tick:.digits$}");
        if label.trim_start_matches('-').chars().all(|digit| matches!(digit, '0' | '.')) {
            "0".to_owned()
        } else {
            label
        }
    }
}

/// 1, 2 and 5 times powers of ten in order, from the decade of `value`.
fn round_values(value: f64) -> impl Iterator<Item = f64> {
    let first = value.log10().floor() as i32;
    (first..first + 40).flat_map(|power| [1.0, 2.0, 5.0].map(|digit| digit * 10f64.powi(power)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_logarithmic_axis_has_its_values_between_round_ends() {
        let of = |values: &[f64]| {
            let axis = Axis::logarithmic(values.iter().copied(), 0.0, 100.0);
            (axis.low, axis.high)
        };
        let close = |(a, b): (f64, f64), (low, high): (f64, f64)| {
            assert!((a / low - 1.0).abs() < 1e-9 && (b / high - 1.0).abs() < 1e-9, "{a} {b}");
        };
        close(of(&[8.0, 94.0]), (5.0, 100.0));
        close(of(&[10.0, 200.0]), (10.0, 200.0));
        close(of(&[3.0]), (2.0, 5.0));
        close(of(&[2.0]), (2.0, 5.0));
        close(of(&[0.0, f64::NAN]), (1.0, 10.0));
        let axis = Axis::logarithmic([5.0, 100.0].into_iter(), 0.0, 100.0);
        let labels: Vec<String> = axis.ticks().into_iter().map(|tick| axis.label(tick)).collect();
        assert_eq!(labels, ["5", "10", "20", "50", "100"]);
        assert!((axis.position(5.0)).abs() < 1e-9 && (axis.position(100.0) - 100.0).abs() < 1e-9);
        // Equal ratios have equal distances.
        assert!(
            (axis.position(20.0) - axis.position(10.0) - axis.position(100.0)
                + axis.position(50.0))
            .abs()
                < 1e-9
        );
    }
}
