//! What is fastest on a device: tiles of the rasteriser and strips of SSIM, measured and stored.

use std::path::PathBuf;

use serde_json::{Value, json};

use super::Bench;
use super::strips::{self, StripTimings};
use super::tiles::{self, Case};
use crate::Result;
use crate::gpu::Tuning;

/// Every tile at every size and number of channels, strips at every size, and the fastest.
pub(crate) struct TuningTimings {
    cases: Vec<Case>,
    /// Those of a GPU.
    strips: Vec<StripTimings>,
    /// The fastest of both.
    pub(crate) fastest: Tuning,
    /// The file that has them; `None` where tuning is off.
    pub(crate) file: Option<PathBuf>,
}

impl TuningTimings {
    /// Measures every case, and stores what is fastest.
    pub(crate) fn measure(bench: &Bench, sizes: &[[u32; 2]]) -> Result<Self> {
        let (cases, tiles) = tiles::measure(bench, sizes)?;
        // A processor has another kernel.
        let of_strips = sizes.iter().filter(|_| !bench.gpu.properties().is_cpu);
        let strips = of_strips.map(|&size| StripTimings::measure(bench, size));
        let strips = strips.collect::<Result<Vec<_>>>()?;
        let fastest = Tuning { tiles, ssim_strips: strips::fastest_of(&strips) };
        let file = bench.gpu.keep_tuning(&fastest)?;
        Ok(Self { cases, strips, fastest, file })
    }

    pub(crate) fn as_json(&self, bench: &Bench) -> Value {
        let properties = bench.gpu.properties();
        json!({
            "device": properties.name,
            "driver": properties.driver,
            "subgroup_size": properties.subgroup_size,
            "scene": bench.source.name(),
            "repeats": bench.repeats,
            "cases": self.cases.iter().map(Case::as_json).collect::<Vec<_>>(),
            "ssim": self.strips.iter().map(StripTimings::as_json).collect::<Vec<_>>(),
            "tiles": self.fastest.tiles,
            "ssim_strips": self.fastest.ssim_strips,
            "file": self.file,
        })
    }

    /// A table for each case, and for the strips of each size.
    pub(crate) fn tables(&self) -> impl Iterator<Item = String> {
        self.cases.iter().map(Case::as_text).chain(self.strips.iter().map(StripTimings::as_text))
    }
}
