//! Cameras on the device: kernels index a buffer of them.

use super::Renderer;
use crate::Result;
use crate::camera::{Camera, CameraModel, Patch};
use crate::gpu::{Buffer, Gpu, Pipeline, Recorder, Threads};
use crate::kernels::camera::CAMERA_WIDTH;
use crate::kernels::{self, camera_backward, camera_gradient};
use crate::splats::scene::GaussianSlice;

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

/// Kernels and memory for the gradient of a camera. No camera is learned yet.
#[cfg(feature = "testing")]
#[derive(Debug)]
pub struct CameraGradient {
    model: CameraModel,
    backward: Pipeline<camera_backward::Kernel>,
    sum: Pipeline<camera_gradient::Kernel>,
    /// (Gaussians, [`CAMERA_WIDTH`])
    shares: Buffer<f32>,
}

#[cfg(feature = "testing")]
impl CameraGradient {
    /// Components of the gradient: a translation of the view, world units; a rotation about the camera, radians, (x, y,
    /// z) each in view space; focal lengths, principal point and the four coefficients of a fisheye.
    pub const WIDTH: usize = CAMERA_WIDTH as usize;

    /// Builds the kernels for a camera model, and allocates for `capacity` Gaussians.
    pub fn new(renderer: &Renderer, model: CameraModel, gaussian_count: usize) -> Result<Self> {
        let Renderer { gpu, settings, tile, .. } = renderer;
        let [tile_width, tile_height] = tile.size;
        let constants = camera_backward::Constants {
            alpha_max: settings.max_alpha,
            channels: settings.channels() as u32,
            tile_width,
            tile_height,
            camera_model: model.number(),
            antialiased: settings.antialiased,
        };
        Ok(Self {
            model,
            backward: gpu.pipeline(&constants)?,
            sum: gpu.pipeline(&camera_gradient::Constants::default())?,
            shares: gpu.uninit("camera shares", Self::WIDTH * gaussian_count)?,
        })
    }

    /// Records the gradient of a viewpoint's camera ([`CameraGradient::WIDTH`]), after the [`Renderer::backward`] of
    /// the same viewpoint, whose parameter gradients it reads. The camera is moved in view space: a point p becomes p +
    /// translation + rotation x p.
    pub fn record<'a>(
        &mut self,
        pass: &mut Recorder<'_>,
        renderer: &Renderer,
        (gaussians, gradients): (impl Into<GaussianSlice<'a>>, &Buffer<f32>),
        viewpoint: impl Into<Viewpoint<'a>>,
        gradient: &mut Buffer<f32>,
    ) -> Result<()> {
        let Viewpoint { patch, on_device } = viewpoint.into();
        let (frame, GaussianSlice { layout, parameters }) = (&renderer.frame, gaussians.into());
        renderer.check(&layout)?;
        if patch.camera.model.number() != self.model.number() {
            let problem = "the gradient of a camera was built for another camera model";
            return Err(crate::Error::Usage(problem.to_owned()));
        }
        let (cameras, camera_index) = on_device.unwrap_or((&frame.camera, 0));
        for batch in layout.batches(&renderer.gpu).iter() {
            let gaussian_count = batch.gaussian_count();
            pass.dispatch(
                &self.backward,
                &camera_backward::Params { camera_index, gaussian_count },
                camera_backward::Buffers {
                    parameters: batch.rows(parameters, layout.words())?,
                    splats: batch.rows(&frame.splats, 1)?,
                    tile_counts: batch.rows(&frame.tile_counts, 1)?,
                    intersection_ranges: batch.rows(&frame.intersection_ranges, 1)?,
                    gradient_records: frame.gradient_records.slice(),
                    gradients: batch.planes(gradients)?,
                    cameras: cameras.slice(),
                    shares: batch.rows_mut(&mut self.shares, Self::WIDTH)?,
                },
                Threads::Exactly([gaussian_count, 1, 1]),
            )?;
        }
        pass.dispatch(
            &self.sum,
            &camera_gradient::Params { gaussian_count: layout.count as u32 },
            camera_gradient::Buffers {
                shares: self.shares.slice(),
                gradient: gradient.slice_mut(),
            },
            Threads::Workgroups([CAMERA_WIDTH, 1, 1]),
        )
    }
}
