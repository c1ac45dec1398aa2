//! Progress of a run as a bar, lines or JSON.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use nightsplat_core::output::duration;
use serde_json::{Map, Value, json};

use super::{phases, tell, tell_on_stderr};
use crate::results::eval::{After, Evaluation, Metric, ReferenceKind};
use crate::results::run::Event;
use crate::train::{MemoryEstimate, StepReport};

/// The form of progress output.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ProgressForm {
    /// A bar on standard error
    Bar,
    /// A line on standard error every ten seconds
    Plain,
    /// One line of JSON per event on standard output, steps every ten seconds
    Json,
    /// None, only the result
    None,
}

impl ProgressForm {
    /// A bar if standard error is a terminal, else lines.
    pub(crate) fn of_terminal() -> Self {
        if std::io::stderr().is_terminal() { Self::Bar } else { Self::Plain }
    }
}

/// Time between two lines.
const SILENCE: Duration = Duration::from_secs(10);

/// The memory estimate in a line.
fn foreseen(memory: &MemoryEstimate) -> String {
    let size = |bytes: u64| match bytes >> 20 {
        mebibytes @ 0..10_000 => format!("{mebibytes} MiB"),
        mebibytes => format!("{:.1} GiB", mebibytes as f64 / 1024.0),
    };
    let MemoryEstimate { gaussians, device, host, peak_gaussians, peak_device, peak_host } = memory;
    let now = format!(
        "memory for {gaussians} Gaussians: {} on the device, {} on the host",
        size(*device),
        size(*host)
    );
    if peak_gaussians == gaussians {
        return now;
    }
    let (peak_device, peak_host) = (size(*peak_device), size(*peak_host));
    format!("{now}; for at most {peak_gaussians}, {peak_device} and {peak_host}")
}

/// Reports the events of a run.
#[derive(Debug)]
pub(crate) struct Reporter {
    form: ProgressForm,
    /// Begins every line and the bar.
    prefix: String,
    /// Added to the JSON of the start event.
    facts: Value,
    bar: ProgressBar,
    /// The last step, as far as known.
    steps: u64,
    /// Whether early stopping may end the run before that.
    may_end_early: bool,
    /// The last score of the held-out views, dB.
    held_out: Option<f64>,
    /// Time and step of the start.
    begin: (Instant, u64),
    last_line: Instant,
}

impl Reporter {
    pub(crate) fn new(form: ProgressForm, prefix: &str) -> Self {
        let now = Instant::now();
        Self {
            form,
            prefix: prefix.to_owned(),
            facts: json!({}),
            bar: ProgressBar::hidden(),
            steps: 0,
            may_end_early: false,
            held_out: None,
            begin: (now, 0),
            last_line: now,
        }
    }

    /// Adds facts to the JSON of the start event.
    pub(crate) fn with_facts(self, facts: Value) -> Self {
        Self { facts, ..self }
    }

    /// Reports an event.
    pub(crate) fn observe(&mut self, event: Event<'_>) {
        match event {
            Event::Started { step, steps, may_end_early, .. } => {
                let now = Instant::now();
                (self.steps, self.may_end_early) = (steps, may_end_early);
                (self.begin, self.last_line) = ((now, step), now);
            }
            Event::LastStep { last, .. } => (self.steps, self.may_end_early) = (last, false),
            Event::HeldOut { psnr, .. } => self.held_out = Some(psnr),
            _ => {}
        }
        match self.form {
            ProgressForm::Bar => self.draw(event),
            ProgressForm::Plain => self.write(event),
            ProgressForm::Json => self.print(event),
            ProgressForm::None => {}
        }
    }

    fn draw(&mut self, event: Event<'_>) {
        match event {
            Event::Started { step, memory, .. } => {
                tell_on_stderr(foreseen(memory));
                let bar = ProgressBar::new(self.steps).with_position(step);
                self.bar = bar.with_prefix(self.prefix.clone());
                self.bar.set_style(style(self.may_end_early));
            }
            Event::LastStep { last, .. } => {
                self.bar.set_length(last);
                self.bar.set_style(style(self.may_end_early));
            }
            Event::Step(report) => {
                self.bar.set_position(report.step);
                self.bar.set_message(self.state(report));
            }
            Event::Evaluated { step, evaluation } => {
                if let Some(line) = summary(evaluation).filter(|_| step < self.steps) {
                    self.bar.suspend(|| tell_on_stderr(format!("step {step}: {line}")));
                }
            }
            Event::Finished(_) => self.bar.finish_and_clear(),
            _ => {}
        }
    }

    fn write(&mut self, event: Event<'_>) {
        match event {
            Event::Started { memory, .. } => tell_on_stderr(foreseen(memory)),
            Event::Step(report) if self.is_due() => {
                tell_on_stderr(format_args!("{}{}", self.prefix, self.line(report)));
            }
            Event::HeldOut { step, psnr } => {
                tell_on_stderr(format!(
                    "step {step}: held-out views {psnr:.2} dB against their targets"
                ));
            }
            Event::Evaluated { step, evaluation } => {
                if let Some(line) = summary(evaluation).filter(|_| step < self.steps) {
                    tell_on_stderr(format!("step {step}: {line}"));
                }
            }
            _ => {}
        }
    }

    fn print(&mut self, event: Event<'_>) {
        let line = match event {
            Event::Started { step, steps, may_end_early, memory } => {
                let mut started = json!({
                    "event": "started", "step": step, "steps": steps, "may_end_early": may_end_early,
                    "memory": memory,
                });
                let facts = self.facts.as_object().into_iter().flatten();
                facts.for_each(|(name, value)| started[name] = value.clone());
                started
            }
            Event::Step(report) if self.is_due() || report.step == self.steps => {
                let StepReport { step, view, loss, gaussians, .. } = report;
                let (each, left) = self.batching(*step);
                json!({
                    "event": "step", "step": step, "steps": self.steps, "view": view, "loss": loss,
                    "gaussians": gaussians, "ms_per_step": each, "seconds_left": left,
                })
            }
            Event::Checkpointed { step } => json!({ "event": "checkpointed", "step": step }),
            Event::HeldOut { step, psnr } => {
                json!({ "event": "held_out", "step": step, "psnr": psnr })
            }
            Event::LastStep { step, last } => {
                json!({ "event": "last_step", "step": step, "last": last })
            }
            Event::Ended(ended) => json!({ "event": "ended", "ended": ended }),
            Event::Evaluated { step, evaluation } => {
                json!({ "event": "evaluated", "step": step, "mean": means(evaluation) })
            }
            Event::Finished(trained) => {
                let mut finished = json!({
                    "event": "finished",
                    "step": trained.trainer.steps_done(),
                    "gaussians": trained.trainer.gaussian_count(),
                    "seconds": trained.spent.seconds,
                    "mean": means(&trained.evaluation),
                });
                let phases: Map<String, Value> = phases::seconds()
                    .into_iter()
                    .map(|(name, seconds)| (name.to_owned(), seconds.into()))
                    .collect();
                if !phases.is_empty() {
                    finished["phases"] = phases.into();
                }
                finished
            }
            _ => return,
        };
        tell(line);
    }

    fn is_due(&mut self) -> bool {
        let is_due = self.last_line.elapsed() >= SILENCE;
        if is_due {
            self.last_line = Instant::now();
        }
        is_due
    }

    /// What the bar says of a step.
    fn state(&self, StepReport { step, loss, gaussians, .. }: &StepReport) -> String {
        let held_out = self.held_out.map(|psnr| format!("  held-out {psnr:.2} dB"));
        let rate = 1e3 / self.batching(*step).0;
        let rate = if rate < 10.0 { format!("{rate:.1}") } else { format!("{rate:.0}") };
        format!(
            "loss {loss:.4}{}  {gaussians} Gaussians  {rate} steps/s",
            held_out.unwrap_or_default()
        )
    }

    fn line(&self, StepReport { step, loss, gaussians, .. }: &StepReport) -> String {
        let (each, left) = self.batching(*step);
        let (steps, left) = (self.steps, duration(left));
        let most = at_most(self.may_end_early);
        format!(
            "step {step} of {most}{steps}: loss {loss:.4}, {gaussians} Gaussians, {each:.0} ms a step, \
             {most}{left} left"
        )
    }

    /// Mean milliseconds per step so far, and the seconds left at that speed.
    fn batching(&self, step: u64) -> (f64, f64) {
        let (begin, before) = self.begin;
        let each = begin.elapsed().as_secs_f64() / (step - before).max(1) as f64;
        (1e3 * each, each * self.steps.saturating_sub(step) as f64)
    }
}

/// The mean scores in a line; `None` if nothing was scored.
fn summary(evaluation: &Evaluation) -> Option<String> {
    let mean = |metric, after| evaluation.mean(metric, after);
    let psnr = mean(Metric::Psnr, After::Model)?;
    let channel_mean = mean(Metric::PsnrChannelMean, After::Model)?;
    let ssim = mean(Metric::Ssim, After::Model)?;
    let r0 = mean(Metric::Psnr, After::Gaussians).zip(mean(Metric::Ssim, After::Gaussians));
    let r0 = r0.map(|(psnr, ssim)| format!("; before the denoiser {psnr:.2} dB, {ssim:.3}"));
    let against = Some(evaluation.against()).filter(|kind| *kind != ReferenceKind::References);
    let against = against.map(|kind| format!(" against their {}", kind.name()));
    Some(format!(
        "{} test views{}: PSNR {psnr:.2} dB (channel mean {channel_mean:.2}), SSIM {ssim:.3}{}",
        evaluation.views().len(),
        against.unwrap_or_default(),
        r0.unwrap_or_default()
    ))
}

/// The means as JSON; null if nothing was scored.
fn means(evaluation: &Evaluation) -> Value {
    let mean = |metric| evaluation.mean(metric, After::Model);
    mean(Metric::Psnr).map_or(Value::Null, |psnr| {
        json!({
            "psnr": psnr,
            "psnr_channel_mean": mean(Metric::PsnrChannelMean),
            "ssim": mean(Metric::Ssim),
            "views": evaluation.views().len(),
            "against": evaluation.against().name(),
        })
    })
}

/// The bar: step, loss, score of the held-out views, Gaussians, steps per second and time left.
fn style(may_end_early: bool) -> ProgressStyle {
    let most = at_most(may_end_early);
    let template = format!("{{prefix}}{{bar:24}} {{pos}}/{{len}}  {{msg}}  {most}{{eta}} left");
    ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Prefix of a step count or time while early stopping is possible.
fn at_most(may_end_early: bool) -> &'static str {
    if may_end_early { "at most " } else { "" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_how_far_a_run_is_and_how_long_it_will_take() {
        let mut progress = Reporter::new(ProgressForm::Plain, "");
        (progress.steps, progress.begin) = (400, (Instant::now() - Duration::from_secs(50), 100));
        let report = StepReport {
            step: 200,
            view: "a".to_owned(),
            loss: 0.04321,
            terms: vec![],
            gaussians: 2400,
            milliseconds: 480.0,
        };
        let expected =
            "step 200 of 400: loss 0.0432, 2400 Gaussians, 500 ms a step, 1 min 40 s left";
        assert_eq!(progress.line(&report), expected);
        progress.may_end_early = true;
        let expected = "step 200 of at most 400: loss 0.0432, 2400 Gaussians, 500 ms a step, at most 1 min 40 s left";
        assert_eq!(progress.line(&report), expected);
        assert_eq!(progress.state(&report), "loss 0.0432  2400 Gaussians  2.0 steps/s");
        progress.observe(Event::HeldOut { step: 180, psnr: 31.456 });
        (progress.begin.0, progress.form) =
            (Instant::now() - Duration::from_secs(1), ProgressForm::Bar);
        let expected = "loss 0.0432  held-out 31.46 dB  2400 Gaussians  100 steps/s";
        assert_eq!(progress.state(&report), expected);
        assert!(!progress.is_due());
        progress.last_line -= SILENCE;
        assert!(progress.is_due() && !progress.is_due());
    }
}
