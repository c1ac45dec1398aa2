//! The end of a run: by its last step, or early because its held-out views have stopped improving or it was requested.

use serde::{Deserialize, Serialize};

/// The reason for the end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EndReason {
    /// The held-out views have stopped improving.
    Converged,
    /// All steps are done.
    Steps,
    /// Somebody requested it.
    Requested,
}

/// The end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// The reason.
    pub reason: EndReason,
    /// Its last step.
    pub step: u64,
    /// The step whose model is kept: the last, unless the held-out views scored higher at an earlier one.
    pub best_step: u64,
}

impl std::fmt::Display for Ended {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { reason, step, best_step } = self;
        let why = match reason {
            EndReason::Converged => "the held-out views have converged",
            EndReason::Steps => "all steps are done",
            EndReason::Requested => "its end was requested",
        };
        write!(out, "ended at step {step}: {why}")?;
        if best_step == step {
            Ok(())
        } else {
            write!(out, "; the model of step {best_step} is kept")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::gpu;
    use crate::train::{StopConfig, TrainConfig, Trainer};
    use nightsplat_photographs::dataset::Dataset;
    use nightsplat_synth::SyntheticOptions;

    #[test]
    fn a_run_ends_once_two_scores_in_a_row_gain_too_little() {
        let stop = StopConfig { gain: 0.05, detail_gain: 0.1, ..StopConfig::default() };
        for (scores, ends) in [
            (&[][..], false),
            (&[20.0, 20.0], false),
            (&[20.0, 20.02, 20.04], true),
            (&[20.0, 19.0, 20.06], false),
            (&[20.0, 20.5, 20.5, 20.5], true),
            (&[20.0, 21.0, 20.0, 20.9], true),
            (&[20.0, 20.1, 20.2, 20.3, 20.4], false),
        ] {
            let alone: Vec<_> = scores.iter().map(|score| [*score, 0.5]).collect();
            assert_eq!(stop.has_converged(&alone), ends, "{scores:?}");
            // As long as detail grows the run goes on.
            let grows = scores.iter().zip(1..).map(|(score, step)| [*score, 0.2 * f64::from(step)]);
            assert!(!stop.has_converged(&grows.collect::<Vec<_>>()), "{scores:?}");
        }
    }

    /// A call may return before `step` on a slow machine.
    fn train_until(trainer: &mut Trainer, step: u64) {
        while trainer.clock.step < step {
            trainer.train_steps(step, &mut vec![]).unwrap();
        }
    }

    /// A trainer on a small set with a held-out view, after some steps and a score.
    fn scored(margin: f64) -> Trainer {
        let folder = tempfile::tempdir().unwrap();
        let options = SyntheticOptions {
            views: 10,
            width: 32,
            height: 24,
            seed: 3,
            ..SyntheticOptions::default()
        };
        nightsplat_synth::write(folder.path(), &options).unwrap();
        let mut config = TrainConfig { steps: 20, ..TrainConfig::bare() };
        (config.stop.views, config.stop.margin) = (1, margin);
        config.schedule.resolution_steps = Some([0, 0]);
        let dataset = Dataset::load(folder.path(), &config.load_options()).unwrap();
        let mut trainer = Trainer::new(&gpu(), config, &dataset).unwrap();
        train_until(&mut trainer, 12);
        trainer.score_held_out().unwrap();
        trainer
    }

    #[test]
    fn a_run_that_ends_worse_is_restored_and_one_within_the_margin_is_not() {
        for (margin, best_step) in [(0.25, 12), (90.0, 20)] {
            let mut trainer = scored(margin);
            let best = trainer.gaussians().unwrap();
            train_until(&mut trainer, 20);
            // Damage: no Gaussian is visible.
            let gpu = trainer.gpu.clone();
            let parameters = &mut trainer.model.gaussians.values.parameters;
            let faint = vec![-20.0; parameters.len()];
            gpu.write(parameters, &faint).unwrap();
            trainer.score_held_out().unwrap();
            let ended = trainer.end().unwrap();
            assert_eq!(ended, Ended { reason: EndReason::Steps, step: 20, best_step });
            assert_eq!(trainer.gaussians().unwrap() == best, best_step == 12);
            assert_eq!(ended.to_string().contains("the model of step 12 is kept"), best_step == 12);
        }
    }

    #[test]
    fn the_best_model_survives_a_killed_process() {
        let mut trainer = scored(0.25);
        let file = tempfile::NamedTempFile::new().unwrap();
        let best = trainer.gaussians().unwrap();
        train_until(&mut trainer, 16);
        trainer.save_checkpoint(file.path()).unwrap();
        let mut restored = scored(0.25);
        restored.model.best.clear();
        restored.restore(file.path()).unwrap();
        assert_eq!(
            (restored.clock.step, restored.model.best.len()),
            (16, trainer.model.best.len())
        );
        let kept = restored.model.best.clone();
        restored.restore_snapshot(&kept).unwrap();
        assert!(restored.gaussians().unwrap() == best);
    }
}
