//! The layers that can be rendered from a model.

use std::str::FromStr;

use glam::{DQuat, DVec3, Vec3};
use nightsplat_core::camera::Camera;
use nightsplat_models::gaussians::{Feature, Features, Gaussians, SH_C0};
use nightsplat_photographs::image::Image;

use super::ModelRenderer;
use crate::gpu::Gpu;
use crate::splats::device::Upload;
use crate::splats::render::{RenderOptions, RenderSettings, Renderer};
use crate::train::Networks;
use crate::{Error, Result};

/// The images that can be rendered from a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RenderLayer {
    /// R_0, the Gaussians' colours.
    Rgb,
    /// R_K, the output of the denoiser.
    Denoised,
    /// The median depth in the view, in world units; infinite where less than half of the light is stopped.
    Depth,
    /// The surface normal in the view, x right, y up, z towards the camera: a unit vector, 0 where nothing is seen.
    Normal,
    /// One minus the transmittance.
    Alpha,
    /// The light of the background that the splats let through.
    Transmittance,
    /// The depth feature, in its own units.
    DepthFeature,
    /// The structure feature.
    Structure,
    /// The illumination feature.
    Illumination,
    /// The noise feature.
    Noise,
}

impl RenderLayer {
    /// Every layer.
    pub const ALL: [Self; 10] = [
        Self::Rgb,
        Self::Denoised,
        Self::Depth,
        Self::Normal,
        Self::Alpha,
        Self::Transmittance,
        Self::DepthFeature,
        Self::Structure,
        Self::Illumination,
        Self::Noise,
    ];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rgb => "rgb",
            Self::Denoised => "denoised",
            Self::Depth => "depth",
            Self::Normal => "normal",
            Self::Alpha => "alpha",
            Self::Transmittance => "transmittance",
            Self::DepthFeature => "depth-feature",
            Self::Structure => "structure",
            Self::Illumination => "illumination",
            Self::Noise => "noise",
        }
    }

    /// Whether its values are sRGB-encoded colours.
    pub(crate) fn is_color(self) -> bool {
        matches!(self, Self::Rgb | Self::Denoised)
    }
}

impl FromStr for RenderLayer {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|layer| layer.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::Usage(format!("unknown layer `{name}`; the layers are {names}"))
        })
    }
}

impl ModelRenderer {
    /// Renders one layer; a layer of one channel is repeated in all three.
    ///
    /// # Errors
    /// The model has no such layer, or the device is out of memory or lost.
    pub fn layer(&mut self, camera: &Camera, layer: RenderLayer) -> Result<Image> {
        let lacks =
            || Error::Usage(format!("the model has no {}; {}", layer.name(), self.layers()));
        let Camera { width, height, .. } = *camera;
        let repeated = |plane: Vec<f32>| Image { width, height, data: plane.repeat(3) };
        let feature = match layer {
            RenderLayer::Rgb => return Ok(self.render_camera(camera)?.colors),
            RenderLayer::Denoised => {
                let lacks = lacks();
                return self.render_camera(camera)?.denoised.ok_or(lacks);
            }
            RenderLayer::Depth => return self.depths(camera).map(repeated),
            RenderLayer::Normal => return self.normals(camera),
            RenderLayer::Alpha | RenderLayer::Transmittance => {
                let lacks = lacks();
                let mut plane = self.render_camera(camera)?.transmittances.ok_or(lacks)?;
                if layer == RenderLayer::Alpha {
                    plane.iter_mut().for_each(|value| *value = 1.0 - *value);
                }
                return Ok(repeated(plane));
            }
            RenderLayer::DepthFeature => Feature::Depth,
            RenderLayer::Structure => Feature::Structure,
            RenderLayer::Illumination => Feature::Illumination,
            RenderLayer::Noise => Feature::Noise,
        };
        let planes = self.shape().features.channels_of(feature).ok_or_else(lacks)?;
        let pixels = width as usize * height as usize;
        let (camera, options) = (&self.frame.camera(camera), self.options());
        self.renderer.reserve(self.gaussians.layout.count, [camera])?;
        let channels = self.renderer.render_channels(&self.gaussians, camera, &options)?;
        let plane = |c: usize| {
            let plane = planes.start + c.min(planes.len() - 1);
            channels[plane * pixels..][..pixels].iter().copied()
        };
        Ok(Image { width, height, data: (0..3).flat_map(plane).collect() })
    }

    /// The median depth of each pixel in world units, (H, W).
    fn depths(&mut self, camera: &Camera) -> Result<Vec<f32>> {
        let (framed, options) = (self.frame.camera(camera), self.options());
        let mut depths = self.renderer.render_depths(&self.gaussians, &framed, &options)?;
        let scale = self.frame.scale as f32;
        depths.iter_mut().for_each(|depth| *depth /= scale);
        Ok(depths)
    }

    fn normals(&mut self, camera: &Camera) -> Result<Image> {
        if self.normals.is_none() {
            let gaussians = self.gaussians.download(&self.gpu)?;
            self.normals = Some(Normals::new(&self.gpu, &gaussians, self.renderer.settings())?);
        }
        let framed = self.frame.camera(camera);
        match &mut self.normals {
            Some(normals) => normals.render(&self.gpu, &framed),
            None => Err(Error::Usage("the model has no normals".to_owned())),
        }
    }

    /// The layers that the model has, for a message.
    fn layers(&self) -> String {
        let denoised = self.networks.as_ref().is_some_and(Networks::has_denoiser);
        let features = self.shape().features.specs().map(|spec| match spec.feature {
            Feature::Depth => RenderLayer::DepthFeature.name(),
            _ => spec.name,
        });
        let of_any = ["rgb", "depth", "normal", "alpha", "transmittance"];
        let names: Vec<&str> =
            of_any.into_iter().chain(denoised.then_some("denoised")).chain(features).collect();
        format!("it has {}", names.join(", "))
    }
}

/// Renders normals as colours: a Gaussian is a disc, whose normal is its shortest axis, on the side of the camera.
#[derive(Debug)]
pub(super) struct Normals {
    /// Without SH and features; their colours are set for each view.
    gaussians: Gaussians,
    /// The shortest axes, unit vectors.
    axes: Vec<DVec3>,
    renderer: Renderer,
}

impl Normals {
    fn new(gpu: &Gpu, gaussians: &Gaussians, settings: &RenderSettings) -> Result<Self> {
        let gaussians = gaussians.with_features(Features::NONE).with_sh_degree(0);
        let axis = |(quat, scales): (&[f32; 4], &Vec3)| {
            let [w, x, y, z] = quat.map(f64::from);
            let turn = DQuat::from_xyzw(x, y, z, w);
            let turn = if turn.length_squared() > 0.0 { turn.normalize() } else { DQuat::IDENTITY };
            turn * DVec3::AXES[scales.min_position()]
        };
        let axes = gaussians.quats().iter().zip(gaussians.log_scales()).map(axis).collect();
        let settings = RenderSettings { shape: 0.into(), raw_colors: true, ..*settings };
        Ok(Self { axes, renderer: Renderer::new(gpu, settings)?, gaussians })
    }

    fn render(&mut self, gpu: &Gpu, camera: &Camera) -> Result<Image> {
        let Self { gaussians, axes, renderer } = self;
        let (center, to_view) = (camera.center(), camera.view_from_world.matrix3);
        let facing: Vec<Vec3> = gaussians
            .means()
            .iter()
            .zip(axes.iter())
            .map(|(mean, axis)| {
                let facing_camera =
                    if axis.dot(mean.as_dvec3() - center) > 0.0 { -*axis } else { *axis };
                let DVec3 { x, y, z } = to_view * facing_camera;
                DVec3::new(x, -y, -z).as_vec3() / SH_C0
            })
            .collect();
        gaussians.dc_mut().copy_from_slice(&facing);
        let on_device = gaussians.upload(gpu)?;
        let options = RenderOptions { sh_degree: 0, background: [0.0; 3] };
        renderer.reserve(gaussians.count, [camera])?;
        let mut image = renderer.render_image(&on_device, camera, &options)?;
        let pixels = image.pixel_count();
        for pixel in 0..pixels {
            let sum = [0, 1, 2].map(|plane| image.data[plane * pixels + pixel]);
            let unit = Vec3::from_array(sum).normalize_or_zero().to_array();
            (0..3).for_each(|plane| image.data[plane * pixels + pixel] = unit[plane]);
        }
        Ok(image)
    }
}
