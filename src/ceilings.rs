//! The peak rates of a device, with which the bench compares kernels: bytes moved, multiplications and additions,
//! exchanges between lanes.

use std::time::{Duration, Instant};

use crate::Result;
use crate::gpu::{Buffer, CheckReport, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::ceiling;

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum CeilingOperation {
    /// Reads and writes; counted in bytes.
    Copy,
    /// Multiplies and adds; each counts.
    MultiplyAdd,
    /// Exchanges 32-bit numbers between lanes.
    Exchange,
}

const OPERATIONS: [CeilingOperation; 3] =
    [CeilingOperation::Copy, CeilingOperation::MultiplyAdd, CeilingOperation::Exchange];
const OPERATIONS_PER_TURN: u32 = 16;
/// Components of a vector.
const COMPONENTS: usize = 4;

/// Vectors to move, and to compute with; a processor gets fewer. 256 MiB are beyond every cache.
const MOVED: usize = 1 << 24;
const COMPUTED: usize = 1 << 20;
const OF_A_CPU: usize = 1 << 16;
const TURNS: u32 = 64;

/// The kernel on its buffers.
#[derive(Debug)]
pub(crate) struct Ceiling {
    operations: [Pipeline<ceiling::Kernel>; 3],
    source: Buffer<f32>,
    target: Buffer<f32>,
    /// To move, and to compute with.
    vectors: [usize; 2],
    turns: u32,
}

impl Ceiling {
    /// Large enough for a measurement on this device.
    pub(crate) fn large(gpu: &Gpu) -> Result<Self> {
        let properties = gpu.properties();
        let bound = properties.max_storage_buffer_range as usize / (COMPONENTS * size_of::<f32>());
        let most = if properties.is_cpu { OF_A_CPU } else { bound };
        let turns = if properties.is_cpu { 1 } else { TURNS };
        Self::new(gpu, [MOVED, COMPUTED].map(|vectors| vectors.min(most)), turns)
    }

    fn new(gpu: &Gpu, vectors: [usize; 2], turns: u32) -> Result<Self> {
        let pipeline =
            |operation| gpu.pipeline(&ceiling::Constants { operation: operation as u32 });
        let [copy, multiply_add, exchange] = OPERATIONS.map(pipeline);
        Ok(Self {
            operations: [copy?, multiply_add?, exchange?],
            source: gpu.zeros("ceiling source", COMPONENTS * vectors[0])?,
            target: gpu.zeros("ceiling target", COMPONENTS * vectors[0])?,
            vectors,
            turns,
        })
    }

    fn record(&mut self, pass: &mut Recorder<'_>, operation: CeilingOperation) -> Result<()> {
        let (vectors, turns) = match operation {
            CeilingOperation::Copy => (self.vectors[0], 0),
            _ => (self.vectors[1], self.turns),
        };
        let (vector_count, values) = (vectors as u32, 0..COMPONENTS * vectors);
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
    pub(crate) fn check(gpu: &Gpu) -> Result<CheckReport> {
        const VECTORS: usize = 1000;
        let mut ceiling = Self::new(gpu, [VECTORS; 2], 2)?;
        let values: Vec<f32> = (0u16..4000).map(f32::from).collect();
        gpu.write(&mut ceiling.source, &values)?;
        let (done, report) = gpu.checked(|| {
            gpu.run("ceilings", |pass| {
                OPERATIONS.into_iter().try_for_each(|operation| ceiling.record(pass, operation))
            })
        });
        done.map(|()| report)
    }

    /// Computes for about this time, so that the clocks of a device that was idle have risen.
    pub(crate) fn warm(&mut self, gpu: &Gpu, time: Duration) -> Result<()> {
        let begin = Instant::now();
        while begin.elapsed() < time {
            gpu.run("warm-up", |pass| {
                (0..16).try_for_each(|_| self.record(pass, CeilingOperation::MultiplyAdd))
            })?;
        }
        Ok(())
    }

    /// The seconds of one run.
    pub(crate) fn seconds(&mut self, gpu: &Gpu, operation: CeilingOperation) -> Result<f64> {
        let times = gpu.profile("ceilings", |pass| self.record(pass, operation))?;
        Ok(times.iter().map(|time| time.milliseconds).sum::<f64>() * 1e-3)
    }

    /// How many bytes, operations or exchanges a run is.
    pub(crate) fn amount(&self, operation: CeilingOperation) -> f64 {
        let [moved, computed] = self.vectors.map(|vectors| (vectors * COMPONENTS) as f64);
        let repeated = computed * f64::from(self.turns * OPERATIONS_PER_TURN);
        match operation {
            CeilingOperation::Copy => 2.0 * moved * size_of::<f32>() as f64,
            CeilingOperation::MultiplyAdd => 2.0 * repeated,
            CeilingOperation::Exchange => repeated,
        }
    }
}
