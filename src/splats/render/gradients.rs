//! Gradients of a view without a training: what each Gaussian adds to it.

use nightsplat_core::camera::{Camera, Patch};
use nightsplat_models::gaussians::{Attribute, Gaussians};

use super::{GradientNorm, Gradients, RenderOptions, Renderer};
use crate::Result;
use crate::gpu::{Buffer, Gpu};
use crate::splats::batches::Batches;
use crate::splats::device::DeviceGaussians;

/// Memory for the gradients of a set of Gaussians, and the host's sums of them.
#[derive(Debug)]
pub(crate) struct ViewGradients {
    /// The attribute whose gradients are read back.
    attribute: Attribute,
    batches: Batches,
    parameters: Buffer<f32>,
    grad_norm_sums: Buffer<f32>,
    visit_counts: Buffer<u32>,
    d_render: Buffer<f32>,
    /// The gradients of one backward pass, with the planes of the Gaussians.
    planes: Gaussians,
}

impl ViewGradients {
    pub(crate) fn new(
        gpu: &Gpu,
        gaussians: &DeviceGaussians,
        attribute: Attribute,
    ) -> Result<Self> {
        let layout = gaussians.layout;
        let batches = layout.batches(gpu);
        Ok(Self {
            attribute,
            parameters: batches.zeros(gpu, "gradients")?,
            grad_norm_sums: gpu.zeros("grad_norm_sums", layout.count)?,
            visit_counts: gpu.zeros("visit_counts", layout.count)?,
            d_render: gpu.uninit("d_render", 0)?,
            planes: Gaussians::zeros(layout.count, layout.shape),
            batches,
        })
    }
}

impl Renderer {
    /// Renders the view patch by patch. `d_renders` returns one or more gradients with respect to the patch's render,
    /// (channels, h, w), from its channels and transmittance; `take` gets, for each of them in order, the gradients of
    /// the attribute, (count, width), which add up over patches.
    pub(crate) fn view_gradients(
        &mut self,
        gaussians: &DeviceGaussians,
        camera: &Camera,
        options: &RenderOptions,
        gradients: &mut ViewGradients,
        mut d_renders: impl FnMut(&Patch, &[f32]) -> Vec<Vec<f32>>,
        mut take: impl FnMut(usize, &[f32]),
    ) -> Result<()> {
        self.reserve(gaussians.layout.count, [camera])?;
        let mut patches = self.patches(camera);
        while let Some(patch) = patches.pop() {
            if let Some(halves) = self.render_or_halve(gaussians.slice(), &patch, options, None)? {
                patches.extend(halves);
                continue;
            }
            let planes = self.read_planes(&patch)?;
            for (index, d_render) in d_renders(&patch, &planes).iter().enumerate() {
                gradients.d_render = self.gpu.buffer("d_render", d_render)?;
                self.record_gradients(gaussians, &patch, options, gradients)?;
                gradients.planes.parameters =
                    gradients.batches.read(&self.gpu, &gradients.parameters)?;
                let plane = gradients.planes.plane(gradients.attribute);
                take(index, &gradients.planes.parameters[plane]);
            }
        }
        Ok(())
    }

    /// The backward pass of the patch that was rendered last.
    fn record_gradients(
        &mut self,
        gaussians: &DeviceGaussians,
        patch: &Patch,
        options: &RenderOptions,
        gradients: &mut ViewGradients,
    ) -> Result<()> {
        let ViewGradients { parameters, grad_norm_sums, visit_counts, d_render, .. } = gradients;
        let outputs = Gradients { parameters, grad_norm_sums, visit_counts };
        self.gpu.clone().run("view_gradients", |pass| {
            let norm = GradientNorm::default();
            self.backward(pass, gaussians, *patch, options, norm, d_render, outputs)
        })
    }
}
