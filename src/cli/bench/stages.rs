//! The stages of a training step as training runs them, and the step as a whole.

use std::time::Instant;

use glam::UVec2;

use super::scene::{self, Scene};
use super::{Bench, Timing, total};
use crate::Result;
use crate::gpu::{Buffer, Gpu, PassTime, Recorder};
use crate::loss::{Interior, LogSlot, Loss, LossInputs, LossLog, LossSettings, Term};
use crate::optimizer::{Adam, AdamBuffers, LearningRates, Moments};
use crate::pseudo_gt::PseudoGt;
use crate::random::Stream;
use crate::render::{Damping, Gradients, RenderOptions, RenderSettings, Renderer, Status};
use crate::scene::width;
use crate::sort::{Count, RadixSort};
use crate::tone::{ToneCurve, ToneParameters, ToneSettings};

/// What the stages took.
pub(super) struct Stages {
    pub(super) groups: Vec<Timing>,
    pub(super) step: Timing,
    pub(super) intersections: u32,
}

/// Times every stage.
///
/// # Errors
/// The device is out of memory or lost.
pub(super) fn time(bench: &Bench, scene: &Scene) -> Result<Stages> {
    let gpu = &bench.gpu;
    let mut step = Step::new(gpu, scene, ToneCurve::Ap3)?;
    let of_kernels = |times: &[PassTime], names: &[&str]| -> f64 {
        let named = times.iter().filter(|time| names.contains(&time.name));
        named.map(|time| time.milliseconds).sum()
    };
    let mut of_step = |names: &[&str]| {
        bench.median(|| Ok(of_kernels(&gpu.profile("step", |pass| step.record(pass))?, names)))
    };
    let loss_kernels = ["ssim_forward", "ssim_backward", "loss_log"];
    let blend_forward = of_step(&["blend_forward"])?;
    let backward = of_step(&["blend_backward", "reduce_records"])?;
    let loss = of_step(&loss_kernels)?;
    let mut without_curve = Step::new(gpu, scene, ToneCurve::None)?;
    let loss_without_curve = bench.median(|| {
        let times = gpu.profile("step", |pass| without_curve.record(pass))?;
        Ok(of_kernels(&times, &loss_kernels))
    })?;
    let (tone_statistics, whole_pseudo_gt) = pseudo_gt(bench)?;
    let group = |name, milliseconds, bound| Timing { name, milliseconds, bound };
    let groups = vec![
        group("blend_forward", blend_forward, Some(60.0)),
        group("backward_with_reduction", backward, Some(130.0)),
        group("sort_65000_pairs", sort(bench)?, Some(10.0)),
        group("tone_statistics_1920x1080", tone_statistics, Some(60.0)),
        group("pseudo_gt_1920x1080", whole_pseudo_gt, Some(80.0)),
        group("loss", loss, None),
        group("loss_without_curve", loss_without_curve, None),
    ];
    let milliseconds = whole_step(bench, &mut step)?;
    let intersections = Status::from_words(&gpu.read(step.renderer.status())?).intersections;
    Ok(Stages { groups, step: group("step", milliseconds, Some(260.0)), intersections })
}

/// Wall time of a step, several to a submission as training has them.
fn whole_step(bench: &Bench, step: &mut Step<'_>) -> Result<f64> {
    const STEPS: u32 = 4;
    bench.median(|| {
        let begin = Instant::now();
        bench.gpu.run("steps", |pass| (0..STEPS).try_for_each(|_| step.record(pass)))?;
        Ok(begin.elapsed().as_secs_f64() * 1e3 / f64::from(STEPS))
    })
}

/// All 32 bits of the keys.
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

/// A Full-HD photograph: its statistics alone, and with the curve over every value.
fn pseudo_gt(bench: &Bench) -> Result<(f64, f64)> {
    let gpu = &bench.gpu;
    let image = gpu.buffer("low", &scene::dark(1920, 1080).data)?;
    let mut pseudo_gt = PseudoGt::new(gpu, &ToneSettings::default())?;
    let parameters = gpu.buffer("tone", &[ToneParameters { white: 1.0, ..Default::default() }])?;
    let mut target = gpu.uninit("target", image.len())?;
    let mut of_kernels = |counts: fn(&PassTime) -> bool| {
        bench.median(|| {
            let mut times = gpu.profile("pseudo-GT", |pass| {
                pseudo_gt.statistics(pass, &image, [1920, 1080])?;
                pseudo_gt.map(pass, &image, &parameters, 0, &mut target)
            })?;
            times.retain(counts);
            Ok(total(&times))
        })
    };
    Ok((of_kernels(|time| time.name != "tone_map")?, of_kernels(|_| true)?))
}

/// What a training step works on; its learning rates are zero, so that every run does the same work.
struct Step<'s> {
    scene: &'s Scene,
    renderer: Renderer,
    loss: Loss,
    adam: Adam,
    parameters: Buffer<f32>,
    gradients: Buffer<f32>,
    grad_norm_sums: Buffer<f32>,
    visit_counts: Buffer<u32>,
    moments: Moments,
    low: Buffer<f32>,
    tone: Buffer<ToneParameters>,
    d_render: Buffer<f32>,
    log: LossLog,
}

const OPTIONS: RenderOptions = RenderOptions { sh_degree: 3, background: [0.0; 3] };

impl<'s> Step<'s> {
    fn new(gpu: &Gpu, scene: &'s Scene, curve: ToneCurve) -> Result<Self> {
        let Scene { camera, gaussians, low } = scene;
        let len = gaussians.parameters.len();
        let mut renderer = Renderer::new(gpu, RenderSettings::default())?;
        let parameters = gpu.buffer("parameters", &gaussians.parameters)?;
        renderer.reserve(gaussians.count, [camera])?;
        // Grows the memory as the scene demands.
        renderer.render_image(&parameters, camera, &OPTIONS)?;
        let mut pseudo_gt = PseudoGt::new(gpu, &ToneSettings::new(curve))?;
        let image = gpu.buffer("low", &low.data)?;
        let size = [low.width, low.height];
        gpu.run("statistics", |pass| pseudo_gt.statistics(pass, &image, size))?;
        let parameters_of = pseudo_gt.settings().parameters(&pseudo_gt.measured()?);
        let tone = gpu.buffer("tone", &[parameters_of])?;
        let terms = [Term::L1, Term::SSIM];
        let settings = LossSettings { tone_curve: curve.constant(), ssim_weight: 0.2, terms };
        let mut loss = Loss::new(gpu, settings)?;
        loss.reserve(UVec2::from_array(size))?;
        Ok(Self {
            scene,
            renderer,
            loss,
            adam: Adam::new(gpu)?,
            parameters,
            gradients: gpu.zeros("gradients", len)?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", gaussians.count)?,
            visit_counts: gpu.zeros("visit_counts", gaussians.count)?,
            moments: Moments::zeros(gpu, len)?,
            low: image,
            tone,
            d_render: gpu.zeros("d_render", low.data.len())?,
            log: LossLog::new(gpu, 1)?,
        })
    }

    fn record(&mut self, pass: &mut Recorder<'_>) -> Result<()> {
        let Scene { camera, gaussians, .. } = self.scene;
        self.renderer.forward(pass, &self.parameters, camera, &OPTIONS)?;
        let (render, status) = self.renderer.render_and_status();
        let size = UVec2::new(camera.width, camera.height);
        self.loss.record(
            pass,
            LossInputs {
                size,
                interior: Interior::whole(size),
                render,
                low: &self.low,
                tone: &self.tone,
            },
            &mut self.d_render,
            &mut LogSlot { log: &mut self.log, slot: 0, status },
        )?;
        self.renderer.backward(
            pass,
            &self.parameters,
            camera,
            &OPTIONS,
            Damping { weight: 0.0, depth: 1.0 },
            &self.d_render,
            Gradients {
                parameters: &mut self.gradients,
                grad_norm_sums: &mut self.grad_norm_sums,
                visit_counts: &mut self.visit_counts,
            },
        )?;
        let still = LearningRates::uniform(0.0);
        self.adam.record(
            pass,
            1,
            &still,
            [gaussians.count as u32, width(gaussians.shape) as u32, 0],
            AdamBuffers {
                parameters: &mut self.parameters,
                gradients: &self.gradients,
                moments: &mut self.moments,
            },
            self.renderer.status(),
        )
    }
}
