//! Learned exposure and colour per view, for photographs of one scene with different exposures.
//!
//! A target is compared with e = gain c + bias, an affine of the encoded colours c of the render, for each channel of
//! each view, clipped at the target where the photograph is clipped. The brightness of the model is fixed: after every
//! step the geometric mean of the gains over the training views is 1 and the mean of the biases 0, exactly
//! ([`Exposures::center`]), so that a view of mean exposure in stops shows the model itself.

use glam::{UVec2, Vec2};
use nightsplat_core::settings;
use nightsplat_core::settings::Rule;
use nightsplat_models::gaussians::COLOR_CHANNELS;
use nightsplat_photographs::exposures::Affine;

use super::{no_scratch, pixel_count};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::exposure::{BIAS_SCALE, EXPOSURE_WIDTH};
use crate::kernels::{expose, expose_backward, exposure_center, exposure_gradient};
use crate::splats::optimizer::{AdamBuffers, Learnable, Moments};
use crate::{Error, Result};

settings! {
"exposure.rates."
/// Adam's learning rate of gains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExposureRates {
    /// Adam's rate of the gains at the start.
    initial: f64 = 0.01 => Rule::POSITIVE;
    /// Adam's rate of the gains from the end of its exponential decay on.
    last: f64 = 0.001 => Rule::POSITIVE;
    /// The steps of the decay.
    steps: u64 = 600 => Rule::COUNT, in "steps";
}
}

impl ExposureRates {
    /// The rate of a step, counted from 1.
    pub(crate) fn at(&self, step: u64) -> f64 {
        let done = (step as f64 / self.steps.max(1) as f64).min(1.0);
        self.initial * (self.last / self.initial).powf(done)
    }
}

/// The exposures of all training views on the device, with the kernels that apply and learn them.
#[derive(Debug)]
pub struct Exposures {
    gpu: Gpu,
    rates: ExposureRates,
    view_count: u32,
    chunk: u32,
    expose: Pipeline<expose::Kernel>,
    neutralize: Pipeline<expose::Kernel>,
    backward: Pipeline<expose_backward::Kernel>,
    gradient: Pipeline<exposure_gradient::Kernel>,
    center: Pipeline<exposure_center::Kernel>,
    /// (views, `EXPOSURE_WIDTH`), in the layout of include/exposure.glsl.
    parameters: Buffer<f32>,
    /// (views, 3): the target of white.
    whites: Buffer<f32>,
    gradients: Buffer<f32>,
    moments: Moments,
    /// (3, H, W) of the largest view.
    exposed: Buffer<f32>,
    /// (3, chunks) of the largest view.
    partials: Buffer<Vec2>,
}

impl Exposures {
    /// Exposures with these initial values, centred, of views in whose targets white has these values;
    /// [`Exposures::reserve`] allocates for views.
    pub fn new(
        gpu: &Gpu,
        rates: ExposureRates,
        start: &[Affine],
        whites: &[[f32; 3]],
    ) -> Result<Self> {
        let mut parameters = vec![];
        for affine in Affine::about_their_mean(start) {
            parameters.extend(parameters_of(&affine)?);
        }
        if parameters.is_empty() || whites.len() < start.len() {
            return Err(Error::Usage(
                "there is no view whose exposure could be learned".to_owned(),
            ));
        }
        let constants = expose_backward::Constants::default();
        let mut exposures = Self {
            gpu: gpu.clone(),
            rates,
            view_count: start.len() as u32,
            chunk: constants.chunk,
            expose: gpu.pipeline(&expose::Constants { inverse: false })?,
            neutralize: gpu.pipeline(&expose::Constants { inverse: true })?,
            backward: gpu.pipeline(&constants)?,
            gradient: gpu.pipeline(&exposure_gradient::Constants::default())?,
            center: gpu.pipeline(&exposure_center::Constants::default())?,
            gradients: gpu.zeros("exposure_gradients", parameters.len())?,
            moments: Moments::zeros(gpu, parameters.len())?,
            parameters: gpu.buffer("exposures", &parameters)?,
            whites: gpu.buffer("whites", whites.as_flattened())?,
            exposed: gpu.uninit("exposed", 0)?,
            partials: gpu.uninit("exposure_partials", 0)?,
        };
        let no_step_failed = gpu.zeros("status", 1)?;
        gpu.run("center", |pass| exposures.center(pass, &no_step_failed))?;
        Ok(exposures)
    }

    /// Allocates for views up to `size`; it never shrinks.
    pub fn reserve(&mut self, size: UVec2) -> Result<()> {
        self.exposed.grow(&self.gpu, COLOR_CHANNELS * pixel_count(size) as usize)?;
        let partials = COLOR_CHANNELS * self.chunks(size) as usize;
        self.partials.grow(&self.gpu, partials)
    }

    /// Records `view`'s exposure of a render, (3 or more, H, W), to [`Exposures::exposed`]; at most the target, (3, H,
    /// W), where that is clipped.
    pub fn expose(
        &mut self,
        pass: &mut Recorder<'_>,
        view: usize,
        size: UVec2,
        [render, target]: [&Buffer<f32>; 2],
    ) -> Result<()> {
        self.check(view, size, target)?;
        self.dispatch(pass, false, view, size, [render, target])
    }

    /// Records the target of `view`, (3, H, W), with its exposure removed, to [`Exposures::exposed`].
    pub fn neutralize(
        &mut self,
        pass: &mut Recorder<'_>,
        view: usize,
        size: UVec2,
        target: &Buffer<f32>,
    ) -> Result<()> {
        self.dispatch(pass, true, view, size, [target, target])
    }

    fn dispatch(
        &mut self,
        pass: &mut Recorder<'_>,
        inverse: bool,
        view: usize,
        size: UVec2,
        [render, target]: [&Buffer<f32>; 2],
    ) -> Result<()> {
        self.check(view, size, render)?;
        pass.dispatch(
            if inverse { &self.neutralize } else { &self.expose },
            &expose::Params { pixel_count: pixel_count(size), view: view as u32 },
            expose::Buffers {
                exposures: self.parameters.slice(),
                whites: self.whites.slice(),
                render: render.slice(),
                target: target.slice(),
                exposed: self.exposed.slice_mut(),
            },
            Threads::Exactly([COLOR_CHANNELS as u32 * pixel_count(size), 1, 1]),
        )
    }

    /// The last exposed render or neutralised target, (3, H, W).
    pub fn exposed(&self) -> &Buffer<f32> {
        &self.exposed
    }

    /// Records the gradient of the exposures after [`Exposures::expose`] of the same render and target, and replaces
    /// dL/d exposed in the colours of `d_render` by dL/d render.
    pub fn backward(
        &mut self,
        pass: &mut Recorder<'_>,
        view: usize,
        size: UVec2,
        [render, target]: [&Buffer<f32>; 2],
        d_render: &mut Buffer<f32>,
    ) -> Result<()> {
        for planes in [render, target, &*d_render] {
            self.check(view, size, planes)?;
        }
        let (view, chunk_count) = (view as u32, self.chunks(size));
        pass.dispatch(
            &self.backward,
            &expose_backward::Params { pixel_count: pixel_count(size), view },
            expose_backward::Buffers {
                exposures: self.parameters.slice(),
                whites: self.whites.slice(),
                render: render.slice(),
                target: target.slice(),
                exposed: self.exposed.slice(),
                d_render: d_render.slice_mut(),
                partials: self.partials.slice_mut(),
            },
            Threads::Workgroups([chunk_count, COLOR_CHANNELS as u32, 1]),
        )?;
        pass.dispatch(
            &self.gradient,
            &exposure_gradient::Params { chunk_count, view, view_count: self.view_count },
            exposure_gradient::Buffers {
                partials: self.partials.slice(),
                gradients: self.gradients.slice_mut(),
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// Records the centring after Adam's step: the mean over the views is the identity again.
    pub fn center(&mut self, pass: &mut Recorder<'_>, status: &Buffer<u32>) -> Result<()> {
        if status.is_empty() {
            return Err(Error::Usage("exposures need a status word".to_owned()));
        }
        pass.dispatch(
            &self.center,
            &exposure_center::Params { view_count: self.view_count },
            exposure_center::Buffers {
                exposures: self.parameters.slice_mut(),
                status: status.slice(),
            },
            Threads::Workgroups([EXPOSURE_WIDTH, 1, 1]),
        )
    }

    /// The current exposure of every view.
    pub fn affines(&self) -> Result<Vec<Affine>> {
        let parameters = self.gpu.read(&self.parameters)?;
        Ok(parameters.chunks_exact(EXPOSURE_WIDTH as usize).map(affine_of).collect())
    }

    fn chunks(&self, size: UVec2) -> u32 {
        pixel_count(size).div_ceil(self.chunk)
    }

    /// A kernel that exceeds a buffer corrupts other data, so lengths are checked before anything is recorded.
    fn check(&self, view: usize, size: UVec2, planes: &Buffer<f32>) -> Result<()> {
        let values = COLOR_CHANNELS * pixel_count(size) as usize;
        if view >= self.view_count as usize {
            let count = self.view_count;
            return Err(Error::Usage(format!("there is no exposure {view} of {count}")));
        }
        let fits = (1..=self.exposed.len()).contains(&values)
            && COLOR_CHANNELS * self.chunks(size) as usize <= self.partials.len();
        if !fits {
            return Err(no_scratch("exposure", size));
        }
        planes.check_len(values)
    }
}

impl Learnable for Exposures {
    fn name(&self) -> &'static str {
        "log_exposures"
    }

    fn learning_rate(&self, step: u64) -> f64 {
        self.rates.at(step)
    }

    fn buffers(&mut self) -> AdamBuffers<'_> {
        let Self { parameters, gradients, moments, .. } = self;
        AdamBuffers {
            parameters: parameters.slice_mut(),
            gradients: gradients.slice(),
            moments: moments.slice_mut(),
        }
    }
}

/// The learned parameters of an exposure.
fn parameters_of(affine: &Affine) -> Result<[f32; EXPOSURE_WIDTH as usize]> {
    let [gains, biases] = [affine.gain.map(f64::ln), affine.bias.map(|b| b / BIAS_SCALE)];
    let mut parameters = [0.0; EXPOSURE_WIDTH as usize];
    for (to, value) in parameters.iter_mut().zip(gains.into_iter().chain(biases)) {
        *to = value as f32;
    }
    if affine.gain.iter().all(|&gain| gain > 0.0) && parameters.iter().all(|p| p.is_finite()) {
        return Ok(parameters);
    }
    Err(Error::Usage(format!(
        "{affine} is not an exposure: gains must be above 0, and all values finite"
    )))
}

fn affine_of(parameters: &[f32]) -> Affine {
    let at = |c: usize| f64::from(parameters[c]);
    Affine { gain: [0, 1, 2].map(|c| at(c).exp()), bias: [3, 4, 5].map(|c| BIAS_SCALE * at(c)) }
}
