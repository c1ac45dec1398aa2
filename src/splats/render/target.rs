//! What a draw goes into: images of a host, and what each of their formats means.

use std::fmt::Debug;

use glam::Vec3;
use nightsplat_core::camera::{Camera, CameraModel, Patch, deviation_from_rigid};
use nightsplat_core::curves::SceneLaw;

use super::eyes::check_axes;
use crate::gpu::{HostImage, ImageFormat, ImageState};
use crate::kernels::pixels::{
    DEPTH_16, DEPTH_24, DEPTH_FLOAT, LIGHT_DISPLAY, LIGHT_HDR10, LIGHT_LINEAR, LIGHT_SRGB,
    STORED_BYTES, STORED_FLOATS, STORED_HALVES, STORED_SMALL_FLOATS, STORED_TENS,
};
use crate::kernels::{depth_limits, pack_pixels};
use crate::{Error, Result};

/// The images of a draw. Camera `i` is drawn into layer `layer + i` of each.
///
/// The format of the colour image says what its values are: linear light in `Float` formats and in those with an sRGB
/// encoding, the display-referred values of the model in `Unorm` formats, or HDR10 in those of ten bits. Colour is
/// premultiplied by alpha, which is one minus the transmittance.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a> {
    /// RGBA16F, RGBA32F, B10G11R11, RGBA8 or BGRA8 as `Unorm` or `Srgb`, A2B10G10R10 or A2R10G10B10.
    pub color: Option<&'a HostImage>,
    /// Depth as R32F, D32 or D32 with stencil. It may be the image of `scene`, which then gets the splats' depths where
    /// they are seen, and keeps its own elsewhere.
    pub depth: Option<&'a HostImage>,
    /// The kind of depth in `depth`.
    pub depth_kind: DepthKind,
    /// The meaning of the values of `depth`; where there is no splat, [`DepthConvention::Linear`] is infinite, and
    /// others are at the far plane.
    pub depth_convention: DepthConvention,
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
    /// An image of ten bits is HDR10: in the primaries of BT.2020, by the curve of ST 2084, where linear light 1 has
    /// this luminance in nits, at most 10 000. `None`: display-referred values.
    pub hdr10_nits: Option<f32>,
    /// Where each pixel's point was in the frame before.
    pub motion: Option<Motion<'a>>,
    /// A pixel of the first camera, column and row, of which [`Renderer::picked`](crate::Renderer::picked) tells what
    /// is there once the frame is done.
    pub pick: Option<[u32; 2]>,
    /// The most intersections of splats and tiles, of which the farthest are left out first; 0: as memory allows.
    pub budget: u32,
    /// All cameras have one sort, by the depth along the mean of their axes: pinholes or orthographic, which look at
    /// most 30 degrees beside it. Where their axes are parallel, as those of most headsets are, the pictures are the
    /// same; else two splats may change their order in a pixel that both cover, where their depths differ by less than
    /// the tangent of the angle between axis and mean, times the distance of their centres across it.
    pub shares_sort: bool,
}

impl Default for Target<'_> {
    fn default() -> Self {
        Self {
            color: None,
            depth: None,
            depth_kind: DepthKind::Median,
            depth_convention: DepthConvention::Linear,
            scene: None,
            is_over: false,
            is_display_referred: false,
            is_photograph: false,
            exposure: 1.0,
            hdr10_nits: None,
            motion: None,
            pick: None,
            budget: 0,
            shares_sort: false,
        }
    }
}

/// Motion vectors: from each pixel to where its point was seen in the frame before, in pixels, x right and y down. The
/// point is at the depth of [`Target::depth_kind`], and moves with the camera and with the instance of the Gaussian at
/// which half of the light is blocked ([`Instance::before`](crate::Instance::before)). Where no splat is, it is
/// infinitely far.
#[derive(Clone, Copy, Debug)]
pub struct Motion<'a> {
    /// RG16F or RG32F.
    pub image: &'a HostImage,
    /// The cameras of the frame before, one for each of the draw's and of its size: pinholes, or orthographic both.
    /// With the principal point of this frame's, a jitter is left out.
    pub before: &'a [Camera],
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
    ImageFormat::Rgba32Float,
    ImageFormat::B10G11R11Float,
    ImageFormat::Rgba8Unorm,
    ImageFormat::Rgba8Srgb,
    ImageFormat::Bgra8Unorm,
    ImageFormat::Bgra8Srgb,
    ImageFormat::A2B10G10R10Unorm,
    ImageFormat::A2R10G10B10Unorm,
];
const DEPTH_FORMATS: &[ImageFormat] =
    &[ImageFormat::R32Float, ImageFormat::D32Float, ImageFormat::D32FloatS8];
const MOTION_FORMATS: &[ImageFormat] = &[ImageFormat::Rg16Float, ImageFormat::Rg32Float];
/// The most that ST 2084 encodes.
const MOST_NITS: f32 = pack_pixels::PQ_NITS as f32;
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
        let is_used = self.motion.is_some() || self.pick.is_some();
        is_used || self.depth.is_some() || self.scene.is_some()
    }

    /// Whether these cameras share a sort.
    pub(super) fn has_one_sort(&self, cameras: &[Camera]) -> bool {
        self.shares_sort && cameras.len() > 1
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
        let images = [self.color, self.depth, self.motion.map(|motion| motion.image)];
        if images.iter().all(Option::is_none) && self.pick.is_none() {
            return refused(
                "no target: pass a color, depth or motion image, or a pixel to pick".to_owned(),
            );
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
        if self.has_one_sort(cameras) {
            check_axes(cameras)?;
        }
        check_image("color", self.color, COLOR_FORMATS, cameras)?;
        self.check_hdr10()?;
        check_image("depth", self.depth, DEPTH_FORMATS, cameras)?;
        self.check_depth(cameras)?;
        self.check_motion(cameras)?;
        if let Some(pixel) =
            self.pick.filter(|[x, y]| *x >= cameras[0].width || *y >= cameras[0].height)
        {
            let Camera { width, height, .. } = cameras[0];
            return refused(format!("the picked pixel {pixel:?} is outside of {width}x{height}"));
        }
        let Some(scene) = &self.scene else { return Ok(()) };
        check_image("scene depth", Some(scene.image), SCENE_FORMATS, cameras)?;
        scene.check(cameras)?;
        if self.color.is_some_and(|image| image.handle == scene.image.handle) {
            return refused("the scene depth is the color image as well".to_owned());
        }
        let is_same = |depth: &HostImage| {
            (depth.layer, depth.format) == (scene.image.layer, scene.image.format)
                && self.depth_convention == scene.convention
        };
        match self.depth.filter(|depth| depth.handle == scene.image.handle) {
            Some(depth) if !is_same(depth) => refused(
                "the scene depth is the depth image as well, with another layer, format or convention"
                    .to_owned(),
            ),
            _ => Ok(()),
        }
    }

    fn check_hdr10(&self) -> Result<()> {
        let Some(nits) = self.hdr10_nits else { return Ok(()) };
        if !(nits > 0.0 && nits <= MOST_NITS) {
            return refused(format!(
                "hdr10_nits is {nits}; it is positive and at most {MOST_NITS}"
            ));
        }
        match self.color {
            Some(image) if Self::stored(image.format) != STORED_TENS => refused(format!(
                "HDR10 in a color image of format {:?}; take A2B10G10R10Unorm or A2R10G10B10Unorm",
                image.format
            )),
            _ => Ok(()),
        }
    }

    fn check_motion(&self, cameras: &[Camera]) -> Result<()> {
        let Some(Motion { image, before }) = self.motion else { return Ok(()) };
        check_image("motion", Some(image), MOTION_FORMATS, cameras)?;
        if before.len() != cameras.len() {
            let [now, before] = [cameras.len(), before.len()];
            return refused(format!("{now} cameras, and {before} of the frame before"));
        }
        for (index, (camera, before)) in cameras.iter().zip(before).enumerate() {
            check_camera(index, before)?;
            let as_before = |camera: &Camera| (camera.width, camera.height, camera.model);
            if as_before(camera) != as_before(before)
                || matches!(camera.model, CameraModel::Fisheye(_))
            {
                return refused(format!(
                    "motion of camera {index}: it and the one before have one size, and are pinholes or orthographic"
                ));
            }
        }
        Ok(())
    }

    fn check_depth(&self, cameras: &[Camera]) -> Result<()> {
        let Some(image) = self.depth else { return Ok(()) };
        if image.format != ImageFormat::R32Float && self.depth_convention == DepthConvention::Linear
        {
            return refused(format!(
                "linear depth out in {:?}, which holds 0 to 1; state your projection, or take R32Float",
                image.format
            ));
        }
        self.depth_convention.check("depth", cameras)
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
    if image.after.layout == ImageState::UNDEFINED.layout {
        return refused(format!("the {name} image has no layout after the render; state one"));
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
        let focal = focal.to_array();
        return refused(format!(
            "camera {index} has focal length {focal:?}; it is positive and at most {MOST_PIXELS:e}"
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
    fn check(&self, cameras: &[Camera]) -> Result<()> {
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
            convention => convention.check("scene", cameras),
        }
    }

    /// How the kernel reads it.
    pub(super) fn limits(&self, camera: &Camera) -> depth_limits::Params {
        let format = match self.image.format {
            ImageFormat::D16Unorm => DEPTH_16,
            ImageFormat::D24UnormX8 | ImageFormat::D24UnormS8 => DEPTH_24,
            _ => DEPTH_FLOAT,
        };
        let planes = self.convention.planes();
        depth_limits::Params {
            pixel_count: Patch::from(camera).pixel_count() as u32,
            format,
            is_reversed: planes.is_reversed.into(),
            is_linear: planes.is_linear.into(),
            is_orthographic: (camera.model == CameraModel::Orthographic).into(),
            near: planes.near,
            far: planes.far,
        }
    }
}

/// A convention as kernels take it.
struct DepthPlanes {
    is_linear: bool,
    is_reversed: bool,
    near: f32,
    /// 0: infinite.
    far: f32,
}

impl DepthConvention {
    fn planes(self) -> DepthPlanes {
        let (near, far) = match self {
            Self::Linear => (1.0, None),
            Self::Forward { near, far } | Self::Reversed { near, far } => (near, far),
        };
        DepthPlanes {
            is_linear: self == Self::Linear,
            is_reversed: matches!(self, Self::Reversed { .. }),
            near,
            far: far.unwrap_or_default(),
        }
    }

    /// `whose` image it is of.
    fn check(self, whose: &str, cameras: &[Camera]) -> Result<()> {
        let (Self::Forward { near, far } | Self::Reversed { near, far }) = self else {
            return Ok(());
        };
        let is_beyond = far.is_none_or(|far| far.is_finite() && far > near);
        let mut models = cameras.iter().map(|camera| camera.model);
        if far.is_none() && models.any(|model| model == CameraModel::Orthographic) {
            return refused(format!(
                "the {whose}'s far plane is infinite, and a camera is orthographic; state its far plane"
            ));
        }
        if near.is_finite() && near > 0.0 && is_beyond {
            return Ok(());
        }
        refused(format!(
            "the {whose}'s near plane is {near} and its far plane {far:?}; 0 < near < far"
        ))
    }
}

impl Target<'_> {
    /// How the kernel packs pixels.
    pub(super) fn packing(
        &self,
        camera: &Camera,
        background: [f32; 3],
        depth_plane: u32,
    ) -> pack_pixels::Params {
        let format = self.color.map_or(ImageFormat::Rgba16Float, |image| image.format);
        let planes = self.depth_convention.planes();
        let swaps = matches!(
            format,
            ImageFormat::Bgra8Unorm | ImageFormat::Bgra8Srgb | ImageFormat::A2R10G10B10Unorm
        );
        pack_pixels::Params {
            pixel_count: Patch::from(camera).pixel_count() as u32,
            storage: Self::stored(format),
            light: self.light(format),
            swaps: swaps.into(),
            is_over: self.is_over.into(),
            exposure: self.exposure,
            nits: self.hdr10_nits.unwrap_or(1.0),
            background: self.counted(background, self.light(format)),
            depth_plane,
            is_mean: (self.depth_kind == DepthKind::Expected).into(),
            is_linear_depth: planes.is_linear.into(),
            is_reversed: planes.is_reversed.into(),
            is_orthographic: (camera.model == CameraModel::Orthographic).into(),
            near: planes.near,
            far: planes.far,
            has_scene: self.merges_depth().into(),
            has_color: self.color.is_some().into(),
        }
    }

    /// Whether the depth goes into the scene's image.
    pub(super) fn merges_depth(&self) -> bool {
        let [depth, scene] = [self.depth, self.scene.map(|scene| scene.image)]
            .map(|image| image.map(|image| image.handle));
        depth.is_some() && depth == scene
    }

    /// A display-referred colour as the colour image counts it: linear light with its exposure, or itself.
    fn counted(&self, color: [f32; 3], light: u32) -> Vec3 {
        let of_linear = |c: f64| {
            let curved = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
            (curved * f64::from(self.exposure)) as f32
        };
        let is_linear = light != LIGHT_DISPLAY;
        let channel = |c: f32| if is_linear { of_linear(c.max(0.0).into()) } else { c };
        color.map(channel).into()
    }

    /// How the kernel stores pixels of a format.
    fn stored(format: ImageFormat) -> u32 {
        match format {
            ImageFormat::Rgba32Float => STORED_FLOATS,
            ImageFormat::B10G11R11Float => STORED_SMALL_FLOATS,
            ImageFormat::Rgba8Unorm
            | ImageFormat::Rgba8Srgb
            | ImageFormat::Bgra8Unorm
            | ImageFormat::Bgra8Srgb => STORED_BYTES,
            ImageFormat::A2B10G10R10Unorm | ImageFormat::A2R10G10B10Unorm => STORED_TENS,
            _ => STORED_HALVES,
        }
    }

    /// What the colours of a format are.
    fn light(&self, format: ImageFormat) -> u32 {
        match format {
            ImageFormat::Rgba8Srgb | ImageFormat::Bgra8Srgb => LIGHT_SRGB,
            ImageFormat::Rgba8Unorm | ImageFormat::Bgra8Unorm => LIGHT_DISPLAY,
            ImageFormat::A2B10G10R10Unorm | ImageFormat::A2R10G10B10Unorm => {
                self.hdr10_nits.map_or(LIGHT_DISPLAY, |_| LIGHT_HDR10)
            }
            _ if self.is_display_referred => LIGHT_DISPLAY,
            _ => LIGHT_LINEAR,
        }
    }
}
