//! Gaussians that are rendered with those of every view, and have no gradients.

use nightsplat_models::gaussians::Gaussians;

use super::Renderer;
use crate::Result;
use crate::splats::batches::ALIGNMENT;
use crate::splats::device::Upload;

/// Before the sigmoid: too transparent to be rendered.
const INVISIBLE: f32 = -100.0;

impl Renderer {
    /// Renders these Gaussians together with those of every view from now on. They have neither gradients nor
    /// statistics. SH degrees that the renderer does not have are dropped. Memory must be reserved anew.
    #[doc(hidden)]
    pub fn set_context(&mut self, context: &Gaussians) -> Result<()> {
        // The Gaussians of a view come after, at an aligned index.
        let missing = context.count.next_multiple_of(ALIGNMENT) - context.count;
        let mut padded = context.with_sh_degree(self.settings.shape.sh_degree);
        let mut padding = Gaussians::zeros(missing, padded.shape);
        padding.origin = context.origin;
        padding.raw_opacities_mut().fill(INVISIBLE);
        padded.append(&padding);
        let uploaded = padded.upload_as(&self.gpu, self.settings.rest)?;
        self.check_layout(&uploaded.layout)?;
        self.context = Some(uploaded);
        Ok(())
    }

    /// The context with another SH degree.
    pub(super) fn set_context_degree(&mut self, sh_degree: u32) -> Result<()> {
        let Some(context) = &self.context else { return Ok(()) };
        let gaussians = context.download(&self.gpu)?.with_sh_degree(sh_degree);
        self.context = Some(gaussians.upload_as(&self.gpu, self.settings.rest)?);
        Ok(())
    }
}
