//! The pseudo-GT on the GPU: the statistics of a dark photograph, and the tone curve they give it.
//!
//! ```text
//! luminance -> select -> histogram -> select -> histogram -> select -> tone_statistics -> host -> curve, in the loss or tone_map
//! ```
//!
//! Percentiles are exact: luminance is not negative, so its bits sort as integers, and a radix select finds both
//! neighbours of both ranks in three digits of 11, 10 and 10 bits; the same photograph gives the same bits every time. What
//! curve the statistics give is said once, on the host ([`ToneSettings::parameters`]). The same counting, over fixed bins,
//! makes the [`LuminanceHistogram`] from which the exposure follows. A photograph beyond the device's limits comes in tiles,
//! whose counts and sums add up.

mod photographs;

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

/// Takes the statistics of photographs and applies a tone curve, with scratch memory for the largest so far.
#[derive(Debug)]
pub struct PseudoGt {
    gpu: Gpu,
    settings: ToneSettings,
    luminance: Pipeline<kernels::luminance::Kernel>,
    histogram: Pipeline<kernels::luminance_histogram::Kernel>,
    select: Pipeline<kernels::percentile_select::Kernel>,
    statistics: Pipeline<kernels::tone_statistics::Kernel>,
    map: Map,
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

/// What applies the curve to a whole image.
#[derive(Debug)]
enum Map {
    Formula {
        pipeline: Pipeline<kernels::tone_map::Kernel>,
        quads_per_thread: u32,
    },
    Mix(Pipeline<kernels::tone_mix::Kernel>),
    /// (3, K) knots.
    Table(Pipeline<kernels::tone_table::Kernel>, Buffer<Vec3>),
    /// (3, `PROFILE_WIDTH`) numbers.
    Profile(Pipeline<kernels::tone_profile::Kernel>, Buffer<f32>),
}

impl Map {
    fn new(gpu: &Gpu, settings: &ToneSettings) -> Result<Self> {
        let tone_curve = settings.curve.constant();
        if let Some(profile) = &settings.profile {
            return Ok(Self::Profile(
                gpu.pipeline(&kernels::tone_profile::Constants::default())?,
                gpu.buffer("camera profile", &profile.rows())?,
            ));
        }
        Ok(match &settings.table {
            Some(table) => Self::Table(
                gpu.pipeline(&kernels::tone_table::Constants::default())?,
                gpu.buffer("tone table", &table.knots())?,
            ),
            None if !settings.curve.is_formula() => {
                Self::Mix(gpu.pipeline(&kernels::tone_mix::Constants { tone_curve })?)
            }
            None => {
                let constants = kernels::tone_map::Constants { tone_curve, ..Default::default() };
                let quads_per_thread = constants.quads_per_thread;
                Self::Formula { pipeline: gpu.pipeline(&constants)?, quads_per_thread }
            }
        })
    }
}

impl PseudoGt {
    /// Builds the kernels for one curve.
    ///
    /// # Errors
    /// The settings leave the curve undefined ([`ToneSettings::check`]), or the device is out of memory.
    pub fn new(gpu: &Gpu, settings: &ToneSettings) -> Result<Self> {
        settings.check()?;
        let takes_p80 = settings.white() == White::P80;
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
            map: Map::new(gpu, settings)?,
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
        in_range(parameters, view)?;
        if target.len() != image.len() {
            let (name, len) = (target.name(), target.len());
            return Err(Error::Usage(format!(
                "buffer `{name}` holds {len} values, not {}",
                image.len()
            )));
        }
        let value_count = image.len() as u32;
        let pixel_count = value_count / 3;
        match &self.map {
            Map::Formula { pipeline, quads_per_thread } => pass.dispatch(
                pipeline,
                &kernels::tone_map::Params { value_count, view },
                kernels::tone_map::Buffers {
                    image: image.slice(),
                    parameters: parameters.slice(),
                    target: target.slice_mut(),
                },
                Threads::Exactly([value_count.div_ceil(4 * quads_per_thread), 1, 1]),
            ),
            Map::Mix(pipeline) => pass.dispatch(
                pipeline,
                &kernels::tone_mix::Params { pixel_count, view },
                kernels::tone_mix::Buffers {
                    image: image.slice(),
                    parameters: parameters.slice(),
                    target: target.slice_mut(),
                },
                Threads::Exactly([pixel_count, 1, 1]),
            ),
            Map::Profile(pipeline, profile) => pass.dispatch(
                pipeline,
                &kernels::tone_profile::Params { pixel_count, view },
                kernels::tone_profile::Buffers {
                    image: image.slice(),
                    parameters: parameters.slice(),
                    profile: profile.slice(),
                    target: target.slice_mut(),
                },
                Threads::Exactly([pixel_count, 1, 1]),
            ),
            Map::Table(pipeline, knots) => pass.dispatch(
                pipeline,
                &kernels::tone_table::Params {
                    pixel_count,
                    view,
                    knot_count: (knots.len() / 3) as u32,
                },
                kernels::tone_table::Buffers {
                    image: image.slice(),
                    parameters: parameters.slice(),
                    knots: knots.slice(),
                    target: target.slice_mut(),
                },
                Threads::Exactly([value_count, 1, 1]),
            ),
        }
    }

    /// The statistics measured last; waits for them.
    ///
    /// # Errors
    /// The device was lost.
    pub fn measured(&self) -> Result<Statistics> {
        let read = self.gpu.read(&self.measured)?;
        Ok(Statistics::from(read[0]))
    }

    /// The luminance of the photograph measured last; waits for it.
    ///
    /// # Errors
    /// The device was lost.
    pub fn luminance_histogram(&self) -> Result<LuminanceHistogram> {
        let counts = self.gpu.read(&self.counts)?;
        Ok(LuminanceHistogram::from_counts(&counts, self.pixel_count.into()))
    }
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
