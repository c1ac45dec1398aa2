//! The model as it is, for who looks at a training on its own device.

use super::Trainer;
use crate::Result;
use crate::camera::TrainingFrame;
use crate::splats::render::{Purpose, RenderSettings};
use crate::splats::scene::DeviceGaussians;

/// Gaussians on the device, with what draws them.
#[derive(Debug)]
pub(crate) struct ShownModel {
    pub(crate) gaussians: DeviceGaussians,
    pub(crate) settings: RenderSettings,
    /// The SH degree in use.
    pub(crate) sh_degree: u32,
    /// Where they are in the dataset's world.
    pub(crate) frame: TrainingFrame,
}

impl Trainer {
    /// A copy of the model that stays on the device.
    pub(crate) fn shown(&self) -> Result<ShownModel> {
        let own = &self.model.gaussians;
        let mut gaussians = DeviceGaussians::uninit(&self.gpu, own.layout)?;
        gaussians.origin = own.origin;
        self.gpu.run("shown", |pass| {
            pass.copy(&own.parameters, &mut gaussians.parameters);
            Ok(())
        })?;
        let shape = own.layout.shape;
        let settings = RenderSettings {
            shape,
            purpose: Purpose::Show,
            lamp: None,
            ..self.config.render_settings()
        };
        Ok(ShownModel {
            gaussians,
            settings,
            sh_degree: self.sh_degree_in_use(),
            frame: self.frame,
        })
    }
}
