//! The pseudo-GT on the GPU: the statistics of a dark photograph, and the tone curve they give it.
//!
//! ```text
//! luminance -> select -> histogram -> select -> histogram -> select -> tone_statistics -> curve, in the loss or tone_map
//! ```
//!
//! Percentiles are exact: luminance is not negative, so its bits sort as integers, and a radix select finds both
//! neighbours of both ranks in three digits of 11, 10 and 10 bits. Nothing is read back; the same photograph gives the same bits every time.

use glam::Vec2;

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::{self, RankSearch, ToneParameters, ToneStatistics};
use crate::tone::{Rank, Statistics, ToneSettings};
use crate::{Error, Result};

/// Threads that share an image: enough to fill a large GPU, few enough that their partial sums add up quickly.
const THREADS: u32 = 128 * 256;

/// Both neighbours of p10 and of p90.
const SEARCHES: usize = 4;

/// The values of a ten-bit digit of the radix select.
const BINS: usize = 1024;

/// Takes the statistics of photographs and applies a tone curve, with scratch memory for the largest so far.
#[derive(Debug)]
pub struct PseudoGt {
    gpu: Gpu,
    settings: ToneSettings,
    luminance: Pipeline<kernels::luminance::Kernel>,
    histogram: Pipeline<kernels::luminance_histogram::Kernel>,
    select: Pipeline<kernels::percentile_select::Kernel>,
    statistics: Pipeline<kernels::tone_statistics::Kernel>,
    map: Pipeline<kernels::tone_map::Kernel>,
    luminances: Buffer<f32>,
    sums: Buffer<Vec2>,
    searches: Buffer<RankSearch>,
    histograms: Buffer<u32>,
    measured: Buffer<ToneStatistics>,
}

impl PseudoGt {
    /// Builds the kernels for one curve.
    ///
    /// # Errors
    /// The settings leave the curve undefined ([`ToneSettings::check`]), or the device is out of memory.
    pub fn new(gpu: &Gpu, settings: ToneSettings) -> Result<Self> {
        settings.check()?;
        let tone_curve = settings.curve.constant();
        Ok(Self {
            gpu: gpu.clone(),
            settings,
            luminance: gpu.pipeline(&kernels::luminance::Constants {})?,
            histogram: gpu.pipeline(&kernels::luminance_histogram::Constants {})?,
            select: gpu.pipeline(&kernels::percentile_select::Constants {})?,
            statistics: gpu.pipeline(&kernels::tone_statistics::Constants { tone_curve })?,
            map: gpu.pipeline(&kernels::tone_map::Constants { tone_curve })?,
            luminances: gpu.uninit("luminances", 0)?,
            sums: gpu.uninit("luminance sums", THREADS as usize)?,
            searches: gpu.uninit("rank searches", SEARCHES)?,
            histograms: gpu.zeros("luminance histograms", SEARCHES * BINS)?,
            measured: gpu.uninit("tone statistics", 1)?,
        })
    }

    /// The curve and its constants.
    pub fn settings(&self) -> &ToneSettings {
        &self.settings
    }

    /// Records the statistics of `image`, planar `(3, height, width)`, sRGB-encoded, and writes the curve they give to
    /// `parameters[view]`. Values that are NaN or negative count as 0, values above 65504 as 65504.
    ///
    /// # Errors
    /// The image has no pixels or `image` another size, `parameters` ends before `view`, or the device is out of memory.
    pub fn statistics(
        &mut self,
        pass: &mut Recorder<'_>,
        image: &Buffer<f32>,
        [width, height]: [u32; 2],
        parameters: &mut Buffer<ToneParameters>,
        view: u32,
    ) -> Result<()> {
        let pixels = u64::from(width) * u64::from(height);
        if pixels == 0 || 3 * pixels != image.len() as u64 {
            let (name, len) = (image.name(), image.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {len} values, not a {width}x{height} image"
            )));
        }
        in_range(parameters, view)?;
        if (self.luminances.len() as u64) < pixels {
            self.luminances = self.gpu.uninit("luminances", pixels as usize)?;
        }
        // The three planes fit a buffer, so a third of their count fits 32 bits.
        let pixel_count = pixels as u32;
        self.search_ranks(pass, image, pixel_count)?;
        let settings = &self.settings;
        let [p10, p90] = percentile_ranks(pixel_count);
        pass.dispatch(
            &self.statistics,
            &kernels::tone_statistics::Params {
                view,
                pixel_count,
                thread_count: THREADS,
                weights: Vec2::new(p10.weight, p90.weight),
                gain_c: settings.gain_c as f32,
                theta: settings.theta as f32,
                alpha: settings.alpha as f32,
                beta: settings.beta as f32,
                base_gain: settings.base_gain as f32,
            },
            kernels::tone_statistics::Buffers {
                searches: &self.searches,
                sums: &self.sums,
                statistics: &mut self.measured,
                parameters,
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// Luminance with its partial sums, then the neighbours of both percentiles, digit by digit.
    fn search_ranks(
        &mut self,
        pass: &mut Recorder<'_>,
        image: &Buffer<f32>,
        pixel_count: u32,
    ) -> Result<()> {
        let [p10, p90] = percentile_ranks(pixel_count);
        let ranks = [p10.lower, p10.upper, p90.lower, p90.upper].map(|rank| rank as u32);
        pass.dispatch(
            &self.luminance,
            &kernels::luminance::Params { ranks, pixel_count, thread_count: THREADS },
            kernels::luminance::Buffers {
                image,
                luminances: &mut self.luminances,
                sums: &mut self.sums,
                searches: &mut self.searches,
                histograms: &mut self.histograms,
            },
            Threads::Exactly([THREADS, 1, 1]),
        )?;
        self.select_digit(pass, 11)?;
        for shift in [10, 0] {
            pass.dispatch(
                &self.histogram,
                &kernels::luminance_histogram::Params { pixel_count, thread_count: THREADS, shift },
                kernels::luminance_histogram::Buffers {
                    luminances: &self.luminances,
                    searches: &self.searches,
                    histograms: &mut self.histograms,
                },
                Threads::Exactly([THREADS, 1, 1]),
            )?;
            self.select_digit(pass, 10)?;
        }
        Ok(())
    }

    /// Takes one digit of every search from the histograms and clears them.
    fn select_digit(&mut self, pass: &mut Recorder<'_>, digit_bits: u32) -> Result<()> {
        pass.dispatch(
            &self.select,
            &kernels::percentile_select::Params { digit_bits },
            kernels::percentile_select::Buffers {
                searches: &mut self.searches,
                histograms: &mut self.histograms,
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// Records `target = curve(image)` with `parameters[view]`; `image` and `target` may be of any shape.
    ///
    /// # Errors
    /// `target` is shorter than `image`, or `parameters` ends before `view`.
    pub fn map(
        &self,
        pass: &mut Recorder<'_>,
        image: &Buffer<f32>,
        parameters: &Buffer<ToneParameters>,
        view: u32,
        target: &mut Buffer<f32>,
    ) -> Result<()> {
        in_range(parameters, view)?;
        if target.len() < image.len() {
            let (name, len) = (target.name(), target.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {len} values, not {}",
                image.len()
            )));
        }
        let value_count = image.len() as u32;
        pass.dispatch(
            &self.map,
            &kernels::tone_map::Params { value_count, view },
            kernels::tone_map::Buffers { image, parameters, target },
            Threads::Exactly([value_count, 1, 1]),
        )
    }

    /// The statistics measured last; waits for them.
    ///
    /// # Errors
    /// The device was lost.
    pub fn measured(&self) -> Result<Statistics> {
        let read = self.gpu.read(&self.measured)?;
        Ok(Statistics::from(read[0]))
    }
}

/// Where p10 and p90 lie among the sorted luminances.
fn percentile_ranks(pixel_count: u32) -> [Rank; 2] {
    [1, 9].map(|tenths| Rank::of(tenths, pixel_count as usize))
}

fn in_range(parameters: &Buffer<ToneParameters>, view: u32) -> Result<()> {
    if (view as usize) < parameters.len() {
        return Ok(());
    }
    let (name, len) = (parameters.name(), parameters.len());
    Err(Error::Usage(format!("buffer `{name}` holds {len} curves, none for view {view}")))
}
