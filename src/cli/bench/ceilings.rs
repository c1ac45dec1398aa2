//! What the device can do at most, to compare kernels with: bytes moved, multiplications and additions, exchanges
//! between lanes.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::{Bench, total};
use crate::Result;
use crate::gpu::{Buffer, CheckReport, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::ceiling;

const MULTIPLY_ADD: u32 = 1;
const EXCHANGE: u32 = 2;
const OPERATIONS_PER_TURN: u32 = 16;
/// Components of a vector.
const COMPONENTS: usize = 4;

/// Vectors to move, and to compute with; a processor gets fewer. 256 MiB are beyond every cache.
const MOVED: usize = 1 << 24;
const COMPUTED: usize = 1 << 20;
const OF_A_CPU: usize = 1 << 16;
const TURNS: u32 = 64;

/// The measured ceilings.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ceilings {
    /// Bytes read and written per second.
    pub(super) bytes: f64,
    /// Multiplications and additions per second, two for each fused one.
    flops: f64,
    /// 32-bit numbers exchanged between lanes per second.
    exchanges: f64,
}

/// The kernel on its buffers.
pub(super) struct Ceiling {
    operations: [Pipeline<ceiling::Kernel>; 3],
    source: Buffer<f32>,
    target: Buffer<f32>,
    vectors: [usize; 2],
}

impl Ceiling {
    /// With as many vectors as the device is fast.
    ///
    /// # Errors
    /// The device is out of memory, or refuses the kernel.
    pub(super) fn large(gpu: &Gpu) -> Result<Self> {
        let properties = gpu.properties();
        let bound = properties.max_storage_buffer_range as usize / (COMPONENTS * size_of::<f32>());
        let most = if properties.is_cpu { OF_A_CPU } else { bound };
        Self::new(gpu, [MOVED, COMPUTED].map(|vectors| vectors.min(most)))
    }

    fn new(gpu: &Gpu, vectors: [usize; 2]) -> Result<Self> {
        let pipeline = |operation| gpu.pipeline(&ceiling::Constants { operation });
        Ok(Self {
            operations: [pipeline(0)?, pipeline(MULTIPLY_ADD)?, pipeline(EXCHANGE)?],
            source: gpu.zeros("ceiling source", COMPONENTS * vectors[0])?,
            target: gpu.zeros("ceiling target", COMPONENTS * vectors[0])?,
            vectors,
        })
    }

    fn record(
        &mut self,
        pass: &mut Recorder<'_>,
        operation: u32,
        vectors: usize,
        turns: u32,
    ) -> Result<()> {
        let vector_count = vectors as u32;
        let values = 0..COMPONENTS * vectors;
        pass.dispatch(
            &self.operations[operation as usize],
            &ceiling::Params { vector_count, turns, factor: 0.5, lane_bits: 1 },
            ceiling::Buffers {
                source: self.source.slice().range(values.clone())?,
                target: self.target.slice_mut().range(values)?,
            },
            Threads::Exactly([vector_count, 1, 1]),
        )
    }

    /// Checks each operation on a few vectors.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub(super) fn check(gpu: &Gpu) -> Result<CheckReport> {
        const VECTORS: usize = 1000;
        let mut own = Self::new(gpu, [VECTORS; 2])?;
        let values: Vec<f32> = (0u16..4000).map(f32::from).collect();
        gpu.write(&mut own.source, &values)?;
        let (done, report) = gpu.checked(|| {
            gpu.run("ceilings", |pass| {
                (0..=EXCHANGE).try_for_each(|operation| own.record(pass, operation, VECTORS, 2))
            })
        });
        done.map(|()| report)
    }

    /// Computes for about this time, so that the clocks of a device that was idle have risen.
    ///
    /// # Errors
    /// The device was lost.
    pub(super) fn warm(&mut self, gpu: &Gpu, time: Duration) -> Result<()> {
        let begin = Instant::now();
        while begin.elapsed() < time {
            let vectors = self.vectors[1];
            gpu.run("warm-up", |pass| {
                (0..16).try_for_each(|_| self.record(pass, MULTIPLY_ADD, vectors, TURNS))
            })?;
        }
        Ok(())
    }

    /// # Errors
    /// The device was lost.
    pub(super) fn measure(&mut self, bench: &Bench) -> Result<Ceilings> {
        let [moved, computed] = self.vectors;
        let mut seconds = |operation, vectors, turns| {
            let once = || {
                let times = bench
                    .gpu
                    .profile("ceilings", |pass| self.record(pass, operation, vectors, turns))?;
                Ok(total(&times) * 1e-3)
            };
            bench.median(once)
        };
        let turns = if bench.gpu.properties().is_cpu { 1 } else { TURNS };
        let done = (computed * COMPONENTS) as f64 * f64::from(turns * OPERATIONS_PER_TURN);
        Ok(Ceilings {
            bytes: (2 * moved * COMPONENTS * size_of::<f32>()) as f64 / seconds(0, moved, 0)?,
            flops: 2.0 * done / seconds(MULTIPLY_ADD, computed, turns)?,
            exchanges: done / seconds(EXCHANGE, computed, turns)?,
        })
    }
}

impl Ceilings {
    pub(super) fn as_json(&self) -> Value {
        json!({
            "copy_gb_per_s": self.bytes * 1e-9,
            "multiply_add_tflops": self.flops * 1e-12,
            "exchange_g_per_s": self.exchanges * 1e-9,
        })
    }

    pub(super) fn as_text(&self) -> String {
        let [copy, flops, exchanges] =
            [self.bytes * 1e-9, self.flops * 1e-12, self.exchanges * 1e-9];
        format!(
            "ceilings: {copy:.1} GB/s read and written, {flops:.3} TFLOPS, {exchanges:.1} G exchanges of lanes/s"
        )
    }
}
