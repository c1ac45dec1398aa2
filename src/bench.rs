//! What `nightsplat bench` measures: a training step, checked against the CPU references and timed by kernels and
//! stages, and the tiles of the rasteriser.

mod ceilings;
pub mod scene;
mod stages;
mod steady;
mod strips;
mod tiles;
pub(crate) mod tuning;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use nightsplat_core::table::aligned;
use serde_json::{Map, Value, json};

use crate::Result;
use crate::ceilings::Ceiling;
use crate::gpu::{CheckReport, Gpu, PassTime};
use crate::kernels;
use crate::train::PrecisionConfig;
use ceilings::Ceilings;
use scene::BenchScene;
pub(crate) use scene::Source;
use stages::KernelTime;
use steady::Steady;

/// A stage and its milliseconds.
type Timing = (&'static str, f64);

/// What is measured, and how.
pub(crate) struct Bench {
    pub(crate) gpu: Gpu,
    pub(crate) source: Source,
    pub(crate) precision: PrecisionConfig,
    pub(crate) repeats: usize,
}

/// The results.
pub(crate) struct Findings {
    pub(crate) checked: CheckReport,
    kernels: BTreeMap<&'static str, KernelTime>,
    stages: stages::Stages,
    ceilings: Option<Ceilings>,
    steady: Option<Steady>,
}

/// What else is measured, beside kernels and stages.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BenchOptions {
    /// Whether the step is not checked.
    pub(crate) unchecked: bool,
    /// Whether the device's limits are measured.
    pub(crate) ceilings: bool,
    /// Seconds of work before, so that the clocks of an idle device rise.
    pub(crate) warm: f64,
    /// Steps to time as training submits them.
    pub(crate) steady: u64,
}

impl Findings {
    /// Checks and times.
    pub(crate) fn gather(
        bench: &Bench,
        scene: &BenchScene,
        options: &BenchOptions,
    ) -> Result<Self> {
        let mut trainers = scene::trainers(&bench.gpu, scene, &bench.precision)?;
        let checked = match options.unchecked {
            true => CheckReport::default(),
            false => stages::check(bench, &mut trainers)?,
        };
        let mut ceiling = match options.ceilings || options.warm > 0.0 {
            true => Some(Ceiling::large(&bench.gpu)?),
            false => None,
        };
        if let Some(ceiling) = &mut ceiling {
            ceiling.warm(&bench.gpu, Duration::from_secs_f64(options.warm))?;
        }
        let kernels = stages::time_kernels(bench, &mut trainers)?;
        let stages = stages::time(bench, &mut trainers)?;
        let ceilings = match ceiling.filter(|_| options.ceilings) {
            Some(mut ceiling) => Some(Ceilings::measure(bench, &mut ceiling)?),
            None => None,
        };
        let steady = match options.steady {
            0 => None,
            steps => Some(steady::time(bench, &mut trainers.plain, steps)?),
        };
        Ok(Self { checked, kernels, stages, ceilings, steady })
    }

    /// The kernels of which a pass disagrees with its reference.
    fn disagreeing(&self) -> BTreeSet<&'static str> {
        let passes = self.checked.passes.iter();
        passes.filter(|pass| pass.difference.is_some()).map(|pass| pass.kernel).collect()
    }

    /// The kernels that no checked pass ran.
    fn not_covered(&self) -> Vec<&'static str> {
        let covered = self.checked.kernels();
        let is_covered = |name: &str| covered.iter().any(|(covered, ..)| *covered == name);
        kernels::NAMES.iter().copied().filter(|name| !is_covered(name)).collect()
    }

    pub(crate) fn as_json(&self, bench: &Bench, scene: &BenchScene) -> Value {
        let entry = |(name, milliseconds): &Timing| ((*name).to_owned(), json!(milliseconds));
        let properties = bench.gpu.properties();
        let Self { stages, .. } = self;
        let errors = self.checked.kernels();
        let of_kernels = |number: fn(&KernelTime) -> f64| {
            let entry = |(name, time): (&&str, _)| ((*name).to_owned(), json!(number(time)));
            self.kernels.iter().map(entry).collect::<Map<_, _>>()
        };
        json!({
            "device": properties.name,
            "driver": properties.driver,
            "scene": bench.source.name(),
            "precision": bench.precision,
            "width": scene.camera.width,
            "height": scene.camera.height,
            "gaussians": scene.gaussians.count,
            "intersections": stages.intersections,
            "errors": errors.into_iter().map(|(name, _, error)| (name.to_owned(), json!(error))).collect::<Map<_, _>>(),
            "disagreeing": self.disagreeing(),
            "passes": self.checked.outcomes(),
            "not_covered": self.not_covered(),
            "kernels": of_kernels(|time| time.milliseconds),
            "gb_per_s_at_most": of_kernels(|time| time.speed() * 1e-9),
            "groups": stages.groups.iter().map(entry).collect::<Map<String, Value>>(),
            "step_ms": stages.step.1,
            "ceilings": self.ceilings.as_ref().map(Ceilings::as_json),
            "steady": self.steady.as_ref().map(Steady::as_json),
        })
    }

    pub(crate) fn as_text(&self, bench: &Bench, scene: &BenchScene) -> String {
        let (properties, stages) = (bench.gpu.properties(), &self.stages);
        let head = format!(
            "{}, {}\n{}: {}x{} pixels, {} Gaussians, {} intersections; medians of {} runs",
            properties.name,
            properties.driver,
            bench.source.name(),
            scene.camera.width,
            scene.camera.height,
            scene.gaussians.count,
            stages.intersections,
            bench.repeats
        );
        let header = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
        let mut rows = vec![header(&["kernel", "largest error / bound", "ms", "GB/s at most"])];
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".to_owned());
        let checked = self.checked.kernels();
        let errors: BTreeMap<_, _> =
            checked.iter().map(|&(name, _, error)| (name, error)).collect();
        let is_timed_alone = |name: &&str| !errors.contains_key(name);
        let unchecked = self.kernels.keys().copied().filter(is_timed_alone);
        let names = checked.iter().map(|&(name, ..)| name).chain(unchecked);
        rows.extend(names.map(|name| {
            let error = errors.get(name).map(|error| format!("{error:.3}"));
            let time = self.kernels.get(name);
            let milliseconds = time.map(|time| format!("{:.3}", time.milliseconds));
            let speed = time.map(|time| self.speed(time));
            vec![name.to_owned(), or_dash(error), or_dash(milliseconds), or_dash(speed)]
        }));
        let kernel_table = aligned(&rows);
        let mut rows = vec![header(&["stage", "ms"])];
        rows.extend(
            stages
                .groups
                .iter()
                .chain([&stages.step])
                .map(|(name, milliseconds)| vec![(*name).to_owned(), format!("{milliseconds:.2}")]),
        );
        let not_covered = self.not_covered().join(", ");
        let stage_table = aligned(&rows);
        let outcomes = self.checked.outcomes();
        let more = [
            self.ceilings.map(|section| section.as_text()),
            self.steady.map(|section| section.as_text()),
        ];
        let more: String = more.into_iter().flatten().map(|line| line + "\n").collect();
        format!(
            "{head}\n\n{kernel_table}{outcomes}\nnot covered: {not_covered}\n\n{stage_table}{more}"
        )
    }

    /// The bytes that a kernel's passes bind, per second, and their share of what the device can move.
    fn speed(&self, time: &KernelTime) -> String {
        let speed = format!("{:.1}", time.speed() * 1e-9);
        match self.ceilings {
            Some(peak) => format!("{speed} ({:.0} %)", 100.0 * time.speed() / peak.bytes),
            None => speed,
        }
    }
}

impl Bench {
    /// The median of the milliseconds that `once` reports, after a warm-up.
    fn median(&self, mut once: impl FnMut() -> Result<f64>) -> Result<f64> {
        once()?;
        let times = (0..self.repeats).map(|_| once()).collect::<Result<Vec<_>>>()?;
        Ok(median(times))
    }
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// The choice with the least sum over cases of its time relative to the fastest of the case; `None` without a case. A
/// case has the time of each choice, infinite for one that is not to be taken.
fn fastest(cases: &[Vec<f64>]) -> Option<usize> {
    let cost = |choice: usize| {
        let least = |times: &Vec<f64>| times.iter().copied().fold(f64::INFINITY, f64::min);
        cases.iter().map(|times| times[choice] / least(times)).sum::<f64>()
    };
    (0..cases.first()?.len()).min_by(|&a, &b| cost(a).total_cmp(&cost(b)))
}

/// Milliseconds of all passes together.
fn total(times: &[PassTime]) -> f64 {
    times.iter().map(|time| time.milliseconds).sum()
}
