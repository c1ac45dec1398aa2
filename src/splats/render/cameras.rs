//! Cameras on the device: kernels find theirs by its index in a buffer.

use crate::Result;
use crate::camera::{Camera, Patch};
use crate::gpu::{Buffer, Gpu};
use crate::kernels;

/// What is rendered: a patch of what a camera sees, and where on the device the camera is.
#[derive(Clone, Copy, Debug)]
pub struct Viewpoint<'a> {
    pub(super) patch: Patch,
    /// The buffer and the index; none: the camera goes into the command buffer, and from there to the renderer.
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

/// Views that are rendered again and again, with their cameras in one buffer.
#[derive(Debug)]
pub struct Viewpoints {
    patches: Vec<Patch>,
    cameras: Buffer<kernels::Camera>,
}

impl Viewpoints {
    /// Uploads the cameras.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn new(gpu: &Gpu, patches: Vec<Patch>) -> Result<Self> {
        let cameras: Vec<kernels::Camera> = patches.iter().map(Into::into).collect();
        Ok(Self { cameras: gpu.buffer("cameras", &cameras)?, patches })
    }

    /// One of them, by the place it was given at.
    ///
    /// # Panics
    /// There is none at this place.
    pub fn get(&self, index: usize) -> Viewpoint<'_> {
        Viewpoint { patch: self.patches[index], on_device: Some((&self.cameras, index as u32)) }
    }
}
