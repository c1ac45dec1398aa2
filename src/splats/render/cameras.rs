//! Cameras on the device: kernels index a buffer of them.

use nightsplat_core::camera::{Camera, Patch};

use super::lists::Lists;
use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::kernels;

/// What is rendered: a camera or a patch of it, and the camera's index on the device.
#[derive(Clone, Copy, Debug)]
pub struct Viewpoint<'a> {
    pub(super) patch: Patch,
    /// The buffer and the index; `None`: the camera is uploaded through the command buffer.
    pub(super) on_device: Option<(&'a Buffer<kernels::Camera>, u32)>,
    /// Its sorted intersections; `None`: a render sorts them.
    pub(super) lists: Option<&'a Lists>,
}

impl From<Patch> for Viewpoint<'_> {
    fn from(patch: Patch) -> Self {
        Self { patch, on_device: None, lists: None }
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
    pub(super) patches: Vec<Patch>,
    cameras: Buffer<kernels::Camera>,
    /// Those of the first views that are kept.
    pub(super) lists: Vec<Lists>,
    /// Whether the next view's would exceed the memory for them.
    pub(super) has_all_that_fit: bool,
}

impl Viewpoints {
    /// Uploads the cameras.
    pub fn new(gpu: &Gpu, patches: Vec<Patch>) -> Result<Self> {
        let cameras: Vec<kernels::Camera> = patches.iter().map(Into::into).collect();
        let cameras = gpu.buffer("cameras", &cameras)?;
        Ok(Self { cameras, patches, lists: vec![], has_all_that_fit: false })
    }

    /// The view at `index`, in the order of the upload.
    ///
    /// # Panics
    /// The index is out of range.
    pub fn get(&self, index: usize) -> Viewpoint<'_> {
        let on_device = Some((&self.cameras, index as u32));
        Viewpoint { patch: self.patches[index], on_device, lists: self.lists.get(index) }
    }
    /// The number of views whose sorted intersections are kept, and of all.
    pub(crate) fn kept_and_all(&self) -> [usize; 2] {
        [self.lists.len(), self.patches.len()]
    }

    /// Forgets the sorted intersections that are kept, as those of other Gaussians.
    pub(crate) fn forget_lists(&mut self) {
        self.lists.clear();
        self.has_all_that_fit = false;
    }
}
