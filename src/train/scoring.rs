//! The held-out views in a run: their scores, and what is decided by them.

use nightsplat_core::camera::Camera;

use super::call::{Call, Scored};
use super::decisions::{HeldOutScore, PATIENCE, RecordedRound};
use super::early_stopping::Ended;
use super::model::TrainedModel;
use super::rendered::Rendered;
use super::supervision::Supervision;
use super::target_views::TargetViews;
use super::terms::NetworkTerms;
use super::trainer::Trainer;
use crate::Result;

impl Trainer {
    /// The mean PSNR, dB, of the Gaussians' colours on the held-out views against their targets; `None` without
    /// held-out views.
    #[doc(hidden)]
    pub fn held_out_psnr(&mut self) -> Result<Option<f64>> {
        let mut whole = Call::default();
        std::mem::swap(&mut whole, &mut self.clock.submissions.call);
        let psnr = self.held_out_psnr_for(Scored::Model, self.clock.sh_degree(self.clock.step));
        std::mem::swap(&mut whole, &mut self.clock.submissions.call);
        psnr
    }

    /// [`Trainer::held_out_psnr`] with a given SH degree, as far as the call has time.
    fn held_out_psnr_for(&mut self, what: Scored, sh_degree: u32) -> Result<Option<f64>> {
        let affines = self.supervision.affines()?;
        let Self { supervision: Supervision { held_out, networks, .. }, model, clock, .. } = self;
        let part = (&mut clock.submissions.call, what);
        let psnr = held_out.mean_psnr(part, &affines, renders(model, networks, sh_degree))?;
        Ok(psnr.map(|[colors, _]| colors))
    }

    /// Scores the held-out views, keeps the model if it is the best so far, and decides whether the run has converged.
    pub(super) fn score_held_out(&mut self) -> Result<()> {
        let _phase = tracing::info_span!("scoring").entered();
        let (step, affines) = (self.clock.step, self.supervision.affines()?);
        let Self { supervision: Supervision { held_out, networks, .. }, model, clock, .. } = self;
        let renders = renders(model, networks, clock.sh_degree(step));
        let part = (&mut clock.submissions.call, Scored::Model);
        let scores = held_out.mean_psnr_and_detail(part, &affines, renders)?;
        clock.submissions.call.decided(Scored::Model);
        let Some([psnr, detail]) = scores else { return Ok(()) };
        let [score, detail] = [1e3 * psnr, 1e6 * detail].map(|score| score.round() as i64);
        let score = HeldOutScore { step, score, detail };
        tracing::debug!(
            "step {step}: held-out views {psnr:.3} dB, detail {:.5}",
            detail as f64 / 1e6
        );
        let is_best = self.clock.best_score().is_none_or(|best| score.score > best.score);
        let [_, whole] = self.config.resolution_steps();
        if is_best && step >= whole {
            self.model.best = self.snapshot()?;
        }
        self.clock.decisions.scores.push(score);
        let in_units = |score: HeldOutScore| [score.score as f64 / 1e3, score.detail as f64 / 1e6];
        let scores: Vec<[f64; 2]> = self.clock.whole_scores().map(in_units).collect();
        if self.clock.may_end_early() && self.config.stop.has_converged(&scores) {
            self.clock.decisions.converged = Some(step);
            tracing::info!(
                "step {step}: the held-out views have converged; the run ends at step {}",
                self.last_step()
            );
        }
        Ok(())
    }

    /// The limit of Gaussians from the held-out views, decided before every round of density control.
    pub(super) fn growth_limit(&mut self) -> Result<usize> {
        let (growth_gain, step) = (self.config.stop.growth_gain, self.clock.step);
        let [_, whole] = self.config.resolution_steps();
        let gaussians = self.model.count();
        // A score taken before memory ran out is not taken again.
        let is_scored = self.clock.decisions.rounds.last().is_some_and(|round| round.step == step);
        if growth_gain > 0.0 && self.clock.decisions.gaussians.is_none() && step >= whole {
            let degree = self.clock.sh_degree(step);
            let psnr = match is_scored {
                true => None,
                false => self.held_out_psnr_for(Scored::Growth, degree)?,
            };
            if let Some(psnr) = psnr {
                let score = (1e3 * psnr).round() as i64;
                self.clock.decisions.rounds.push(RecordedRound { step, score, gaussians });
            }
            if self.clock.decisions.gains_too_little(growth_gain) {
                self.clock.decisions.gaussians = Some(gaussians);
                tracing::info!(
                    "step {step}: growth ends at {gaussians} Gaussians: {PATIENCE} rounds gained less on the held-out \
                     views than {growth_gain} dB for each doubling"
                );
            }
        }
        Ok(self.clock.decisions.gaussians.unwrap_or(usize::MAX))
    }

    /// Compares the held-out views with and without the SH degree in use; a degree that gains too little is removed for
    /// good.
    pub(super) fn decide_degree(&mut self) -> Result<()> {
        let step = self.clock.step;
        let (degree, least) = (self.clock.sh_degree(step), self.config.stop.degree_gain);
        let with = self.held_out_psnr_for(Scored::Degree(degree), degree)?;
        let without = self.held_out_psnr_for(Scored::Degree(degree - 1), degree - 1)?;
        let Some((with, without)) = with.zip(without) else { return Ok(()) };
        let gain = with - without;
        if gain >= least {
            tracing::info!("step {step}: SH degree {degree} gains {gain:.2} dB");
            return Ok(());
        }
        tracing::info!(
            "step {step}: SH degree {degree} gains {gain:.2} dB on the held-out views, less than {least}: it stays at \
             {}",
            degree - 1
        );
        self.model.set_sh_degree(&self.gpu, degree - 1)?;
        self.clock.decisions.sh_degree = Some(degree - 1);
        Ok(())
    }

    /// Ends the run with its best model: if the last score is lower than the best by more than
    /// [`StopConfig::margin`](super::StopConfig::margin), the model of the best is restored. No steps may follow; to
    /// continue later, save a checkpoint first.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn end(&mut self) -> Result<Ended> {
        if std::mem::take(&mut self.clock.decisions.score_due) {
            self.score_held_out()?;
        }
        let step = self.clock.step;
        let reason = self.clock.end_reason();
        let last = self.clock.decisions.scores.last().filter(|last| last.step == step);
        let lost =
            |best: &HeldOutScore| last.map_or(0.0, |last| (best.score - last.score) as f64 / 1e3);
        let better = self.clock.best_score().filter(|best| lost(best) > self.config.stop.margin);
        let best = std::mem::take(&mut self.model.best);
        if better.is_some() {
            self.restore_snapshot(&best)?;
        }
        Ok(Ended { reason, step, best_step: better.map_or(step, |better| better.step) })
    }

    /// Resets the denoiser to the identity if it hardly improves the held-out views (or, without any, some training
    /// views) over R_0. Called at the end of a run; the paper's denoiser is kept.
    pub(crate) fn drop_unused_denoiser(&mut self) -> Result<()> {
        /// In dB; on few views, smaller gains are chance.
        const MIN_GAIN: f64 = 0.05;
        if !self.supervision.networks.as_ref().is_some_and(NetworkTerms::follow_target) {
            return Ok(());
        }
        let affines = self.supervision.affines()?;
        let Self { supervision, model, clock, .. } = self;
        let Supervision { views, targets, held_out, networks, .. } = supervision;
        let training = match held_out.is_empty() {
            true => Some(TargetViews::of_training(views, &targets.pseudo_gt)?),
            false => None,
        };
        let renders = renders(model, networks, clock.sh_degree(clock.step));
        let part = (&mut Call::default(), Scored::Model);
        let scores = training.as_ref().unwrap_or(held_out).mean_psnr(part, &affines, renders)?;
        let Some([colors, denoised]) = scores else { return Ok(()) };
        let gain = denoised - colors;
        if gain >= MIN_GAIN {
            tracing::info!("the denoiser gains {gain:.2} dB on targets");
            return Ok(());
        }
        tracing::info!("the denoiser gains nothing on targets ({gain:.2} dB) and is dropped");
        let networks = self.supervision.networks.as_mut();
        match networks.and_then(|terms| terms.networks.denoiser.as_mut()) {
            Some(denoiser) => denoiser.become_identity(),
            None => Ok(()),
        }
    }
}

/// Renders of cameras in the training frame, with the networks if the model has any.
fn renders(
    model: &mut TrainedModel,
    networks: &mut Option<NetworkTerms>,
    sh_degree: u32,
) -> impl FnMut(&Camera) -> Result<Rendered> {
    let mut networks = networks.as_mut().map(|terms| &mut terms.networks);
    move |camera| model.render(camera, sh_degree, networks.as_deref_mut())
}
