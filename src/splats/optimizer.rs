//! Adam for the planes of the Gaussians and for other parameters, and the learning-rate schedules.

mod finite;
mod learnable;
mod schedule;

pub use finite::FiniteCheck;
pub use learnable::Learnable;
pub use schedule::{LearningRates, Schedule};

use std::sync::OnceLock;

use nightsplat_models::attributes::PlaneCounts;
use nightsplat_models::gaussians::Shape;

use crate::gpu::{Buffer, Gpu, Kernel, Pipeline, Recorder, Slice, SliceMut, Threads};
use crate::kernels::sh::MAX_SH_DEGREE;
use crate::kernels::{self, adam, adam_gaussian};
use crate::splats::batches::{Batch, frozen_floats, rest_by_column};
use crate::splats::device::Layout;
use crate::splats::packed_sh::StorageFormat;
use crate::{Error, Result};

/// Adam's exponential moving averages of gradients and squared gradients: planes in the layout of the parameters, in
/// buffers or in slices of buffers.
#[derive(Debug)]
pub enum Moments<P = Buffer<f32>> {
    /// Both in 32 bits.
    Single {
        /// First moments.
        first: P,
        /// Second moments.
        second: P,
    },
    /// Both in one word: 16 bits of the first above 16 bits of the second.
    Half(P),
}

impl Moments {
    /// Zero moments for `len` parameters.
    pub fn zeros(gpu: &Gpu, len: usize) -> Result<Self> {
        Self::new(StorageFormat::Single, |name| gpu.zeros(name, len))
    }

    /// Moments whose planes `make` allocates, by name.
    pub(crate) fn new(
        bits: StorageFormat,
        mut plane: impl FnMut(&'static str) -> Result<Buffer<f32>>,
    ) -> Result<Self> {
        Ok(match bits {
            StorageFormat::Single => {
                Self::Single { first: plane("first_moments")?, second: plane("second_moments")? }
            }
            StorageFormat::Half => Self::Half(plane("moments")?),
        })
    }

    /// Borrows all of them for a step of Adam.
    pub fn slice_mut(&mut self) -> Moments<SliceMut<'_, f32>> {
        self.as_mut().map(Buffer::slice_mut)
    }

    /// Borrows those of a batch of Gaussians.
    pub fn of_batch(&mut self, batch: &Batch) -> Result<Moments<SliceMut<'_, f32>>> {
        Ok(match self {
            Self::Single { first, second } => Moments::Single {
                first: batch.planes_mut(first)?,
                second: batch.planes_mut(second)?,
            },
            Self::Half(both) => Moments::Half(batch.planes_mut(both)?),
        })
    }
}

impl<P> Moments<P> {
    fn as_mut(&mut self) -> Moments<&mut P> {
        match self {
            Self::Single { first, second } => Moments::Single { first, second },
            Self::Half(both) => Moments::Half(both),
        }
    }

    fn map<Q>(self, mut plane: impl FnMut(P) -> Q) -> Moments<Q> {
        match self {
            Self::Single { first, second } => {
                Moments::Single { first: plane(first), second: plane(second) }
            }
            Self::Half(both) => Moments::Half(plane(both)),
        }
    }

    /// Their planes, by name.
    pub(crate) fn planes(&self) -> Vec<(&'static str, &P)> {
        match self {
            Self::Single { first, second } => {
                vec![("first_moments", first), ("second_moments", second)]
            }
            Self::Half(both) => vec![("moments", both)],
        }
    }

    /// Their planes, by name.
    pub(crate) fn planes_mut(&mut self) -> Vec<(&'static str, &mut P)> {
        self.as_mut().into_planes()
    }

    /// Their planes, by name.
    pub(crate) fn into_planes(self) -> Vec<(&'static str, P)> {
        match self {
            Self::Single { first, second } => {
                vec![("first_moments", first), ("second_moments", second)]
            }
            Self::Half(both) => vec![("moments", both)],
        }
    }

    /// Their storage format.
    pub fn bits(&self) -> StorageFormat {
        match self {
            Self::Single { .. } => StorageFormat::Single,
            Self::Half(_) => StorageFormat::Half,
        }
    }
}

impl<'a> Moments<SliceMut<'a, f32>> {
    /// The bindings of a kernel: first moments, second moments, packed moments; those that do not apply are empty.
    fn bindings(self) -> Result<[SliceMut<'a, f32>; 3]> {
        match self {
            Self::Single { first, second } => {
                let len = first.len();
                let [first, both] = first.split([0..len, 0..0])?;
                Ok([first, second, both])
            }
            Self::Half(both) => {
                let len = both.len();
                both.split([0..0, 0..0, 0..len])
            }
        }
    }
}

/// The planes that a step of [`Adam`] updates. Parameters have at least `column_count * gaussian_count` floats,
/// gradients and moments those of the columns that are trained.
#[derive(Debug)]
pub struct AdamBuffers<'a> {
    /// The parameters.
    pub parameters: SliceMut<'a, f32>,
    /// dL/d parameters; non-finite entries count as zero.
    pub gradients: Slice<'a, f32>,
    /// The moments, updated.
    pub moments: Moments<SliceMut<'a, f32>>,
}

/// Adam with beta 0.9 and 0.999, epsilon 1e-15 (Kingma and Ba 2015; the constants of 3DGS).
#[derive(Debug)]
pub struct Adam {
    gpu: Gpu,
    /// The kernel for 32-bit numbers of any kind.
    floats: OnceLock<Pipeline<adam::Kernel>>,
    /// The same without the frozen columns.
    trained: OnceLock<Pipeline<adam::Kernel>>,
    /// The columns of the Gaussians, from the first, that do not change.
    frozen_columns: u32,
    /// The kernels for whole Gaussians, by stored SH degree and by the formats of coefficients and moments.
    gaussians: [OnceLock<Pipeline<adam_gaussian::Kernel>>; 4 * DEGREES],
}

const DEGREES: usize = MAX_SH_DEGREE as usize + 1;

/// A step of [`Adam`].
#[derive(Clone, Copy, Debug)]
pub struct AdamStep<'a> {
    /// Its number, from 1.
    pub step: u64,
    /// The learning rates.
    pub rates: &'a LearningRates,
    /// Nothing changes while its first word is nonzero.
    pub status: &'a Buffer<u32>,
}

/// A step over whole Gaussians, whose gradients above SH degree 0 are those of colours.
#[derive(Clone, Copy, Debug)]
pub struct GaussianStep<'a> {
    /// What it shares with others.
    pub adam: AdamStep<'a>,
    /// The SH degree in use.
    pub sh_degree: u32,
    /// The camera of the step: its buffer and index.
    pub camera: (&'a Buffer<kernels::Camera>, u32),
}

impl Adam {
    /// [`Adam::with_frozen`] without frozen columns.
    pub fn new(gpu: &Gpu) -> Result<Self> {
        Self::with_frozen(gpu, 0)
    }

    /// Builds the kernel; those for whole Gaussians are built on first use. All leave the first columns of Gaussians as
    /// they are.
    pub fn with_frozen(gpu: &Gpu, frozen_columns: u32) -> Result<Self> {
        let adam = Self {
            gpu: gpu.clone(),
            floats: Default::default(),
            trained: Default::default(),
            frozen_columns,
            gaussians: Default::default(),
        };
        adam.pipeline(&adam.floats, &adam::Constants { frozen_columns: 0 })?;
        Ok(adam)
    }

    /// Records a step over `planes`, which may be a part of all. Moments are in 32 bits.
    pub fn record(
        &self,
        pass: &mut Recorder<'_>,
        step: AdamStep<'_>,
        planes: PlaneCounts,
        buffers: AdamBuffers<'_>,
    ) -> Result<()> {
        self.record_from(0, pass, step, planes, buffers)
    }

    /// [`Adam::record`] for Gaussians, whose frozen columns have neither gradients nor moments.
    pub fn record_trained(
        &self,
        pass: &mut Recorder<'_>,
        step: AdamStep<'_>,
        planes: PlaneCounts,
        buffers: AdamBuffers<'_>,
    ) -> Result<()> {
        self.record_from(self.frozen_columns, pass, step, planes, buffers)
    }

    fn record_from(
        &self,
        frozen_columns: u32,
        pass: &mut Recorder<'_>,
        AdamStep { step, rates, status }: AdamStep<'_>,
        planes: PlaneCounts,
        AdamBuffers { parameters, gradients, moments }: AdamBuffers<'_>,
    ) -> Result<()> {
        let len = planes.total();
        let left = frozen_floats(frozen_columns, planes.gaussians);
        check(step, status, [(parameters.as_slice(), len), (gradients, len - left)], &moments)?;
        let Moments::Single { first: first_moments, second: second_moments } = moments else {
            return Err(Error::Usage("16-bit moments are those of whole Gaussians".to_owned()));
        };
        let built = if frozen_columns == 0 { &self.floats } else { &self.trained };
        let pipeline = self.pipeline(built, &adam::Constants { frozen_columns })?;
        let (uncorrected, second_correction) = corrections(step);
        pass.dispatch(
            pipeline,
            &adam::Params {
                gaussian_count: planes.gaussians as u32,
                column_count: planes.columns as u32,
                feature_count: planes.features as u32,
                second_correction,
                rates: rates.0.map(|rate| (rate / uncorrected) as f32),
            },
            adam::Buffers {
                parameters,
                gradients,
                first_moments,
                second_moments,
                status: status.slice(),
            },
            Threads::Exactly([(len - left).div_ceil(4) as u32, 1, 1]),
        )
    }

    /// Records a step of Gaussians in this layout, a batch of all.
    pub fn record_gaussians(
        &self,
        pass: &mut Recorder<'_>,
        GaussianStep { adam, sh_degree, camera }: GaussianStep<'_>,
        layout: Layout,
        AdamBuffers { parameters, gradients, moments }: AdamBuffers<'_>,
    ) -> Result<()> {
        let (AdamStep { step, rates, status }, frozen_columns) = (adam, self.frozen_columns);
        let floats = layout.floats().total() - frozen_floats(frozen_columns, layout.count);
        let words = layout.count * layout.words();
        check(step, status, [(parameters.as_slice(), words), (gradients, floats)], &moments)?;
        let stored = layout.shape.sh_degree;
        let pipeline = self.of_gaussians(layout.shape, [layout.sh_rest, moments.bits()])?;
        let [first_moments, second_moments, both_moments] = moments.bindings()?;
        let (uncorrected, second_correction) = corrections(step);
        pass.dispatch(
            pipeline,
            &adam_gaussian::Params {
                camera_index: camera.1,
                gaussian_count: layout.count as u32,
                sh_degree: sh_degree.min(stored),
                second_correction,
                step: step as u32,
                rates: rates.0.map(|rate| (rate / uncorrected) as f32),
            },
            adam_gaussian::Buffers {
                parameters,
                gradients,
                first_moments,
                second_moments,
                both_moments: both_moments.words(),
                status: status.slice(),
                cameras: camera.0.slice(),
            },
            Threads::Exactly([layout.count as u32, 1, 1]),
        )
    }

    /// The kernel for whole Gaussians of this shape with coefficients and moments of these formats.
    pub(crate) fn of_gaussians(
        &self,
        Shape { sh_degree, features }: Shape,
        formats: [StorageFormat; 2],
    ) -> Result<&Pipeline<adam_gaussian::Kernel>> {
        let [half_rest, half_moments] = formats.map(|format| format == StorageFormat::Half);
        let constants = adam_gaussian::Constants {
            sh_degree,
            feature_count: features.width() as u32,
            half_rest,
            half_moments,
            rest_by_column: rest_by_column(&self.gpu),
            frozen_columns: self.frozen_columns,
        };
        let which = 4 * sh_degree as usize + 2 * usize::from(half_rest) + usize::from(half_moments);
        self.pipeline(&self.gaussians[which], &constants)
    }

    fn pipeline<'a, K: Kernel>(
        &self,
        built: &'a OnceLock<Pipeline<K>>,
        constants: &K::Constants,
    ) -> Result<&'a Pipeline<K>> {
        if let Some(pipeline) = built.get() {
            return Ok(pipeline);
        }
        let pipeline = self.gpu.pipeline(constants)?;
        Ok(built.get_or_init(|| pipeline))
    }
}

/// A kernel that exceeds a buffer overwrites other data, so lengths are checked before anything is recorded: those of
/// the parameters and of the gradients, which the moments share.
fn check(
    step: u64,
    status: &Buffer<u32>,
    [parameters, gradients]: [(Slice<'_, f32>, usize); 2],
    moments: &Moments<SliceMut<'_, f32>>,
) -> Result<()> {
    let moments = moments.planes().into_iter().map(|(_, plane)| (plane.as_slice(), gradients.1));
    let mut planes = [parameters, gradients].into_iter().chain(moments);
    planes.try_for_each(|(plane, needed)| plane.check_len(needed))?;
    if step == 0 || status.is_empty() {
        let what = "Adam counts steps from 1 and needs a status word";
        return Err(Error::Usage(what.to_owned()));
    }
    Ok(())
}

/// 1 - b1^t and 1 / sqrt(1 - b2^t), computed in double precision: 1 - 0.999^t loses four digits to cancellation at t =
/// 1.
fn corrections(step: u64) -> (f64, f32) {
    let uncorrected = |beta: f64| 1.0 - beta.powf(step as f64);
    (uncorrected(0.9), (1.0 / uncorrected(0.999).sqrt()) as f32)
}
