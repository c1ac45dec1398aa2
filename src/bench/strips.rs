//! Times SSIM with views in more and in fewer strips, for a GPU to choose from.

use std::num::NonZeroU32;

use glam::UVec2;
use nightsplat_core::random::Stream;
use nightsplat_core::table::aligned;
use serde_json::{Value, json};

use super::{Bench, fastest, median, total};
use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::kernels::status::STATUS_WORDS;
use crate::loss::{Gradient, LogSlot, Loss, LossInputs, LossLog, LossRegion, Term};

/// Numbers of strips; views limit the rows of a strip, so that small ones have fewer.
const STRIPS: [u32; 5] = [384, 768, 1536, 3072, 6144];

/// Milliseconds of SSIM and its gradient in a view, for each of [`STRIPS`].
pub(super) struct StripTimings {
    size: [u32; 2],
    milliseconds: [f64; STRIPS.len()],
}

impl StripTimings {
    pub(super) fn measure(bench: &Bench, size: [u32; 2]) -> Result<Self> {
        let mut step = LossStep::new(&bench.gpu, size.into())?;
        let mut times = STRIPS.map(|_| vec![]);
        // Interleaved, so that other load affects all alike; the first round is a warm-up.
        for round in 0..=bench.repeats {
            for (strips, times) in STRIPS.into_iter().filter_map(NonZeroU32::new).zip(&mut times) {
                step.loss.set_ssim_strips(strips);
                let milliseconds = step.profile(&bench.gpu)?;
                times.extend((round > 0).then_some(milliseconds));
            }
        }
        let milliseconds = times.map(median);
        Ok(Self { size, milliseconds })
    }

    pub(super) fn as_json(&self) -> Value {
        let of = |(strips, milliseconds)| json!({ "strips": strips, "milliseconds": milliseconds });
        let timed = STRIPS.into_iter().zip(self.milliseconds).map(of);
        let [width, height] = self.size;
        json!({ "width": width, "height": height, "timed": timed.collect::<Vec<_>>() })
    }

    pub(super) fn as_text(&self) -> String {
        let [width, height] = self.size;
        let row = |(strips, milliseconds)| vec![format!("{strips}"), format!("{milliseconds:.3}")];
        let mut rows = vec![["strips", "SSIM, ms"].map(str::to_owned).to_vec()];
        rows.extend(STRIPS.into_iter().zip(self.milliseconds).map(row));
        format!("{width}x{height} pixels\n{}", aligned(&rows))
    }
}

/// The number that is good at every size; `None` without a size.
pub(super) fn fastest_of(timings: &[StripTimings]) -> Option<NonZeroU32> {
    let times: Vec<Vec<f64>> = timings.iter().map(|timed| timed.milliseconds.to_vec()).collect();
    fastest(&times).and_then(|at| NonZeroU32::new(STRIPS[at]))
}

/// The loss with what a step of it reads and writes.
struct LossStep {
    loss: Loss,
    size: UVec2,
    images: [Buffer<f32>; 2],
    d_render: Buffer<f32>,
    log: LossLog,
    status: Buffer<u32>,
}

impl LossStep {
    fn new(gpu: &Gpu, size: UVec2) -> Result<Self> {
        let values = 3 * u64::from(size.x) * u64::from(size.y);
        let noise = |seed| {
            let stream = Stream::new(seed, 0);
            let values: Vec<f32> = (0..values).map(|i| stream.uniform(i) as f32).collect();
            gpu.buffer("noise", &values)
        };
        let mut loss = Loss::new(gpu, 0.2, [Term::L1, Term::SSIM], Gradient::Written)?;
        loss.reserve(size)?;
        Ok(Self {
            loss,
            size,
            images: [noise(1)?, noise(2)?],
            d_render: gpu.uninit("d_render", values as usize)?,
            log: LossLog::new(gpu, 1)?,
            status: gpu.zeros("status", STATUS_WORDS as usize)?,
        })
    }

    /// Milliseconds of the loss.
    fn profile(&mut self, gpu: &Gpu) -> Result<f64> {
        let Self { loss, size, images: [render, target], d_render, log, status } = self;
        let (size, loss_region) = (*size, LossRegion::whole(*size));
        let times = gpu.profile("strips", |pass| {
            let inputs = LossInputs { size, loss_region, render, target };
            loss.record(pass, inputs, d_render, &mut LogSlot { log, slot: 0, status })
        })?;
        Ok(total(&times))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::Source;
    use crate::gpu::testing::gpu_with;
    use crate::train::TrainConfig;

    #[test]
    fn every_number_of_strips_is_timed_on_a_gpu() {
        let gpu = gpu_with(|properties| properties.is_cpu = false);
        let precision = TrainConfig::bare().precision;
        let bench = Bench { gpu, source: Source::Synthetic(1), precision, repeats: 1 };
        let timed = StripTimings::measure(&bench, [64, 200]).unwrap();
        assert!(timed.milliseconds.iter().all(|&milliseconds| milliseconds > 0.0));
        assert_eq!(timed.as_json()["timed"][4]["strips"], 6144);
        assert_eq!(timed.as_text().lines().count(), 2 + STRIPS.len());
    }

    #[test]
    fn the_number_of_strips_is_good_at_every_size() {
        let timed = |milliseconds| StripTimings { size: [4, 4], milliseconds };
        let small = || timed([1.0, 1.1, 2.0, 3.0, 4.0]);
        let large = timed([40.0, 22.0, 21.0, 20.0, 30.0]);
        assert_eq!(fastest_of(&[small()]), NonZeroU32::new(384));
        assert_eq!(fastest_of(&[small(), large]), NonZeroU32::new(768));
        assert_eq!(fastest_of(&[]), None);
    }
}
