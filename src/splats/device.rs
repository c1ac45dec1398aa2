//! Gaussians on the device: their layout, and their owned and borrowed forms.

use glam::{DVec3, Vec3};
use nightsplat_models::attributes::PlaneCounts;
use nightsplat_models::gaussians::{Gaussians, Shape, width};

use crate::Result;
use crate::gpu::{Buffer, Gpu, Slice};
use crate::splats::batches::Batches;
use crate::splats::packed_sh::{PackedSh, StorageFormat};

/// The layout of Gaussians on the device: planes (include/gaussian.glsl), in batches if they exceed one binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The number of Gaussians.
    pub count: usize,
    /// The number that memory is allocated for.
    pub capacity: usize,
    /// Their attributes.
    pub shape: Shape,
    /// The storage format of SH coefficients above degree 0.
    pub sh_rest: StorageFormat,
}

impl Layout {
    /// The layout of `count` Gaussians, without headroom.
    #[doc(hidden)]
    pub fn new(count: usize, shape: impl Into<Shape>, sh_rest: StorageFormat) -> Self {
        Self { count, capacity: count, shape: shape.into(), sh_rest }
    }

    /// The dimensions of planes with one float per parameter, such as gradients and moments.
    #[doc(hidden)]
    pub fn floats(&self) -> PlaneCounts {
        let features = self.shape.features.width();
        PlaneCounts { gaussians: self.count, columns: width(self.shape), features }
    }

    /// Words per Gaussian.
    pub(crate) fn words(&self) -> usize {
        self.sh_rest.words(self.floats())
    }

    /// The batches of planes with one float per parameter.
    #[doc(hidden)]
    pub fn batches(&self, gpu: &Gpu) -> Batches {
        Batches::new(gpu, self.floats())
    }

    /// The batches of the parameters.
    pub(crate) fn parameter_batches(&self, gpu: &Gpu) -> Batches {
        self.batches(gpu).with_columns(self.words())
    }
}

/// Gaussians with their parameters on the device, for a [`Renderer`](crate::splats::render::Renderer).
#[derive(Debug)]
pub struct DeviceGaussians {
    /// The layout of the parameters.
    pub layout: Layout,
    /// `capacity * words()` words or more, in that layout.
    pub parameters: Buffer<f32>,
    /// The world position that their positions are relative to.
    pub origin: DVec3,
    /// As they were uploaded; `None` where they were not, or there is none.
    #[doc(hidden)]
    pub bounds: Option<GaussianBounds>,
}

/// The extent of Gaussians.
#[doc(hidden)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianBounds {
    /// Corners of the box of the means.
    pub(crate) corners: [Vec3; 2],
    /// The greatest standard deviation.
    pub(crate) deviation: f32,
}

impl GaussianBounds {
    fn new(gaussians: &Gaussians) -> Option<Self> {
        let first = *gaussians.means().first()?;
        let corners = gaussians
            .means()
            .iter()
            .fold([first; 2], |[least, most], &mean| [least.min(mean), most.max(mean)]);
        let widest = gaussians.log_scales().iter().map(|scale| scale.max_element());
        Some(Self { corners, deviation: widest.fold(f32::MIN, f32::max).exp() })
    }
}

/// Gaussians on the device, borrowed for passes that read them.
#[derive(Clone, Copy, Debug)]
pub struct GaussianSlice<'a> {
    /// The layout of the parameters.
    pub layout: Layout,
    /// `count * words()` words or more, in that layout.
    pub parameters: Slice<'a, f32>,
}

impl<'a> From<&'a DeviceGaussians> for GaussianSlice<'a> {
    fn from(gaussians: &'a DeviceGaussians) -> Self {
        gaussians.slice()
    }
}

impl DeviceGaussians {
    /// Allocates Gaussians with uninitialised parameters.
    #[doc(hidden)]
    pub fn uninit(gpu: &Gpu, layout: Layout) -> Result<Self> {
        let len = layout.capacity.max(layout.count) * layout.words();
        let window = layout.parameter_batches(gpu).window();
        let parameters = gpu.uninit_in_windows("parameters", len, window)?;
        Ok(Self { layout, parameters, origin: DVec3::ZERO, bounds: None })
    }

    /// Borrows them for rendering.
    #[doc(hidden)]
    pub fn slice(&self) -> GaussianSlice<'_> {
        GaussianSlice { layout: self.layout, parameters: self.parameters.slice() }
    }

    /// Overwrites the parameters with planes of floats.
    #[doc(hidden)]
    pub fn write(&mut self, gpu: &Gpu, floats: &[f32]) -> Result<()> {
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
    #[doc(hidden)]
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<f32>> {
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

/// Gaussians that are copied to a device.
pub trait Upload {
    /// A copy on the device, every parameter in 32 bits.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    fn upload(&self, gpu: &Gpu) -> Result<DeviceGaussians> {
        self.upload_as(gpu, StorageFormat::Single)
    }

    /// A copy on the device, SH coefficients above degree 0 in the format `sh_rest`.
    #[doc(hidden)]
    fn upload_as(&self, gpu: &Gpu, sh_rest: StorageFormat) -> Result<DeviceGaussians>;
}

impl Upload for Gaussians {
    fn upload_as(&self, gpu: &Gpu, sh_rest: StorageFormat) -> Result<DeviceGaussians> {
        let mut gaussians =
            DeviceGaussians::uninit(gpu, Layout::new(self.count, self.shape, sh_rest))?;
        gaussians.origin = self.origin;
        gaussians.bounds = GaussianBounds::new(self);
        gaussians.write(gpu, &self.parameters)?;
        Ok(gaussians)
    }
}
