//! The pseudo-GT on the GPU: the statistics of a dark photograph, and the tone curve they give it.
//!
//! ```text
//! luminance -> select -> histogram -> select -> histogram -> select -> tone_statistics -> host -> parameters
//! stored photograph, parameters -> pseudo_gt -> target
//! ```
//!
//! Percentiles are exact: luminance is not negative, so its bits sort as integers, and a radix select finds both
//! neighbours of both ranks in three digits of 11, 10 and 10 bits; the same photograph gives the same bits every time. What
//! curve the statistics give is said once, on the host ([`ToneSettings::parameters`]). The same counting, over fixed bins,
//! makes the [`LuminanceHistogram`] from which the exposure follows. A photograph beyond the device's limits comes in tiles,
//! whose counts and sums add up.

mod encoded;
mod photographs;

pub use encoded::Encoded;

use std::sync::OnceLock;

use glam::Vec3;

use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::rank_search::{BINS, SEARCHES, WORKGROUP};
use crate::kernels::{self, RankSearch, ToneParameters, ToneStatistics};
use crate::photographs::tone::{
    BIN_SHIFT, FIRST_PREFIX, LuminanceHistogram, Rank, Statistics, ToneSettings, White,
};
use crate::{Error, Result};

/// Threads that share an image: enough to fill a large GPU, few enough that their partial sums add up quickly.
const THREADS: u32 = 128 * WORKGROUP;

/// The bits that a stored value may have.
const CODE_BITS: [u32; 3] = [8, 16, 32];

/// Takes the statistics of photographs and applies a tone curve, with scratch memory for the largest so far.
#[derive(Debug)]
pub struct PseudoGt {
    gpu: Gpu,
    settings: ToneSettings,
    luminance: Pipeline<kernels::luminance::Kernel>,
    histogram: Pipeline<kernels::luminance_histogram::Kernel>,
    select: Pipeline<kernels::percentile_select::Kernel>,
    statistics: Pipeline<kernels::tone_statistics::Kernel>,
    /// Of what is stored in 8, 16 and 32 bits, once there is some: with the curve, and decoding alone.
    with_curve: [OnceLock<Pipeline<kernels::pseudo_gt::Kernel>>; 3],
    decoders: [OnceLock<Pipeline<kernels::pseudo_gt::Kernel>>; 3],
    /// The curve's beside its parameters: knots of a table, or what a profile is made of.
    numbers: Buffer<f32>,
    knot_count: u32,
    no_parameters: Buffer<ToneParameters>,
    no_codes: Buffer<u32>,
    /// One for each tile.
    luminances: Vec<Buffer<f32>>,
    sums: Buffer<Vec3>,
    searches: Buffer<RankSearch>,
    histograms: Buffer<u32>,
    measured: Buffer<ToneStatistics>,
    /// Searches that together find the bin of every luminance.
    bins: Buffer<RankSearch>,
    counts: Buffer<u32>,
    /// Of the photograph measured last.
    pixel_count: u32,
}

impl PseudoGt {
    /// Builds the kernels for one curve.
    ///
    /// # Errors
    /// The settings leave the curve undefined ([`ToneSettings::check`]), or the device is out of memory.
    pub fn new(gpu: &Gpu, settings: &ToneSettings) -> Result<Self> {
        settings.check()?;
        let takes_p80 = settings.white() == White::P80;
        let numbers = match (&settings.table, &settings.profile) {
            (_, Some(profile)) => profile.rows(),
            (Some(table), None) => table.knots().iter().flat_map(|knot| knot.to_array()).collect(),
            (None, None) => vec![],
        };
        let bins = (0..SEARCHES).map(|histogram| RankSearch {
            prefix: FIRST_PREFIX + histogram,
            rank: 0,
            histogram,
        });
        Ok(Self {
            gpu: gpu.clone(),
            luminance: gpu.pipeline(&kernels::luminance::Constants {})?,
            histogram: gpu.pipeline(&kernels::luminance_histogram::Constants {})?,
            select: gpu.pipeline(&kernels::percentile_select::Constants {})?,
            statistics: gpu.pipeline(&kernels::tone_statistics::Constants { takes_p80 })?,
            with_curve: Default::default(),
            decoders: Default::default(),
            knot_count: (numbers.len() / 9) as u32,
            numbers: gpu.buffer("curve numbers", &numbers)?,
            no_parameters: gpu.uninit("no parameters", 0)?,
            no_codes: gpu.uninit("no codes", 0)?,
            luminances: vec![],
            sums: gpu.uninit("channel sums", 0)?,
            searches: gpu.uninit("rank searches", 2 * SEARCHES as usize)?,
            histograms: gpu.zeros("luminance histograms", (SEARCHES * BINS) as usize)?,
            measured: gpu.uninit("tone statistics", 1)?,
            bins: gpu.buffer("luminance bins", &bins.collect::<Vec<_>>())?,
            counts: gpu.zeros("luminance counts", (SEARCHES * BINS) as usize)?,
            pixel_count: 0,
            settings: settings.clone(),
        })
    }

    /// The curve and its constants.
    pub fn settings(&self) -> &ToneSettings {
        &self.settings
    }

    /// Records the statistics of `image`, planar `(3, height, width)`, sRGB-encoded; [`PseudoGt::measured`] reads them.
    /// Values that are NaN or negative count as 0, values above 65504 as 65504.
    ///
    /// # Errors
    /// The image has no pixels or `image` another size, or the device is out of memory.
    pub fn statistics(
        &mut self,
        pass: &mut Recorder<'_>,
        image: &Buffer<f32>,
        [width, height]: [u32; 2],
    ) -> Result<()> {
        let pixels = u64::from(width) * u64::from(height);
        if pixels == 0 || 3 * pixels != image.len() as u64 {
            let (name, len) = (image.name(), image.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {len} values, not a {width}x{height} image"
            )));
        }
        self.statistics_of_tiles(pass, &[image])
    }

    /// As [`PseudoGt::statistics`], of a photograph in parts, each planar `(3, pixels)`; in which parts does not matter
    /// but for the last bit of the means.
    ///
    /// # Errors
    /// As there; a photograph has less than 2^32 pixels.
    pub fn statistics_of_tiles(
        &mut self,
        pass: &mut Recorder<'_>,
        tiles: &[&Buffer<f32>],
    ) -> Result<()> {
        let pixels: usize = tiles.iter().map(|tile| tile.len() / 3).sum();
        let is_planar = tiles.iter().all(|tile| tile.len() % 3 == 0);
        let Some(pixel_count) = u32::try_from(pixels).ok().filter(|&count| count > 0 && is_planar)
        else {
            return Err(Error::Usage(format!("{pixels} pixels are no photograph")));
        };
        self.reserve(tiles)?;
        let [p10, p80, p90] = [1, 8, 9].map(|tenths| Rank::of(tenths, pixels));
        self.search_ranks(pass, tiles, [p10, p90], 0)?;
        if self.settings.white() == White::P80 {
            self.search_ranks(pass, tiles, [p80, p80], SEARCHES)?;
        }
        self.pixel_count = pixel_count;
        pass.fill(&mut self.counts, 0);
        let Self { histogram, luminances, bins, counts, .. } = self;
        count_luminances(pass, histogram, tiles, luminances, [BIN_SHIFT, 0], bins, counts)?;
        pass.dispatch(
            &self.statistics,
            &kernels::tone_statistics::Params {
                weights: Vec3::new(p10.weight, p90.weight, p80.weight),
                pixel_count,
                sum_count: THREADS * tiles.len() as u32,
            },
            kernels::tone_statistics::Buffers {
                searches: self.searches.slice(),
                sums: self.sums.slice(),
                statistics: self.measured.slice_mut(),
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// Scratch memory for the tiles.
    fn reserve(&mut self, tiles: &[&Buffer<f32>]) -> Result<()> {
        for (index, tile) in tiles.iter().enumerate() {
            let pixels = tile.len() / 3;
            if self.luminances.get(index).is_none_or(|luminances| luminances.len() < pixels) {
                let luminances = self.gpu.uninit("luminances", pixels)?;
                self.luminances.truncate(index);
                self.luminances.push(luminances);
            }
        }
        let sums = THREADS as usize * tiles.len();
        if self.sums.len() < sums {
            self.sums = self.gpu.uninit("channel sums", sums)?;
        }
        Ok(())
    }

    /// Luminance with partial sums of the channels, then the neighbours of both ranks, digit by digit.
    fn search_ranks(
        &mut self,
        pass: &mut Recorder<'_>,
        tiles: &[&Buffer<f32>],
        [low, high]: [Rank; 2],
        first_search: u32,
    ) -> Result<()> {
        let ranks = [low.lower, low.upper, high.lower, high.upper].map(|rank| rank as u32);
        for (index, image) in tiles.iter().enumerate() {
            pass.dispatch(
                &self.luminance,
                &kernels::luminance::Params {
                    ranks,
                    pixel_count: (image.len() / 3) as u32,
                    thread_count: THREADS,
                    first_search,
                    first_sum: THREADS * index as u32,
                },
                kernels::luminance::Buffers {
                    image: image.slice(),
                    luminances: self.luminances[index].slice_mut(),
                    sums: self.sums.slice_mut(),
                    searches: self.searches.slice_mut(),
                    histograms: self.histograms.slice_mut(),
                },
                Threads::Exactly([THREADS, 1, 1]),
            )?;
        }
        self.select_digit(pass, 11, first_search)?;
        for shift in [10, 0] {
            let Self { histogram, luminances, searches, histograms, .. } = self;
            let digit = [shift, first_search];
            count_luminances(pass, histogram, tiles, luminances, digit, searches, histograms)?;
            self.select_digit(pass, 10, first_search)?;
        }
        Ok(())
    }

    /// Takes one digit of every search from the histograms and clears them.
    fn select_digit(
        &mut self,
        pass: &mut Recorder<'_>,
        digit_bits: u32,
        first_search: u32,
    ) -> Result<()> {
        pass.dispatch(
            &self.select,
            &kernels::percentile_select::Params { digit_bits, first_search },
            kernels::percentile_select::Buffers {
                searches: self.searches.slice_mut(),
                histograms: self.histograms.slice_mut(),
            },
            Threads::Workgroups([1, 1, 1]),
        )
    }

    /// Records `target = curve(image)` with `parameters[view]`; both planar `(3, pixels)`.
    ///
    /// # Errors
    /// `target` and `image` differ in length, or `parameters` ends before `view`.
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
        let stored = Stored { code_bits: 32, codes: &self.no_codes, values: image };
        self.dispatch(pass, stored, image.len(), Some((parameters, view)), target)
    }

    /// Records the pseudo-GT of a stored photograph, decoded and under the curve of `parameters[view]`, where one is named; or
    /// what is stored, decoded. `target`, (3, pixels), is as long or longer. What is stored as it is and has no curve needs no
    /// pass: the result is the buffer that holds it.
    ///
    /// # Errors
    /// `target` is shorter, `parameters` ends before `view`, or the device refuses the kernel.
    pub fn record<'a>(
        &self,
        pass: &mut Recorder<'_>,
        photograph: &'a Encoded,
        curve: Option<(&Buffer<ToneParameters>, u32)>,
        target: &'a mut Buffer<f32>,
    ) -> Result<&'a Buffer<f32>> {
        let &Encoded { code_bits, value_count, ref codes, ref values } = photograph;
        if code_bits == 32 && curve.is_none() {
            return Ok(values);
        }
        if target.len() < value_count {
            let (name, len) = (target.name(), target.len());
            let problem = format!("buffer `{name}` holds {len} values, not {value_count}");
            return Err(Error::Usage(problem));
        }
        self.dispatch(pass, Stored { code_bits, codes, values }, value_count, curve, target)?;
        Ok(target)
    }

    fn dispatch(
        &self,
        pass: &mut Recorder<'_>,
        Stored { code_bits, codes, values }: Stored<'_>,
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
        let place = CODE_BITS.iter().position(|&bits| bits == code_bits).unwrap_or_default();
        let pipelines = if with_curve { &self.with_curve } else { &self.decoders };
        if let Some(pipeline) = pipelines[place].get() {
            return Ok(pipeline);
        }
        let tone_curve = self.settings.curve.constant();
        let constants = kernels::pseudo_gt::Constants { code_bits, with_curve, tone_curve };
        let pipeline = self.gpu.pipeline(&constants)?;
        Ok(pipelines[place].get_or_init(|| pipeline))
    }

    /// The statistics measured last; waits for them.
    ///
    /// # Errors
    /// The device was lost.
    #[cfg(feature = "testing")]
    pub fn measured(&self) -> Result<Statistics> {
        let read = self.gpu.read(&self.measured)?;
        Ok(Statistics::from(read[0]))
    }

    /// The luminance of the photograph measured last; waits for it.
    ///
    /// # Errors
    /// The device was lost.
    #[cfg(feature = "testing")]
    pub fn luminance_histogram(&self) -> Result<LuminanceHistogram> {
        let counts = self.gpu.read(&self.counts)?;
        Ok(LuminanceHistogram::from_counts(&counts, self.pixel_count.into()))
    }
}

/// What of a photograph a dispatch binds.
struct Stored<'a> {
    code_bits: u32,
    codes: &'a Buffer<u32>,
    values: &'a Buffer<f32>,
}

/// Counts a digit of the luminances of all tiles that begin with the prefix of a search.
fn count_luminances(
    pass: &mut Recorder<'_>,
    histogram: &Pipeline<kernels::luminance_histogram::Kernel>,
    tiles: &[&Buffer<f32>],
    luminances: &[Buffer<f32>],
    [shift, first_search]: [u32; 2],
    searches: &Buffer<RankSearch>,
    histograms: &mut Buffer<u32>,
) -> Result<()> {
    for (tile, luminances) in tiles.iter().zip(luminances) {
        let pixel_count = (tile.len() / 3) as u32;
        pass.dispatch(
            histogram,
            &kernels::luminance_histogram::Params {
                pixel_count,
                thread_count: THREADS,
                shift,
                first_search,
            },
            kernels::luminance_histogram::Buffers {
                luminances: luminances.slice(),
                searches: searches.slice(),
                histograms: histograms.slice_mut(),
            },
            Threads::Exactly([THREADS, 1, 1]),
        )?;
    }
    Ok(())
}

fn in_range(parameters: &Buffer<ToneParameters>, view: u32) -> Result<()> {
    if (view as usize) < parameters.len() {
        return Ok(());
    }
    let (name, len) = (parameters.name(), parameters.len());
    Err(Error::Usage(format!("buffer `{name}` holds {len} curves, none for view {view}")))
}
