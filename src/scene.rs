//! The scene: 3D Gaussians on the host, and the one table of their attributes.

use std::ops::Range;

use glam::Vec3;

mod features;
pub mod init;
mod neighbours;
pub mod ply;

pub use features::{COLOR_CHANNELS, FEATURES, Feature, FeatureSpec, Features};

pub use crate::kernels::sh::MAX_SH_DEGREE;

/// The constant basis function of the spherical harmonics.
pub const SH_C0: f32 = crate::kernels::sh::SH_C0 as f32;

/// Something that every Gaussian has; the order is that of the planes in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attribute {
    /// Position in the world.
    Means,
    /// Rotation, (w, x, y, z), not normalised.
    Quats,
    /// Natural logarithms of the standard deviations along the rotated axes.
    LogScales,
    /// Opacity before the sigmoid.
    RawOpacities,
    /// SH coefficients of degree 0, RGB; the colour is 0.5 + [`SH_C0`] times this.
    Dc,
    /// What is blended beside colour, in the order of [`FEATURES`].
    Features,
    /// SH coefficients above degree 0, coefficient-major, RGB.
    Rest,
}

/// All that is to know about one attribute.
#[derive(Debug)]
pub struct AttributeSpec {
    /// Which attribute this row describes.
    pub attribute: Attribute,
    /// The name used in logs, buffers and timings.
    pub name: &'static str,
    /// Floats per Gaussian.
    pub width: fn(Shape) -> usize,
    /// Adam's initial learning rate (3DGS's `OptimizationParams`).
    pub learning_rate: f64,
    /// Whether the learning rate is multiplied by the extent of the cameras.
    pub scales_with_extent: bool,
    /// The PLY property at a position among the attribute's properties (INRIA layout).
    pub ply_property: fn(Shape, position: usize) -> String,
}

/// What the Gaussians of a scene are made of, beside the ellipsoid and its opacity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// The SH degree that there is room for, 0 to [`MAX_SH_DEGREE`].
    pub sh_degree: u32,
    /// What is blended beside colour.
    pub features: Features,
}

/// Colour alone.
impl From<u32> for Shape {
    fn from(sh_degree: u32) -> Self {
        Self { sh_degree, features: Features::NONE }
    }
}

/// The one table of attributes; `shaders-glsl/include/gaussian.glsl` is its device side.
pub const ATTRIBUTES: [AttributeSpec; 7] = [
    AttributeSpec {
        attribute: Attribute::Means,
        name: "means",
        width: |_| 3,
        learning_rate: 1.6e-4,
        scales_with_extent: true,
        ply_property: |_, position| ["x", "y", "z"][position].to_owned(),
    },
    AttributeSpec {
        attribute: Attribute::Quats,
        name: "quats",
        width: |_| 4,
        learning_rate: 1e-3,
        scales_with_extent: false,
        ply_property: |_, position| format!("rot_{position}"),
    },
    AttributeSpec {
        attribute: Attribute::LogScales,
        name: "log_scales",
        width: |_| 3,
        learning_rate: 5e-3,
        scales_with_extent: false,
        ply_property: |_, position| format!("scale_{position}"),
    },
    AttributeSpec {
        attribute: Attribute::RawOpacities,
        name: "raw_opacities",
        width: |_| 1,
        learning_rate: 0.05,
        scales_with_extent: false,
        ply_property: |_, _| "opacity".to_owned(),
    },
    AttributeSpec {
        attribute: Attribute::Dc,
        name: "dc",
        width: |_| 3,
        learning_rate: 2.5e-3,
        scales_with_extent: false,
        ply_property: |_, position| format!("f_dc_{position}"),
    },
    AttributeSpec {
        attribute: Attribute::Features,
        name: "features",
        width: |shape| shape.features.width(),
        learning_rate: 1.25e-4,
        scales_with_extent: false,
        ply_property: |shape, position| shape.features.ply_property(position),
    },
    AttributeSpec {
        attribute: Attribute::Rest,
        name: "rest",
        width: |shape| 3 * rest_coefficients(shape.sh_degree),
        learning_rate: 1.25e-4,
        scales_with_extent: false,
        ply_property: |_, position| format!("f_rest_{position}"),
    },
];

/// SH coefficients above degree 0: (degree + 1)^2 - 1.
pub const fn rest_coefficients(sh_degree: u32) -> usize {
    ((sh_degree + 1) * (sh_degree + 1) - 1) as usize
}

/// Floats per Gaussian, all attributes together.
pub fn width(shape: impl Into<Shape>) -> usize {
    let shape = shape.into();
    ATTRIBUTES.iter().map(|spec| (spec.width)(shape)).sum()
}

impl Attribute {
    /// The attribute's row of [`ATTRIBUTES`].
    pub const fn spec(self) -> &'static AttributeSpec {
        &ATTRIBUTES[self as usize]
    }

    /// The floats per Gaussian that come before this attribute: its plane begins at this times the number of
    /// Gaussians.
    pub fn column(self, shape: impl Into<Shape>) -> usize {
        let shape = shape.into();
        ATTRIBUTES[..self as usize].iter().map(|spec| (spec.width)(shape)).sum()
    }
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

    /// Where an attribute lies in [`Gaussians::parameters`].
    pub fn plane(&self, attribute: Attribute) -> Range<usize> {
        let begin = attribute.column(self.shape) * self.count;
        begin..begin + (attribute.spec().width)(self.shape) * self.count
    }

    /// Positions in the world, (count).
    pub fn means(&self) -> &[Vec3] {
        bytemuck::cast_slice(&self.parameters[self.plane(Attribute::Means)])
    }

    /// Positions in the world, (count), to change.
    pub fn means_mut(&mut self) -> &mut [Vec3] {
        let plane = self.plane(Attribute::Means);
        bytemuck::cast_slice_mut(&mut self.parameters[plane])
    }

    /// Rotations (w, x, y, z), not normalised, (count).
    pub fn quats(&self) -> &[[f32; 4]] {
        bytemuck::cast_slice(&self.parameters[self.plane(Attribute::Quats)])
    }

    /// Rotations (w, x, y, z), (count), to change.
    pub fn quats_mut(&mut self) -> &mut [[f32; 4]] {
        let plane = self.plane(Attribute::Quats);
        bytemuck::cast_slice_mut(&mut self.parameters[plane])
    }

    /// Natural logarithms of the standard deviations, (count).
    pub fn log_scales(&self) -> &[Vec3] {
        bytemuck::cast_slice(&self.parameters[self.plane(Attribute::LogScales)])
    }

    /// Natural logarithms of the standard deviations, (count), to change.
    pub fn log_scales_mut(&mut self) -> &mut [Vec3] {
        let plane = self.plane(Attribute::LogScales);
        bytemuck::cast_slice_mut(&mut self.parameters[plane])
    }

    /// Opacities before the sigmoid, (count).
    pub fn raw_opacities(&self) -> &[f32] {
        &self.parameters[self.plane(Attribute::RawOpacities)]
    }

    /// Opacities before the sigmoid, (count), to change.
    pub fn raw_opacities_mut(&mut self) -> &mut [f32] {
        let plane = self.plane(Attribute::RawOpacities);
        &mut self.parameters[plane]
    }

    /// SH coefficients of degree 0, RGB, (count).
    pub fn dc(&self) -> &[Vec3] {
        bytemuck::cast_slice(&self.parameters[self.plane(Attribute::Dc)])
    }

    /// SH coefficients of degree 0, RGB, (count), to change.
    pub fn dc_mut(&mut self) -> &mut [Vec3] {
        let plane = self.plane(Attribute::Dc);
        bytemuck::cast_slice_mut(&mut self.parameters[plane])
    }

    /// Adds a constant to the colour from every direction.
    pub fn shift_colors(&mut self, by: f32) {
        for dc in self.dc_mut() {
            *dc += by / SH_C0;
        }
    }

    /// What is blended beside colour, (count, features), to change.
    pub fn features_mut(&mut self) -> &mut [f32] {
        let plane = self.plane(Attribute::Features);
        &mut self.parameters[plane]
    }

    /// SH coefficients above degree 0, RGB, (count, [`rest_coefficients`]).
    pub fn rest(&self) -> &[Vec3] {
        bytemuck::cast_slice(&self.parameters[self.plane(Attribute::Rest)])
    }

    /// SH coefficients above degree 0, RGB, (count, [`rest_coefficients`]), to change.
    pub fn rest_mut(&mut self) -> &mut [Vec3] {
        let plane = self.plane(Attribute::Rest);
        bytemuck::cast_slice_mut(&mut self.parameters[plane])
    }
}
