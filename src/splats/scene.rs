//! The scene: 3D Gaussians on the host.

use std::ops::Range;

use glam::{DVec3, Vec3};

use crate::Result;

mod features;
#[cfg(feature = "io")]
pub mod init;
#[cfg(feature = "io")]
mod neighbours;
pub mod ply;

use crate::camera::Frame;
use crate::gpu::{Buffer, Gpu};
pub use crate::splats::attributes::{ATTRIBUTES, Attribute, rest_coefficients};
use crate::splats::attributes::{column_count, planes};
use crate::splats::batches::Batches;
pub use features::{COLOR_CHANNELS, FEATURES, Feature, FeatureSpec, Features};

pub use crate::kernels::sh::MAX_SH_DEGREE;

/// The constant basis function of the spherical harmonics, to eight digits: an ulp below the shaders'.
pub const SH_C0: f32 = 0.282_094_79;

/// What the Gaussians of a scene are made of, beside the ellipsoid and its opacity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// The SH degree that there is room for, 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u32,
    /// What is blended beside colour.
    pub features: Features,
}

/// Colour alone.
impl Shape {
    /// Whether Gaussians of `other` are Gaussians of this shape without its highest SH degrees.
    pub fn holds(self, other: Self) -> bool {
        self.features == other.features && other.sh_degree <= self.sh_degree
    }
}

impl From<u32> for Shape {
    fn from(sh_degree: u32) -> Self {
        Self { sh_degree, features: Features::NONE }
    }
}

/// Floats per Gaussian, all attributes together.
pub fn width(shape: impl Into<Shape>) -> usize {
    let Shape { sh_degree, features } = shape.into();
    column_count(features.width(), sh_degree)
}

/// 3D Gaussians, stored as planes: all means, then all quats, and so on in the order of [`ATTRIBUTES`].
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussians {
    /// The number of Gaussians.
    pub count: usize,
    /// What they are made of.
    pub shape: Shape,
    /// `count * width(shape)` floats.
    pub parameters: Vec<f32>,
}

impl Gaussians {
    /// `count` Gaussians with every parameter zero.
    pub fn zeros(count: usize, shape: impl Into<Shape>) -> Self {
        let shape = shape.into();
        Self { count, shape, parameters: vec![0.0; count * width(shape)] }
    }

    /// A copy on the device, planes in [`Batches`]: what a [`Renderer`](crate::splats::render::Renderer) takes.
    ///
    /// # Errors
    /// The device is out of memory or lost.
    pub fn upload(&self, gpu: &Gpu) -> Result<Buffer<f32>> {
        let columns = [width(self.shape), self.shape.features.width()];
        Batches::new(gpu, self.count, columns).upload(gpu, "parameters", &self.parameters)
    }

    /// Where an attribute lies in [`Gaussians::parameters`].
    pub fn plane(&self, attribute: Attribute) -> Range<usize> {
        let (column, width) = self.columns(attribute);
        column * self.count..(column + width) * self.count
    }

    /// First column and width of an attribute.
    fn columns(&self, attribute: Attribute) -> (usize, usize) {
        planes(self.shape.features.width(), width(self.shape))[attribute as usize]
    }

    /// The same Gaussians out of a frame, relative to an origin in the world: [`Frame::file_origin`] where f32 is to hold
    /// them.
    pub fn to_world(&self, frame: &Frame, origin: DVec3) -> Self {
        let offset = DVec3::from_array(frame.center) - origin;
        self.moved(|mean| (mean / frame.scale + offset).as_vec3(), -frame.scale.ln())
    }

    /// Back into the frame: what [`Gaussians::to_world`] gave.
    pub fn from_world(&self, frame: &Frame, origin: DVec3) -> Self {
        let offset = DVec3::from_array(frame.center) - origin;
        self.moved(|mean| ((mean - offset) * frame.scale).as_vec3(), frame.scale.ln())
    }

    /// The same with room for another SH degree: coefficients that come are zero, those beyond it go.
    pub fn with_sh_degree(&self, sh_degree: u32) -> Self {
        let mut other = Self::zeros(self.count, Shape { sh_degree, ..self.shape });
        let before = self.plane(Attribute::Rest).start;
        other.parameters[..before].copy_from_slice(&self.parameters[..before]);
        let [own, new] = [self.shape.sh_degree, sh_degree].map(rest_coefficients);
        let kept = own.min(new);
        let pairs = other.rest_mut().chunks_mut(new.max(1)).zip(self.rest().chunks(own.max(1)));
        pairs.for_each(|(new, own)| new[..kept].copy_from_slice(&own[..kept]));
        other
    }

    /// The least SH degree that there has to be room for.
    #[cfg(feature = "io")]
    pub(crate) fn sh_degree_in_use(&self) -> u32 {
        let own = rest_coefficients(self.shape.sh_degree);
        let used = |rest: &[Vec3]| rest.iter().rposition(|c| *c != Vec3::ZERO).map_or(0, |k| k + 1);
        let used = self.rest().chunks(own.max(1)).map(used).max().unwrap_or_default();
        (0..=self.shape.sh_degree)
            .find(|&degree| rest_coefficients(degree) >= used)
            .unwrap_or_default()
    }

    fn moved(&self, position: impl Fn(DVec3) -> Vec3, log_scale: f64) -> Self {
        let mut moved = self.clone();
        for mean in moved.means_mut() {
            *mean = position(mean.as_dvec3());
        }
        for scale in moved.log_scales_mut() {
            *scale = (scale.as_dvec3() + log_scale).as_vec3();
        }
        moved
    }

    /// Adds a constant to the colour from every direction.
    pub fn shift_colors(&mut self, by: f32) {
        for dc in self.dc_mut() {
            *dc += by / SH_C0;
        }
    }
}

/// One way in and one way out of every plane, as the elements it is made of.
macro_rules! accessors {
    ($($(#[$doc:meta])* $attribute:ident: $read:ident, $write:ident -> $element:ty,)*) => {
        impl Gaussians {$(
            $(#[$doc])*
            pub fn $read(&self) -> &[$element] {
                bytemuck::cast_slice(&self.parameters[self.plane(Attribute::$attribute)])
            }

            $(#[$doc])*
            pub fn $write(&mut self) -> &mut [$element] {
                let plane = self.plane(Attribute::$attribute);
                bytemuck::cast_slice_mut(&mut self.parameters[plane])
            }
        )*}
    };
}

accessors! {
    /// Positions in the world, (count).
    Means: means, means_mut -> Vec3,
    /// Rotations (w, x, y, z), not normalised, (count).
    Quats: quats, quats_mut -> [f32; 4],
    /// Natural logarithms of the standard deviations, (count).
    LogScales: log_scales, log_scales_mut -> Vec3,
    /// Opacities before the sigmoid, (count).
    RawOpacities: raw_opacities, raw_opacities_mut -> f32,
    /// SH coefficients of degree 0, RGB, (count).
    Dc: dc, dc_mut -> Vec3,
    /// What is blended beside colour, (count, features).
    Features: features, features_mut -> f32,
    /// SH coefficients above degree 0, RGB, (count, [`rest_coefficients`]).
    Rest: rest, rest_mut -> Vec3,
}
