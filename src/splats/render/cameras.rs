//! Cameras on the device: kernels index a buffer of them.

use nightsplat_core::camera::{Camera, Patch};

use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::kernels;

/// What is rendered: a camera or a patch of it, and the camera's index on the device.
#[derive(Clone, Copy, Debug)]
pub struct Viewpoint<'a> {
    pub(super) patch: Patch,
    /// The buffer and the index; `None`: the camera is uploaded through the command buffer.
    pub(super) on_device: Option<(&'a Buffer<kernels::Camera>, u32)>,
}

impl From<Patch> for Viewpoint<'_> {
    fn from(patch: Patch) -> Self {
        Self { patch, on_device: None }
    }
}

impl From<&Camera> for Viewpoint<'_> {
    fn from(camera: &Camera) -> Self {
        Patch::from(camera).into()
    }
}

/// Views that are rendered repeatedly, with their cameras in one buffer.
#[derive(Debug)]
pub struct Viewpoints {
    patches: Vec<Patch>,
    cameras: Buffer<kernels::Camera>,
}

impl Viewpoints {
    /// Uploads the cameras.
    pub fn new(gpu: &Gpu, patches: Vec<Patch>) -> Result<Self> {
        let cameras: Vec<kernels::Camera> = patches.iter().map(Into::into).collect();
        Ok(Self { cameras: gpu.buffer("cameras", &cameras)?, patches })
    }

    /// The view at `index`, in the order of the upload.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn get(&self, index: usize) -> Viewpoint<'_> {
        Viewpoint { patch: self.patches[index], on_device: Some((&self.cameras, index as u32)) }
    }
}
