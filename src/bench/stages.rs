//! The checked step, and the times of its kernels, its stages and the whole.

use std::collections::BTreeMap;
use std::time::Instant;

use nightsplat_core::random::Stream;
use nightsplat_photographs::tone::{ToneCurve, ToneParameters, ToneSettings};

use super::scene::{self, Trainers};
use super::{Bench, Timing, median, total};
use crate::Result;
use crate::ceilings::Ceiling;
use crate::gpu::{Buffer, CheckReport, Gpu, PassTime};
use crate::splats::sort::{Count, RadixSort};
use crate::targets::pseudo_gt::PseudoGt;

/// A kernel over all its passes of a step.
#[derive(Clone, Copy, Debug)]
pub(super) struct KernelTime {
    pub(super) milliseconds: f64,
    /// What its passes bind.
    bytes: u64,
}

impl KernelTime {
    /// Bytes per second, if the kernel reads or writes each element that it binds once.
    pub(super) fn speed(&self) -> f64 {
        self.bytes as f64 / (self.milliseconds * 1e-3)
    }
}

/// Times of the stages.
pub(super) struct Stages {
    pub(super) groups: Vec<Timing>,
    pub(super) step: Timing,
    pub(super) intersections: u32,
}

/// A checked step of each model, and the pseudo-GT of a Full-HD photograph.
pub(super) fn check(bench: &Bench, trainers: &mut Trainers) -> Result<CheckReport> {
    let mut photograph = BenchPhotograph::new(&bench.gpu)?;
    let (done, mut report) =
        bench.gpu.checked(|| bench.gpu.run("pseudo-GT", |pass| photograph.record(pass)));
    done?;
    report.extend(Ceiling::check(&bench.gpu)?);
    report.extend(trainers.lita_begins.clone());
    for trainer in [&mut trainers.plain, &mut trainers.lita] {
        let before = trainer.steps_done();
        // A step that overflows its buffers is repeated.
        while trainer.steps_done() == before {
            let (reports, passes) = trainer.check_step();
            reports?;
            report.extend(passes);
        }
    }
    Ok(report)
}

/// Each kernel's time over all its passes: of the plain step, then of the others.
pub(super) fn time_kernels(
    bench: &Bench,
    trainers: &mut Trainers,
) -> Result<BTreeMap<&'static str, KernelTime>> {
    let mut photograph = BenchPhotograph::new(&bench.gpu)?;
    let mut kernels = BTreeMap::new();
    let Trainers { plain, lita, .. } = trainers;
    for times in [
        repeated(bench, || plain.profile_step())?,
        repeated(bench, || photograph.profile(&bench.gpu))?,
        repeated(bench, || lita.profile_step())?,
    ] {
        let names: Vec<_> = times[0].iter().map(|time| time.name).collect();
        for name in names {
            let of_run = |times: &Vec<PassTime>| of_kernels(times, &[name]);
            let passes = times[0].iter().filter(|time| time.name == name);
            let kernel_time = || KernelTime {
                milliseconds: median(times.iter().map(of_run).collect()),
                bytes: passes.map(|time| time.bytes).sum(),
            };
            kernels.entry(name).or_insert_with(kernel_time);
        }
    }
    Ok(kernels)
}

/// The passes of each timed repetition, after a warm-up.
fn repeated(
    bench: &Bench,
    mut profile: impl FnMut() -> Result<Vec<PassTime>>,
) -> Result<Vec<Vec<PassTime>>> {
    profile()?;
    (0..bench.repeats).map(|_| profile()).collect()
}

pub(super) fn of_kernels(times: &[PassTime], names: &[&str]) -> f64 {
    times.iter().filter(|time| names.contains(&time.name)).map(|time| time.milliseconds).sum()
}

/// Times every stage.
pub(super) fn time(bench: &Bench, trainers: &mut Trainers) -> Result<Stages> {
    let steps = repeated(bench, || trainers.plain.profile_step())?;
    let of_step = |names: &[&str]| median(steps.iter().map(|t| of_kernels(t, names)).collect());
    let loss_kernels = ["ssim", "ssim_forward", "ssim_backward", "loss_log"];
    let mut photograph = BenchPhotograph::new(&bench.gpu)?;
    let times = repeated(bench, || photograph.profile(&bench.gpu))?;
    let full_hd = median(times.iter().map(|times| total(times)).collect());
    let groups = vec![
        ("blend_forward", of_step(&["blend_forward"])),
        ("blend_backward", of_step(&["blend_backward"])),
        ("sort_65000_pairs", sort(bench)?),
        ("pseudo_gt_1920x1080", full_hd),
        ("loss", of_step(&loss_kernels)),
        ("target", of_step(&["pseudo_gt"])),
    ];
    let milliseconds = whole_step(bench, trainers)?;
    let intersections = trainers.intersections;
    Ok(Stages { groups, step: ("step", milliseconds), intersections })
}

/// Wall time of a step, with several steps per submission as in training.
fn whole_step(bench: &Bench, trainers: &mut Trainers) -> Result<f64> {
    const STEPS: u64 = 4;
    let plain = &mut trainers.plain;
    bench.median(|| {
        let begin = Instant::now();
        plain.advance(plain.steps_done() + STEPS)?;
        Ok(begin.elapsed().as_secs_f64() * 1e3 / STEPS as f64)
    })
}

/// Milliseconds to sort 65 000 pairs by all 32 bits of the keys.
fn sort(bench: &Bench) -> Result<f64> {
    const PAIRS: u32 = 65_000;
    let gpu = &bench.gpu;
    let stream = Stream::new(65, 3);
    let data: Vec<u32> = (0..PAIRS).map(|i| stream.bits(i.into()) as u32).collect();
    let mut sort = RadixSort::new(gpu, PAIRS)?;
    let counts = gpu.buffer("counts", &[PAIRS])?;
    let (mut keys, mut values) = (gpu.buffer("keys", &data)?, gpu.buffer("values", &data)?);
    bench.median(|| {
        gpu.write(&mut keys, &data)?;
        let times = gpu.profile("sort", |pass| {
            let count = Count { counts: &counts, index: 0 };
            sort.record(pass, count, &mut keys, &mut values, u32::BITS)
        })?;
        Ok(total(&times))
    })
}

/// A Full-HD photograph and its pseudo-GT.
struct BenchPhotograph {
    image: Buffer<f32>,
    pseudo_gt: PseudoGt,
    parameters: Buffer<ToneParameters>,
    target: Buffer<f32>,
}

impl BenchPhotograph {
    fn new(gpu: &Gpu) -> Result<Self> {
        let image = gpu.buffer("low", &scene::dark(1920, 1080).data)?;
        Ok(Self {
            pseudo_gt: PseudoGt::new(gpu, &ToneSettings::new(ToneCurve::Ap3))?,
            parameters: gpu
                .buffer("tone", &[ToneParameters { white: 1.0, ..Default::default() }])?,
            target: gpu.uninit("target", image.len())?,
            image,
        })
    }

    fn record(&mut self, pass: &mut crate::gpu::Recorder<'_>) -> Result<()> {
        let Self { image, pseudo_gt, parameters, target } = self;
        pseudo_gt.map(pass, image, parameters, 0, target)
    }

    fn profile(&mut self, gpu: &Gpu) -> Result<Vec<PassTime>> {
        gpu.profile("pseudo-GT", |pass| self.record(pass))
    }
}
