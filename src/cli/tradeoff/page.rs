//! The page of a comparison: fronts, pictures of the presets, how each run came there, tables.

use super::knobs::BASE;
use super::outcome::{self, Measure, Outcome};
use super::target::Target;
use crate::Result;
use crate::cli::batch::Run;
use crate::cli::batch::point::SEED;
use crate::cli::batch::runner::Failure;
use crate::gpu::Gpu;
use crate::photographs::dataset::Dataset;
use crate::photographs::image::Image;
use crate::results::report::{Comparison, Picture, Report, Trace, traces};
use crate::results::run::{Progress, energy_counters};

/// Points on the way this much worse than the best are left out: they would flatten all others.
const SHOWN_DECIBELS: f64 = 3.0;

/// What the page is made of.
pub(super) struct Page<'a> {
    pub(super) dataset: &'a Dataset,
    pub(super) target: Target,
    pub(super) gpu: &'a Gpu,
    pub(super) runs: &'a [Run],
    pub(super) outcomes: &'a [Outcome],
    pub(super) failures: &'a [Failure],
}

impl Page<'_> {
    /// The page as HTML.
    ///
    /// # Errors
    /// A model cannot be read, or the device is lost.
    pub(super) fn html(&self) -> Result<String> {
        let report = Report {
            title: format!("Time and quality of {}", self.dataset.root.display()),
            intro: self.intro(),
            tables: std::iter::once(outcome::table(self.outcomes))
                .chain(outcome::marginal_table(self.outcomes))
                .collect(),
            plots: self.plots(),
            comparisons: self.pictures()?.into_iter().collect(),
            ..Report::default()
        };
        Ok(report.html_plots_first())
    }

    fn intro(&self) -> Vec<String> {
        let processors = std::thread::available_parallelism().map_or(1, Into::into);
        let counters = energy_counters();
        let energy = if counters.is_empty() {
            "No counter of energy can be read here.".to_owned()
        } else {
            format!("Energy is that of {}, idling included.", counters.join(", "))
        };
        let mut intro = vec![format!(
            "Scores are means over {} test views {}. Time is that of the steps, without loading and scoring; on {}, {processors} processors. {energy}",
            self.dataset.test_views().filter(|view| view.has_reference()).count(),
            self.target.described(),
            self.gpu.properties().name,
        )];
        intro
            .push("The dotted line is the front: the most that can be had for so much.".to_owned());
        if self.outcomes.iter().any(|outcome| outcome.knob().is_some()) {
            let base = BASE.name();
            intro.push(format!(
                "A disc is a preset, a ring with its number in the table is one change of {base}."
            ));
        }
        let on_front = outcome::front_of(self.outcomes, Measure::Seconds, Measure::Psnr);
        let names: Vec<String> =
            on_front.into_iter().map(|index| self.outcomes[index].name()).collect();
        if !names.is_empty() {
            intro.push(format!("On the front of PSNR against time: {}.", names.join("; ")));
        }
        let failed = self
            .failures
            .iter()
            .map(|Failure { name, reason }| format!("{name} was skipped: {reason}"));
        intro.extend(failed);
        intro
    }

    fn plots(&self) -> Vec<String> {
        let (psnr, ssim) = (Measure::Psnr, Measure::Ssim);
        let fronts = [
            (Measure::Seconds, psnr),
            (Measure::Seconds, ssim),
            (Measure::ProcessorSeconds, psnr),
            (Measure::ProcessorSeconds, ssim),
            (Measure::Joules, psnr),
            (Measure::Joules, ssim),
            (Measure::DeviceBytes, psnr),
            (Measure::HostBytes, psnr),
        ];
        let mut plots: Vec<String> =
            fronts.into_iter().filter_map(|(cost, gain)| self.front(cost, gain)).collect();
        let presets = |outcome: &Outcome| outcome.knob().is_none();
        plots.extend(self.anytime("presets", presets));
        let mut keys: Vec<&str> = vec![];
        for (key, _) in self.outcomes.iter().filter_map(Outcome::knob) {
            if !keys.contains(&key) {
                keys.push(key);
            }
        }
        for key in keys {
            let varies = |outcome: &Outcome| outcome.knob().is_some_and(|(own, _)| own == key);
            plots.extend(self.anytime(key, |outcome| outcome.is_base() || varies(outcome)));
        }
        plots
    }

    /// Where each run ended up; none where nobody knows the cost.
    fn front(&self, cost: Measure, gain: Measure) -> Option<String> {
        let point = |outcome: &Outcome| {
            Some((cost.shown(outcome.mean(cost)?), gain.shown(outcome.mean(gain)?)))
        };
        let trace = |(index, outcome): (usize, &Outcome)| Trace {
            name: self.short_name(index),
            points: point(outcome).into_iter().collect(),
            ..self.trace(index)
        };
        let drawn: Vec<Trace> = self.outcomes.iter().enumerate().map(trace).collect();
        let front = outcome::front_of(self.outcomes, cost, gain);
        let front: Vec<(f64, f64)> =
            front.into_iter().filter_map(|index| point(&self.outcomes[index])).collect();
        (!front.is_empty()).then(|| traces(cost.name(), gain.name(), &drawn, &front))
    }

    /// How the chosen runs came to where they are; none where their test views were scored at the end alone.
    fn anytime(&self, what: &str, is_chosen: impl Fn(&Outcome) -> bool) -> Option<String> {
        let all = || self.outcomes.iter().flat_map(|outcome| &outcome.progress);
        let least = all().map(|one| one.psnr).fold(f64::NEG_INFINITY, f64::max) - SHOWN_DECIBELS;
        let chosen: Vec<usize> =
            (0..self.outcomes.len()).filter(|&index| is_chosen(&self.outcomes[index])).collect();
        let trace = |&index: &usize| {
            let outcome = &self.outcomes[index];
            let shown = outcome.progress.iter().filter(|one| one.psnr >= least);
            let name = outcome.knob().map_or_else(|| outcome.preset(), |(_, value)| value);
            Trace {
                name: name.to_owned(),
                points: shown.map(|one: &Progress| (one.seconds, one.psnr)).collect(),
                ..self.trace(index)
            }
        };
        let drawn: Vec<Trace> = chosen.iter().map(trace).collect();
        let lines = drawn.iter().filter(|trace| trace.points.len() > 1).count();
        let y_name = format!("{} on the way: {what}", Measure::Psnr.name());
        (lines > 0).then(|| traces(Measure::Seconds.name(), &y_name, &drawn, &[]))
    }

    /// What a run looks like in every drawing, without its points.
    fn trace(&self, index: usize) -> Trace {
        let outcome = &self.outcomes[index];
        let position = |of: &dyn Fn(&Outcome) -> bool| {
            self.outcomes[..index].iter().filter(|one| of(one)).count()
        };
        let color = position(&|one| one.knob().is_some() == outcome.knob().is_some());
        let title = format!("{}  {}", index + 1, outcome.name());
        Trace { title, color, is_minor: outcome.knob().is_some(), ..Trace::default() }
    }

    fn short_name(&self, index: usize) -> String {
        let outcome = &self.outcomes[index];
        if outcome.knob().is_some() { (index + 1).to_string() } else { outcome.preset().to_owned() }
    }

    /// The first scored view as it came in, as each preset shows it, and as it should be.
    fn pictures(&self) -> Result<Option<Comparison>> {
        let Some(view) = self.dataset.test_views().find(|view| view.has_reference()) else {
            return Ok(None);
        };
        let picture = |caption: &str, scores: String, image: &Image| Picture {
            caption: caption.to_owned(),
            scores,
            image: image.clone(),
        };
        let mut pictures: Vec<Picture> = vec![];
        let dark = view.loaded()?;
        pictures.extend(dark.map(|dark| picture("photograph", String::new(), &dark)));
        for outcome in self.outcomes.iter().filter(|outcome| outcome.knob().is_none()) {
            let is_its = |run: &&Run| {
                let mut point = run.point.clone();
                point.values.retain(|(key, _)| key != SEED);
                point == outcome.point && run.metrics().is_some()
            };
            let Some(run) = self.runs.iter().find(is_its) else { continue };
            let metrics = run.metrics().unwrap_or_default();
            let score =
                |name: &str| metrics["views"][&view.name][name].as_f64().unwrap_or(f64::NAN);
            let seconds = metrics["seconds"].as_f64().unwrap_or(f64::NAN);
            let text =
                format!("{:.2} dB, SSIM {:.3}, {seconds:.0} s", score("psnr"), score("ssim"));
            pictures.push(picture(outcome.preset(), text, &run.render(self.gpu, view)?));
        }
        let target = view.loaded_reference()?;
        pictures.extend(target.map(|image| picture(self.target.name(), String::new(), &image)));
        Ok(Some(Comparison { title: format!("Test view {}", view.name), pictures }))
    }
}
