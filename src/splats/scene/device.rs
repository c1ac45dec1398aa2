//! Gaussians on the device: how they lie there, and what owns and lends them.

use glam::DVec3;

use super::{Gaussians, Shape, width};
use crate::Result;
use crate::gpu::{Buffer, Gpu, Slice};
use crate::splats::attributes::PlaneCounts;
use crate::splats::batches::Batches;
use crate::splats::packed_sh::{PackedSh, StorageFormat};

/// How Gaussians lie on the device: as planes (include/gaussian.glsl), in batches where one binding does not hold them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The number of Gaussians.
    pub count: usize,
    /// How many there is memory for.
    pub capacity: usize,
    /// What they are made of.
    pub shape: Shape,
    /// How SH coefficients above degree 0 are stored.
    pub sh_rest: StorageFormat,
}

impl Layout {
    /// Of `count` Gaussians, with memory for no more.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn new(count: usize, shape: impl Into<Shape>, sh_rest: StorageFormat) -> Self {
        Self { count, capacity: count, shape: shape.into(), sh_rest }
    }

    /// What planes of one float for each parameter are made of, as gradients and moments are.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn floats(&self) -> PlaneCounts {
        let features = self.shape.features.width();
        PlaneCounts { gaussians: self.count, columns: width(self.shape), features }
    }

    /// Words of each Gaussian's parameters.
    pub(crate) fn words(&self) -> usize {
        self.sh_rest.words(self.floats())
    }

    /// How planes of one float for each parameter lie in a buffer.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn batches(&self, gpu: &Gpu) -> Batches {
        Batches::new(gpu, self.floats())
    }

    /// How the parameters do.
    pub(crate) fn parameter_batches(&self, gpu: &Gpu) -> Batches {
        self.batches(gpu).with_columns(self.words())
    }
}

/// Gaussians on the device, which owns their parameters: what a [`Renderer`](crate::splats::render::Renderer) draws.
#[derive(Debug)]
pub struct DeviceGaussians {
    /// How the parameters lie in their buffer.
    pub layout: Layout,
    /// `capacity * words()` words or more, as the layout says.
    pub parameters: Buffer<f32>,
    /// The world position that their positions are relative to.
    pub origin: DVec3,
}

/// Gaussians on the device, borrowed for passes that read them.
#[derive(Clone, Copy, Debug)]
pub struct GaussianSlice<'a> {
    /// How the parameters lie.
    pub layout: Layout,
    /// `count * words()` words or more, as the layout says.
    pub parameters: Slice<'a, f32>,
}

impl<'a> From<&'a DeviceGaussians> for GaussianSlice<'a> {
    fn from(gaussians: &'a DeviceGaussians) -> Self {
        gaussians.slice()
    }
}

impl DeviceGaussians {
    /// Memory for Gaussians whose parameters are undefined.
    ///
    /// # Errors
    /// The device is out of memory.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn uninit(gpu: &Gpu, layout: Layout) -> Result<Self> {
        let len = layout.capacity.max(layout.count) * layout.words();
        let parameters = gpu.uninit_in_windows("parameters", len)?;
        Ok(Self { layout, parameters, origin: DVec3::ZERO })
    }

    /// To be drawn.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn slice(&self) -> GaussianSlice<'_> {
        GaussianSlice { layout: self.layout, parameters: self.parameters.slice() }
    }

    /// Overwrites the parameters with planes of floats.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn write(&mut self, gpu: &Gpu, floats: &[f32]) -> Result<()> {
        let batches = self.layout.parameter_batches(gpu);
        match self.layout.sh_rest {
            StorageFormat::Single => batches.write(gpu, &mut self.parameters, floats),
            StorageFormat::Half => {
                let words = PackedSh::new(self.layout.floats()).pack(floats);
                batches.write(gpu, &mut self.parameters, &words)
            }
        }
    }

    /// The parameters as planes of floats.
    ///
    /// # Errors
    /// The device was lost.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<Vec<f32>> {
        let words = self.layout.parameter_batches(gpu).read(gpu, &self.parameters)?;
        Ok(match self.layout.sh_rest {
            StorageFormat::Single => words,
            StorageFormat::Half => PackedSh::new(self.layout.floats()).unpack(&words),
        })
    }

    /// A copy on the host.
    ///
    /// # Errors
    /// The device was lost.
    pub fn download(&self, gpu: &Gpu) -> Result<Gaussians> {
        let Layout { count, shape, .. } = self.layout;
        Ok(Gaussians { count, shape, parameters: self.read(gpu)?, origin: self.origin })
    }
}

impl Gaussians {
    /// A copy on the device, every parameter in 32 bits.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn upload(&self, gpu: &Gpu) -> Result<DeviceGaussians> {
        self.upload_as(gpu, StorageFormat::Single)
    }

    /// A copy on the device, SH coefficients above degree 0 as `sh_rest` says.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn upload_as(&self, gpu: &Gpu, sh_rest: StorageFormat) -> Result<DeviceGaussians> {
        let mut gaussians =
            DeviceGaussians::uninit(gpu, Layout::new(self.count, self.shape, sh_rest))?;
        gaussians.origin = self.origin;
        gaussians.write(gpu, &self.parameters)?;
        Ok(gaussians)
    }
}
