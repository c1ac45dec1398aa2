//! The lamp of a renderer on the device, and the gradient of its numbers.

use super::{KernelView, Purpose, RenderSettings, Renderer, color_floats};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Slice, Threads, Tile};
use crate::kernels::lamp::{LAMP_NUMBERS, LAMP_WIDTH};
use crate::kernels::{lamp_backward, lamp_gradient};
use crate::splats::batches::Batches;
use crate::splats::device::GaussianSlice;
use crate::splats::lamp::Lamp;

const WIDTH: usize = LAMP_WIDTH as usize;

/// A lamp on the device.
#[derive(Debug)]
pub(crate) struct DeviceLamp {
    /// (`LAMP_NUMBERS`), of which the first `LAMP_WIDTH` are learned.
    pub(crate) numbers: Buffer<f32>,
    /// (`LAMP_WIDTH`): their gradient in the last backward pass.
    pub(crate) gradients: Buffer<f32>,
    /// The numbers that are bound while the light is even.
    even: Buffer<f32>,
    is_even: bool,
    /// Built with the first backward pass.
    backward: Option<LampBackward>,
}

/// The passes from the gradients of Gaussians to those of the lamp.
#[derive(Debug)]
struct LampBackward {
    chunk: u32,
    backward: Pipeline<lamp_backward::Kernel>,
    gradient: Pipeline<lamp_gradient::Kernel>,
    /// (chunks, `LAMP_WIDTH`)
    partials: Buffer<f32>,
}

impl DeviceLamp {
    pub(super) fn new(gpu: &Gpu, purpose: Purpose, lamp: &Lamp) -> Result<Self> {
        lamp.check()?;
        let learned = if purpose == Purpose::Train { WIDTH } else { 0 };
        Ok(Self {
            numbers: gpu.buffer("lamp", &lamp.numbers())?,
            gradients: gpu.zeros("lamp_gradients", learned)?,
            even: gpu.buffer("even_light", &lamp.even_numbers())?,
            is_even: false,
            backward: None,
        })
    }

    /// Builds the kernels of the backward pass unless they are there; whether it did.
    pub(super) fn build_backward(
        &mut self,
        gpu: &Gpu,
        settings: &RenderSettings,
        tile: Tile,
        frozen_columns: u32,
    ) -> Result<bool> {
        let is_new = self.backward.is_none();
        if is_new {
            self.backward = Some(LampBackward::new(gpu, settings, tile, frozen_columns)?);
        }
        Ok(is_new)
    }
}

/// The numbers as kernels bind them; without a lamp nothing, of some floats, which no kernel then reads.
pub(super) fn bound<'a>(
    lamp: Option<&'a DeviceLamp>,
    floats: Slice<'a, f32>,
) -> Result<Slice<'a, f32>> {
    match lamp {
        None => floats.range(0..0),
        Some(DeviceLamp { even, is_even: true, .. }) => Ok(even.slice()),
        Some(DeviceLamp { numbers, .. }) => Ok(numbers.slice()),
    }
}

impl LampBackward {
    fn new(gpu: &Gpu, settings: &RenderSettings, tile: Tile, frozen_columns: u32) -> Result<Self> {
        let [tile_width, tile_height] = tile.size;
        let constants = lamp_backward::Constants {
            alpha_max: settings.max_alpha,
            channels: settings.trained_channels() as u32,
            tile_width,
            tile_height,
            frozen_columns,
            ..lamp_backward::Constants::default()
        };
        Ok(Self {
            chunk: constants.chunk,
            backward: gpu.pipeline(&constants)?,
            gradient: gpu.pipeline(&lamp_gradient::Constants::default())?,
            partials: gpu.uninit("lamp_partials", 0)?,
        })
    }

    /// The chunks of all batches.
    fn chunks(&self, batches: Batches) -> u32 {
        batches.iter().map(|batch| batch.gaussian_count().div_ceil(self.chunk)).sum()
    }
}

impl Renderer {
    /// The lamp with its present numbers; `None`: evenly lit.
    #[doc(hidden)]
    pub fn lamp(&self) -> Result<Option<Lamp>> {
        let Some(lamp) = &self.lamp else { return Ok(None) };
        Ok(Some(Lamp::of_numbers(&self.gpu.read(&lamp.numbers)?)))
    }

    /// The gradient of the lamp's numbers in the last backward pass, (`LAMP_WIDTH`).
    #[doc(hidden)]
    pub fn lamp_gradients(&self) -> Option<&Buffer<f32>> {
        self.lamp.as_ref().map(|lamp| &lamp.gradients)
    }

    /// Replaces the numbers of the lamp on the device, (`LAMP_NUMBERS`).
    #[doc(hidden)]
    pub fn set_lamp_numbers(&mut self, numbers: &[f32]) -> Result<()> {
        let Some(lamp) = &mut self.lamp else { return Ok(()) };
        self.gpu.write(&mut lamp.numbers, numbers)
    }

    /// Shows each Gaussian in its own colour from now on, or by the lamp again.
    pub(crate) fn set_even_light(&mut self, is_even: bool) {
        self.lamp.iter_mut().for_each(|lamp| lamp.is_even = is_even);
    }

    /// The lamp, and the status words.
    pub(crate) fn lamp_and_status(&mut self) -> Option<(&mut DeviceLamp, &Buffer<u32>)> {
        Some((self.lamp.as_mut()?, &self.frame.status))
    }

    /// Records the gradient of the lamp's numbers, after those of the Gaussians.
    pub(super) fn record_lamp_backward(
        &mut self,
        pass: &mut Recorder<'_>,
        GaussianSlice { layout, parameters }: GaussianSlice<'_>,
        view: &KernelView<'_>,
        gradients: &Buffer<f32>,
    ) -> Result<()> {
        let (first, channels) = (self.context_count(), self.settings.trained_channels());
        let Self { gpu, frame, lamp, gradients: written, .. } = self;
        let Some(DeviceLamp { numbers, gradients: to, backward: Some(kernels), .. }) = lamp else {
            return Ok(());
        };
        let batches = layout.batches(gpu).without(written.frozen_columns);
        let chunk_count = kernels.chunks(batches);
        let mut first_chunk = 0;
        for batch in batches.iter() {
            let gaussian_count = batch.gaussian_count();
            let chunks = gaussian_count.div_ceil(kernels.chunk);
            pass.dispatch(
                &kernels.backward,
                &lamp_backward::Params {
                    camera_index: view.camera_index,
                    gaussian_count,
                    first_chunk,
                },
                lamp_backward::Buffers {
                    parameters: batch.rows(parameters, layout.words())?,
                    cameras: view.cameras.unwrap_or(&frame.camera).slice(),
                    lamp: numbers.slice(),
                    colors: batch.after(first).rows(&frame.colors, color_floats(channels))?,
                    gradients: batch.planes(gradients)?,
                    partials: kernels.partials.slice_mut(),
                },
                Threads::Workgroups([chunks.max(1), 1, 1]),
            )?;
            first_chunk += chunks;
        }
        pass.dispatch(
            &kernels.gradient,
            &lamp_gradient::Params { chunk_count },
            lamp_gradient::Buffers {
                partials: kernels.partials.slice(),
                gradients: to.slice_mut(),
            },
            Threads::Workgroups([LAMP_WIDTH, 1, 1]),
        )
    }

    /// Reserves the partial sums for as many Gaussians as the renderer has memory for.
    pub(super) fn reserve_lamp(&mut self) -> Result<()> {
        let Some(DeviceLamp { backward: Some(kernels), .. }) = &mut self.lamp else {
            return Ok(());
        };
        // A batch ends where a chunk may not: one more for each.
        let chunks = 2 * self.frame.splats.len().div_ceil(kernels.chunk as usize) + 1;
        kernels.partials.grow(&self.gpu, WIDTH * chunks)
    }
}

const _: () = assert!(LAMP_WIDTH < LAMP_NUMBERS);
