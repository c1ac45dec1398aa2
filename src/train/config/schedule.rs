//! The schedule of a run of this length.

use super::TrainConfig;

impl TrainConfig {
    /// The number of cooldown steps: the schedule's, or a third of a short run.
    pub(crate) fn effective_cooldown_steps(&self) -> u64 {
        self.schedule.cooldown_steps.min(self.steps / 3)
    }

    /// The steps before which views have a quarter and half of their width and height: the schedule's, or none and a
    /// share of the run.
    pub(crate) fn resolution_steps(&self) -> [u64; 2] {
        /// Coarse shapes and colours settle in small views, whose steps are short; details need the rest of the run.
        const MOST: u64 = 1_000;
        self.schedule.resolution_steps.unwrap_or([0, (self.steps / 5).min(MOST)])
    }

    /// How often the views of `step` are halved.
    pub(crate) fn resolution_level(&self, step: u64) -> usize {
        match self.resolution_steps() {
            [quarter, _] if step < quarter => 2,
            [_, half] if step < half => 1,
            _ => 0,
        }
    }

    /// The number of resolution levels.
    pub(crate) fn resolution_levels(&self) -> usize {
        1 + self.resolution_level(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_grow_to_their_size_in_the_first_fifth_of_a_run() {
        let mut config = TrainConfig::default();
        for (steps, half) in [(5_000, 1_000), (30_000, 1_000), (400, 80), (4, 0)] {
            config.steps = steps;
            assert_eq!(config.resolution_steps(), [0, half]);
            assert_eq!(config.resolution_levels(), if half > 0 { 2 } else { 1 });
        }
        config.schedule.resolution_steps = Some([10, 20]);
        assert_eq!([1, 9, 10, 19, 20].map(|step| config.resolution_level(step)), [2, 2, 1, 1, 0]);
        assert_eq!(config.resolution_levels(), 3);
    }
}
