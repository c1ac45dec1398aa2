//! The pseudo-GT on the GPU: a stored photograph is decoded, and its tone curve evaluated, in one pass.
//!
//! ```text
//! stored photograph, parameters -> pseudo_gt -> target
//! ```
//!
//! The host derives the parameters from the statistics of the photograph
//! ([`SceneTone`](nightsplat_photographs::scene_tone::SceneTone)). A photograph beyond the device's limits is processed
//! in tiles.

mod encoded;
mod photographs;

use std::sync::OnceLock;

use nightsplat_core::curves;
use nightsplat_photographs::tone::{self, Tone, ToneSettings};

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{self, ToneParameters};
use crate::{Error, Result};
pub use encoded::EncodedPlanes;

// The host fills what the kernel reads.
const _: () = {
    assert!(tone::SEGMENTS == kernels::pseudo_gt::SEGMENTS);
    assert!(tone::PROFILE_WIDTH == kernels::pseudo_gt::PROFILE_WIDTH);
    assert!(curves::MAX_CONSTANTS == kernels::curves::MAX_CONSTANTS as usize);
    assert!(curves::LARGEST_T.to_bits() == kernels::curves::LARGEST_T.to_bits());
    assert!(curves::CURVE_TABLE == kernels::curves::CURVE_TABLE);
    assert!(curves::CURVE_AUTO == kernels::curves::CURVE_AUTO);
    assert!(curves::CURVE_PROFILE == kernels::curves::CURVE_PROFILE);
};

/// The supported numbers of bits per stored value.
const CODE_BITS: [u32; 3] = [8, 16, 32];

/// Decodes photographs and applies a tone curve.
#[derive(Debug)]
pub struct PseudoGt {
    gpu: Gpu,
    /// A `CURVE_*` number.
    tone_curve: u32,
    /// For values stored in 8, 16 and 32 bits, created when needed: with a curve, and for decoding alone.
    with_curve: [OnceLock<Pipeline<kernels::pseudo_gt::Kernel>>; 3],
    decoders: [OnceLock<Pipeline<kernels::pseudo_gt::Kernel>>; 3],
    /// Data of the curve in addition to its parameters: the knots of a table, or a profile.
    numbers: Buffer<f32>,
    knot_count: u32,
    no_parameters: Buffer<ToneParameters>,
    no_codes: Buffer<u32>,
}

impl PseudoGt {
    /// Builds the kernels for one curve.
    pub fn new(gpu: &Gpu, settings: &ToneSettings) -> Result<Self> {
        settings.check()?;
        let numbers = match (&settings.curve, settings.table()) {
            (Tone::Profile(profile), _) => profile.rows(),
            (_, Some(table)) => table.knots().iter().flat_map(|knot| knot.to_array()).collect(),
            (_, None) => vec![],
        };
        Ok(Self {
            gpu: gpu.clone(),
            with_curve: Default::default(),
            decoders: Default::default(),
            knot_count: (numbers.len() / 9) as u32,
            numbers: gpu.buffer("curve numbers", &numbers)?,
            no_parameters: gpu.uninit("no parameters", 0)?,
            no_codes: gpu.uninit("no codes", 0)?,
            tone_curve: settings.curve.constant(),
        })
    }

    /// Compiles the kernel of [`Self::map`] ahead of its first use.
    pub(crate) fn compile(&self) -> Result<()> {
        self.pipeline(32, true).map(drop)
    }

    pub(crate) fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Records `target = curve(image)` with `parameters[view]`; both planar `(3, pixels)`.
    pub fn map(
        &self,
        pass: &mut Recorder<'_>,
        image: &Buffer<f32>,
        parameters: &Buffer<ToneParameters>,
        view: u32,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        if target.len() != image.len() {
            let (name, len) = (target.name(), target.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {len} values, not {}",
                image.len()
            )));
        }
        let stored = EncodedSlices { code_bits: 32, codes: &self.no_codes, values: image };
        self.dispatch(pass, stored, image.len(), Some((parameters, view)), target)
    }

    /// Records the pseudo-GT of a stored photograph: decoded, and tone-mapped with `parameters[view]` if that is given.
    /// `target`, (3, pixels), may be longer. Values that are neither coded nor tone-mapped need no pass: their own
    /// buffer is returned.
    pub fn record<'a>(
        &self,
        pass: &mut Recorder<'_>,
        photograph: &'a EncodedPlanes,
        curve: Option<(&Buffer<ToneParameters>, u32)>,
        target: &'a mut Buffer<f32>,
    ) -> Result<&'a Buffer<f32>> {
        let &EncodedPlanes { code_bits, value_count, ref codes, ref values } = photograph;
        if code_bits == 32 && curve.is_none() {
            return Ok(values);
        }
        if target.len() < value_count {
            let (name, len) = (target.name(), target.len());
            let problem = format!("buffer `{name}` holds {len} values, not {value_count}");
            return Err(Error::Usage(problem));
        }
        self.dispatch(
            pass,
            EncodedSlices { code_bits, codes, values },
            value_count,
            curve,
            target,
        )?;
        Ok(target)
    }

    fn dispatch(
        &self,
        pass: &mut Recorder<'_>,
        EncodedSlices { code_bits, codes, values }: EncodedSlices<'_>,
        value_count: usize,
        curve: Option<(&Buffer<ToneParameters>, u32)>,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        let (parameters, view) = curve.unwrap_or((&self.no_parameters, 0));
        if curve.is_some() {
            in_range(parameters, view)?;
        }
        let pixel_count = (value_count / 3) as u32;
        pass.dispatch(
            self.pipeline(code_bits, curve.is_some())?,
            &kernels::pseudo_gt::Params { pixel_count, view, knot_count: self.knot_count },
            kernels::pseudo_gt::Buffers {
                codes: codes.slice(),
                values: values.slice(),
                parameters: parameters.slice(),
                numbers: self.numbers.slice(),
                target: target.slice_mut(),
            },
            Threads::Exactly([pixel_count, 1, 1]),
        )
    }

    fn pipeline(
        &self,
        code_bits: u32,
        with_curve: bool,
    ) -> Result<&Pipeline<kernels::pseudo_gt::Kernel>> {
        let index = CODE_BITS.iter().position(|&bits| bits == code_bits).unwrap_or_default();
        let pipelines = if with_curve { &self.with_curve } else { &self.decoders };
        if let Some(pipeline) = pipelines[index].get() {
            return Ok(pipeline);
        }
        let tone_curve = self.tone_curve;
        let constants = kernels::pseudo_gt::Constants { code_bits, with_curve, tone_curve };
        let pipeline = self.gpu.pipeline(&constants)?;
        Ok(pipelines[index].get_or_init(|| pipeline))
    }
}

/// The parts of a photograph that a dispatch binds.
struct EncodedSlices<'a> {
    code_bits: u32,
    codes: &'a Buffer<u32>,
    values: &'a Buffer<f32>,
}

fn in_range(parameters: &Buffer<ToneParameters>, view: u32) -> Result<()> {
    if (view as usize) < parameters.len() {
        return Ok(());
    }
    let (name, len) = (parameters.name(), parameters.len());
    Err(Error::Usage(format!("buffer `{name}` holds {len} curves, none for view {view}")))
}
