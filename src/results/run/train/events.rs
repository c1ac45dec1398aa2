//! What a run tells while it trains: scores, and events for `TensorBoard`.

use nightsplat_models::attributes::{ATTRIBUTES, AttributeSpec};
use nightsplat_photographs::image::ImageFile as _;

use super::TrainLoop;
use crate::Result;
use crate::results::eval::{After, Evaluation, Metric, ScoredImages};
use crate::results::run::{Event, RunDirectory};
use crate::train::{StepReport, Trainer};

impl TrainLoop<'_> {
    /// Writes every tenth step for `TensorBoard`.
    pub(super) fn write_events(
        &mut self,
        trainer: &Trainer,
        directory: &RunDirectory,
        reports: &[StepReport],
    ) -> Result<()> {
        const EVERY: u64 = 10;
        let events = match &mut self.events {
            Some(events) => events,
            None => self.events.insert(directory.events(self.begin)?),
        };
        let named = |group: &str, name: &str, value| (format!("{group}/{name}"), value);
        for StepReport { step, loss, terms, gaussians, milliseconds, .. } in reports {
            if !step.is_multiple_of(EVERY) && *step < trainer.last_step() {
                continue;
            }
            let mut values = vec![("loss/all".to_owned(), *loss)];
            values.extend(terms.iter().map(|(term, value)| named("loss", term.column, *value)));
            values.push(("model/Gaussians".to_owned(), *gaussians as f64));
            values.push(("model/milliseconds a step".to_owned(), *milliseconds));
            let rates = trainer.learning_rates(*step);
            let rate = |spec: &AttributeSpec| named("rates", spec.name, rates[spec.attribute]);
            values.extend(ATTRIBUTES.iter().map(rate));
            events.scalars(*step, &values)?;
        }
        events.flush()
    }

    /// Writes and reports the scores of the held-out views since the last call, and the last step once it is certain.
    pub(super) fn log_scores(
        &mut self,
        trainer: &Trainer,
        directory: &RunDirectory,
        observe: &mut impl FnMut(Event<'_>),
    ) -> Result<()> {
        let scores: Vec<(u64, f64)> = trainer.held_out_scores().collect();
        if scores.len() > self.told {
            directory.save_held_out(&scores)?;
        }
        for &(step, psnr) in scores.get(self.told..).unwrap_or_default() {
            observe(Event::HeldOut { step, psnr });
            if let Some(events) = &mut self.events {
                events
                    .scalars(step, &[("held-out views against targets/PSNR".to_owned(), psnr)])?;
            }
        }
        let end = (trainer.last_step(), trainer.may_end_early());
        if end != self.end && !trainer.may_end_early() {
            observe(Event::LastStep { step: trainer.steps_done(), last: trainer.last_step() });
        }
        (self.told, self.end) = (scores.len(), end);
        Ok(())
    }

    /// Writes the render of a test view, and the image that it is compared with.
    pub(super) fn write_event_images(
        &mut self,
        step: u64,
        ScoredImages { view, render, target, against, .. }: &ScoredImages<'_>,
    ) -> Result<()> {
        let Some(events) = &mut self.events else { return Ok(()) };
        for (what, image) in [("render", render), (against.name(), target)] {
            let image = view.upright(image.clone());
            let size = [image.width, image.height];
            events.picture(step, &format!("view {}/{what}", view.name), size, &image.to_png8()?)?;
        }
        Ok(())
    }

    /// Writes the mean scores.
    pub(super) fn write_event_scores(&mut self, step: u64, evaluation: &Evaluation) -> Result<()> {
        let Some(events) = &mut self.events else { return Ok(()) };
        let against = evaluation.against().name();
        let named = [
            ("PSNR", Metric::Psnr),
            ("channel-mean PSNR", Metric::PsnrChannelMean),
            ("SSIM", Metric::Ssim),
        ];
        let value = |(name, metric)| {
            let mean = evaluation.mean(metric, After::Model)?;
            Some((format!("test views against {against}/{name}"), mean))
        };
        let values: Vec<(String, f64)> = named.into_iter().filter_map(value).collect();
        if values.is_empty() {
            return Ok(());
        }
        events.scalars(step, &values)?;
        events.flush()
    }
}
