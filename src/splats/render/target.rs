//! What a draw goes into: images of a host, and what each of their formats means.

use std::fmt::Debug;

use glam::Vec3;
use nightsplat_core::camera::{Camera, deviation_from_rigid};
use nightsplat_core::curves::SceneLaw;

use crate::gpu::{HostImage, ImageFormat};
use crate::kernels::depth_limits;
use crate::kernels::pixels::{
    DEPTH_16, DEPTH_24, DEPTH_FLOAT, PIXELS_DISPLAY_HALF, PIXELS_LINEAR_HALF, PIXELS_SRGB,
    PIXELS_UNORM,
};
use crate::{Error, Result};

/// The images of a draw. Camera `i` is drawn into layer `layer + i` of each.
///
/// The format of the colour image says what its values are: linear light in [`ImageFormat::Rgba16Float`] and in formats
/// with an sRGB encoding, the display-referred values of the model in `Unorm` formats. Colour is premultiplied by
/// alpha, which is one minus the transmittance.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a> {
    /// RGBA16F, or RGBA8 or BGRA8 as `Unorm` or `Srgb`.
    pub color: Option<&'a HostImage>,
    /// View-space depth in world units as R32F; infinite where there is no splat.
    pub depth: Option<&'a HostImage>,
    /// The kind of depth in `depth`.
    pub depth_kind: DepthKind,
    /// The host's depth buffer, which occludes splats.
    pub scene: Option<SceneDepth<'a>>,
    /// Blends over the contents of the colour image instead of replacing them.
    pub is_over: bool,
    /// Writes display-referred values, as they were trained, to a float image; otherwise linear light.
    pub is_display_referred: bool,
    /// Colours are those of the dark photographs, by [`RenderSettings::law`](crate::RenderSettings::law): their linear
    /// light where the image is linear, else their values. The background is the host's, and stays.
    pub is_photograph: bool,
    /// The factor on linear light.
    pub exposure: f32,
    /// The most intersections of splats and tiles, of which the farthest are left out first; 0: as memory allows.
    pub budget: u32,
}

impl Default for Target<'_> {
    fn default() -> Self {
        Self {
            color: None,
            depth: None,
            depth_kind: DepthKind::Median,
            scene: None,
            is_over: false,
            is_display_referred: false,
            is_photograph: false,
            exposure: 1.0,
            budget: 0,
        }
    }
}

/// The depth of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthKind {
    /// The depth at which the transmittance falls below 1/2.
    Median,
    /// The mean of the splats' depths by their blending weights.
    Expected,
}

/// A depth image of the host's.
#[derive(Clone, Copy, Debug)]
pub struct SceneDepth<'a> {
    /// D32, D24 or D16, with or without stencil; or R32F.
    pub image: &'a HostImage,
    /// What its numbers mean.
    pub convention: DepthConvention,
}

/// The meaning of depth values; distances in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DepthConvention {
    /// 0 at the near plane, 1 at the far plane or, without one, at infinity.
    Forward {
        /// The near plane.
        near: f32,
        /// The far plane.
        far: Option<f32>,
    },
    /// 1 at the near plane, 0 at the far plane or, without one, at infinity.
    Reversed {
        /// The near plane.
        near: f32,
        /// The far plane.
        far: Option<f32>,
    },
    /// The depth in the view itself.
    Linear,
}

const COLOR_FORMATS: &[ImageFormat] = &[
    ImageFormat::Rgba16Float,
    ImageFormat::Rgba8Unorm,
    ImageFormat::Rgba8Srgb,
    ImageFormat::Bgra8Unorm,
    ImageFormat::Bgra8Srgb,
];
const SCENE_FORMATS: &[ImageFormat] = &[
    ImageFormat::D32Float,
    ImageFormat::D32FloatS8,
    ImageFormat::D24UnormX8,
    ImageFormat::D24UnormS8,
    ImageFormat::D16Unorm,
    ImageFormat::R32Float,
];

fn refused<T>(problem: String) -> Result<T> {
    Err(Error::Usage(problem))
}

impl Target<'_> {
    /// Whether the kernels keep the depth in the view.
    pub(super) fn needs_depths(&self) -> bool {
        self.depth.is_some() || self.scene.is_some()
    }

    /// Refuses a background that is not finite.
    pub(super) fn check_background(background: [f32; 3]) -> Result<()> {
        match background.iter().all(|channel| channel.is_finite()) {
            true => Ok(()),
            false => refused(format!("background is {background:?}; its channels are finite")),
        }
    }

    pub(super) fn check(&self, cameras: &[Camera], law: Option<&SceneLaw>) -> Result<()> {
        if cameras.is_empty() {
            return refused("no camera: pass at least one".to_owned());
        }
        for (index, camera) in cameras.iter().enumerate() {
            check_camera(index, camera)?;
        }
        if self.color.is_none() && self.depth.is_none() {
            return refused("no target: pass a color or a depth image".to_owned());
        }
        if !(self.exposure.is_finite() && self.exposure >= 0.0) {
            let exposure = self.exposure;
            return refused(format!("exposure is {exposure}; it is a factor of 0 or more"));
        }
        if self.is_photograph && law.is_none() {
            return refused(
                "the model states no tone law, and its photographs are unknown; train one with a named tone curve"
                    .to_owned(),
            );
        }
        check_image("color", self.color, COLOR_FORMATS, cameras)?;
        check_image("depth", self.depth, &[ImageFormat::R32Float], cameras)?;
        let Some(scene) = &self.scene else { return Ok(()) };
        check_image("scene depth", Some(scene.image), SCENE_FORMATS, cameras)?;
        scene.check()?;
        let mut written = [self.color, self.depth].into_iter().flatten();
        match written.any(|image| image.handle == scene.image.handle) {
            true => refused("the scene depth is one of the images that are written".to_owned()),
            false => Ok(()),
        }
    }
}

fn check_image(
    name: &str,
    image: Option<&HostImage>,
    formats: &[ImageFormat],
    cameras: &[Camera],
) -> Result<()> {
    let Some(image) = image else { return Ok(()) };
    if image.handle == 0 {
        return refused(format!("the {name} image is null; pass a VkImage"));
    }
    if !formats.contains(&image.format) {
        let (format, list) = (image.format, names(formats));
        return refused(format!("the {name} image has format {format:?}; take one of {list}"));
    }
    let [width, height] = image.size;
    match cameras.iter().find(|camera| camera.width > width || camera.height > height) {
        Some(camera) => refused(format!(
            "the {name} image of {width}x{height} is smaller than the camera's {}x{}",
            camera.width, camera.height
        )),
        None => Ok(()),
    }
}

fn names<T: Debug>(all: &[T]) -> String {
    all.iter().map(|format| format!("{format:?}")).collect::<Vec<_>>().join(", ")
}

/// Focal lengths and principal points beyond are mistakes, and so are positions: products of them must be finite.
const MOST_PIXELS: f64 = 1e9;
const FARTHEST: f64 = 1e15;

fn check_camera(index: usize, camera: &Camera) -> Result<()> {
    let Camera { width, height, focal, principal_point, view_from_world: pose, .. } = camera;
    if *width == 0 || *height == 0 {
        return refused(format!("camera {index} is {width}x{height}; it needs at least one pixel"));
    }
    if !(focal.is_finite() && focal.min_element() > 0.0 && focal.max_element() <= MOST_PIXELS) {
        return refused(format!(
            "camera {index} has focal length {focal}; it is positive and at most {MOST_PIXELS:e}"
        ));
    }
    let is_near = principal_point.abs().max_element() <= MOST_PIXELS
        && pose.translation.abs().max_element() <= FARTHEST;
    if !(principal_point.is_finite() && pose.is_finite() && is_near) {
        return refused(format!(
            "camera {index} has a number that is not finite, or a place beyond {FARTHEST:e}"
        ));
    }
    if let Some(off) = deviation_from_rigid(pose) {
        return refused(format!(
            "camera {index} has a pose that is not rigid, by {off:.4}; take scale and reflection out"
        ));
    }
    Ok(())
}

impl SceneDepth<'_> {
    fn check(&self) -> Result<()> {
        let is_float = |format| {
            matches!(
                format,
                ImageFormat::R32Float | ImageFormat::D32Float | ImageFormat::D32FloatS8
            )
        };
        match self.convention {
            DepthConvention::Linear if !is_float(self.image.format) => {
                refused(format!("linear depth in {:?}; take D32 or R32F", self.image.format))
            }
            DepthConvention::Linear => Ok(()),
            DepthConvention::Forward { near, far } | DepthConvention::Reversed { near, far } => {
                let is_beyond = far.is_none_or(|far| far.is_finite() && far > near);
                if near.is_finite() && near > 0.0 && is_beyond {
                    return Ok(());
                }
                refused(format!(
                    "the scene's near plane is {near} and its far plane {far:?}; 0 < near < far"
                ))
            }
        }
    }

    /// How the kernel reads it.
    pub(super) fn limits(&self, pixel_count: u32) -> depth_limits::Params {
        let format = match self.image.format {
            ImageFormat::D16Unorm => DEPTH_16,
            ImageFormat::D24UnormX8 | ImageFormat::D24UnormS8 => DEPTH_24,
            _ => DEPTH_FLOAT,
        };
        let (near, far) = match self.convention {
            DepthConvention::Linear => (1.0, None),
            DepthConvention::Forward { near, far } | DepthConvention::Reversed { near, far } => {
                (near, far)
            }
        };
        depth_limits::Params {
            pixel_count,
            format,
            is_reversed: matches!(self.convention, DepthConvention::Reversed { .. }).into(),
            is_linear: (self.convention == DepthConvention::Linear).into(),
            near,
            far: far.unwrap_or_default(),
        }
    }
}

impl Target<'_> {
    /// A display-referred colour as the colour image counts it: linear light with its exposure, or itself.
    pub(super) fn encoded(&self, color: [f32; 3]) -> Vec3 {
        let (encoding, _) = self.encoding();
        let light = |c: f64| {
            let curved = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
            (curved * f64::from(self.exposure)) as f32
        };
        let is_linear = encoding == PIXELS_LINEAR_HALF || encoding == PIXELS_SRGB;
        let channel = |c: f32| if is_linear { light(c.max(0.0).into()) } else { c };
        color.map(channel).into()
    }

    /// The encoding of the colour image, and whether blue comes first.
    pub(super) fn encoding(&self) -> (u32, bool) {
        let format = self.color.map_or(ImageFormat::Rgba16Float, |image| image.format);
        let encoding = match format {
            ImageFormat::Rgba8Unorm | ImageFormat::Bgra8Unorm => PIXELS_UNORM,
            ImageFormat::Rgba8Srgb | ImageFormat::Bgra8Srgb => PIXELS_SRGB,
            _ if self.is_display_referred => PIXELS_DISPLAY_HALF,
            _ => PIXELS_LINEAR_HALF,
        };
        (encoding, matches!(format, ImageFormat::Bgra8Unorm | ImageFormat::Bgra8Srgb))
    }
}
