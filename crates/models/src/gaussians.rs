//! 3D Gaussians on the host.

use std::fmt;
use std::ops::Range;

use glam::{DMat3, DQuat, DVec3, Vec3};
use nightsplat_core::camera::TrainingFrame;
use nightsplat_core::{Error, Result};
use rayon::prelude::*;

mod change;
mod facts;
mod features;
#[cfg(feature = "train")]
pub mod init;
mod neighbours;
pub mod ply;

pub use crate::attributes::{ATTRIBUTES, Attribute, PlaneCounts, rest_coefficients};
use crate::attributes::{AttributePlane, column_count, planes};
use crate::harmonics::HarmonicRotation;
pub use change::{Lengths, is_far};
pub use facts::ModelFacts;
pub use features::{COLOR_CHANNELS, FEATURES, Feature, FeatureSpec, Features};

/// The highest degree of spherical harmonics.
pub const MAX_SH_DEGREE: u32 = 3;

/// The bounds of log scales: with the largest, the determinant of a projected covariance is finite at the near plane.
pub const LOG_SCALE_MIN: f64 = -30.0;
/// The largest of them.
pub const LOG_SCALE_MAX: f64 = 13.0;

/// The constant basis function of the spherical harmonics, to eight digits: an ulp below the shaders'.
pub const SH_C0: f32 = 0.282_094_79;

/// The attributes of a scene's Gaussians in addition to ellipsoid and opacity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shape {
    /// The SH degree with allocated coefficients, 0 to 3.
    pub sh_degree: u32,
    /// Blended values in addition to colour.
    pub features: Features,
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sh_degree, features } = self;
        write!(f, "SH degree {sh_degree}")?;
        let names: Vec<&str> = features.specs().map(|spec| spec.name).collect();
        if names.is_empty() { Ok(()) } else { write!(f, " with {}", names.join(", ")) }
    }
}

#[doc(hidden)]
impl Shape {
    /// Whether Gaussians of `other` are Gaussians of this shape without its highest SH degrees.
    pub fn holds(self, other: Self) -> bool {
        self.features == other.features && other.sh_degree <= self.sh_degree
    }
}

/// Colour alone.
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

/// 3D Gaussians, stored as planes: all means, then all quats, and so on in the order of `ATTRIBUTES`.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussians {
    /// The number of Gaussians.
    pub count: usize,
    /// Their attributes.
    pub shape: Shape,
    /// `count * width(shape)` floats.
    pub parameters: Vec<f32>,
    /// The world position that the means are relative to: f32 is too coarse for positions far from the world's own
    /// origin.
    pub origin: DVec3,
}

impl Gaussians {
    /// `count` Gaussians with every parameter zero.
    pub fn zeros(count: usize, shape: impl Into<Shape>) -> Self {
        let shape = shape.into();
        Self { count, shape, parameters: vec![0.0; count * width(shape)], origin: DVec3::ZERO }
    }

    /// [`Gaussians::zeros`] of a count from outside.
    ///
    /// # Errors
    /// The host is out of memory.
    #[doc(hidden)]
    pub fn try_zeros(count: usize, shape: impl Into<Shape>) -> Result<Self> {
        let shape = shape.into();
        let floats = count.saturating_mul(width(shape));
        let mut parameters = vec![];
        parameters.try_reserve_exact(floats).map_err(|cause| Error::OutOfMemory {
            buffer: "parameters".to_owned(),
            bytes: floats.saturating_mul(size_of::<f32>()) as u64,
            source: cause.into(),
        })?;
        parameters.resize(floats, 0.0);
        Ok(Self { count, shape, parameters, origin: DVec3::ZERO })
    }

    /// The range of an attribute in [`Gaussians::parameters`].
    #[doc(hidden)]
    pub fn plane(&self, attribute: Attribute) -> Range<usize> {
        let AttributePlane { column, width, .. } = self.columns(attribute);
        column * self.count..(column + width) * self.count
    }

    /// The columns of an attribute.
    fn columns(&self, attribute: Attribute) -> AttributePlane {
        planes(self.shape.features.width(), width(self.shape))[attribute as usize]
    }

    /// The Gaussians transformed from the training frame to the world, relative to an origin that f32 can represent:
    /// [`TrainingFrame::file_origin`].
    #[doc(hidden)]
    pub fn to_world(&self, frame: &TrainingFrame) -> Self {
        let origin = frame.file_origin();
        if *frame == TrainingFrame::WORLD {
            return self.clone();
        }
        let offset = DVec3::from_array(frame.center) - origin;
        let position = |mean: DVec3| (mean / frame.scale + offset).as_vec3();
        Self { origin, ..self.moved(position, -frame.scale.ln()) }
    }

    /// Gaussians of the world in the training frame: the inverse of [`Gaussians::to_world`].
    #[doc(hidden)]
    pub fn to_frame(&self, frame: &TrainingFrame) -> Self {
        if *frame == TrainingFrame::WORLD && self.origin == DVec3::ZERO {
            return self.clone();
        }
        let offset = DVec3::from_array(frame.center) - self.origin;
        let position = |mean: DVec3| ((mean - offset) * frame.scale).as_vec3();
        Self { origin: DVec3::ZERO, ..self.moved(position, frame.scale.ln()) }
    }

    /// The Gaussians with another SH degree: new coefficients are zero, those beyond it are dropped.
    pub fn with_sh_degree(&self, sh_degree: u32) -> Self {
        let mut other = Self::zeros(self.count, Shape { sh_degree, ..self.shape });
        other.origin = self.origin;
        let before = self.plane(Attribute::Rest).start;
        other.parameters[..before].copy_from_slice(&self.parameters[..before]);
        let [old, new] = [self.shape.sh_degree, sh_degree].map(rest_coefficients);
        let kept = old.min(new);
        let pairs = other.rest_mut().chunks_mut(new.max(1)).zip(self.rest().chunks(old.max(1)));
        pairs.for_each(|(new, old)| new[..kept].copy_from_slice(&old[..kept]));
        other
    }

    /// The Gaussians with these features: new ones are zero, others are dropped.
    #[doc(hidden)]
    pub fn with_features(&self, features: Features) -> Self {
        let mut other = Self::zeros(self.count, Shape { features, ..self.shape });
        other.origin = self.origin;
        let kept = |attribute: &Attribute| *attribute != Attribute::Features;
        for attribute in ATTRIBUTES.iter().map(|spec| spec.attribute).filter(kept) {
            let plane = other.plane(attribute);
            other.parameters[plane].copy_from_slice(&self.parameters[self.plane(attribute)]);
        }
        let [old, new] = [self.shape.features, features].map(Features::width);
        for feature in FEATURES.iter().map(|spec| spec.feature) {
            let channels = [self.shape.features, features].map(|all| all.channels_of(feature));
            let [Some(from), Some(to)] = channels else { continue };
            let [from, to] = [from, to].map(|c| c.start - COLOR_CHANNELS..c.end - COLOR_CHANNELS);
            let rows = other.features_mut().chunks_exact_mut(new);
            rows.zip(self.features().chunks_exact(old)).for_each(|(new, old)| {
                new[to.clone()].copy_from_slice(&old[from.clone()]);
            });
        }
        other
    }

    /// The lowest SH degree that includes all nonzero coefficients.
    #[doc(hidden)]
    pub fn sh_degree_in_use(&self) -> u32 {
        let stored = rest_coefficients(self.shape.sh_degree);
        let used = |rest: &[Vec3]| rest.iter().rposition(|c| *c != Vec3::ZERO).map_or(0, |k| k + 1);
        let used = self.rest().chunks(stored.max(1)).map(used).max().unwrap_or_default();
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

    /// The model in a world that is rotated about its origin: direction `d` becomes `rotation * d`.
    ///
    /// [`Gaussians::save`] assumes the up direction -y, as for level cameras with `OpenCV`'s axes; rotate a model with
    /// another `up` by `DQuat::from_rotation_arc(up, DVec3::NEG_Y)` first.
    pub fn rotated(&self, rotation: DQuat) -> Self {
        let mut rotated = self.clone();
        rotated.rotate(rotation);
        rotated
    }

    /// Rotates the world about its origin: direction `d` becomes `rotation * d`.
    #[doc(hidden)]
    pub fn rotate(&mut self, rotation: DQuat) {
        self.origin = rotation * self.origin;
        for mean in self.means_mut() {
            *mean = (rotation * mean.as_dvec3()).as_vec3();
        }
        for quat in self.quats_mut() {
            let [w, x, y, z] = quat.map(f64::from);
            let DQuat { x, y, z, w } = rotation * DQuat::from_xyzw(x, y, z, w);
            *quat = [w, x, y, z].map(|part| part as f32);
        }
        let coefficients = rest_coefficients(self.shape.sh_degree);
        if coefficients > 0 {
            let harmonics = HarmonicRotation::new(DMat3::from_quat(rotation));
            self.rest_mut()
                .par_chunks_exact_mut(coefficients)
                .for_each(|rest| harmonics.turn(rest));
        }
    }

    /// Replaces the Gaussians from `first` on by others of the same shape.
    #[doc(hidden)]
    pub fn replace(&mut self, first: usize, by: &Self) {
        for spec in &ATTRIBUTES {
            let width = self.columns(spec.attribute).width;
            let start = self.plane(spec.attribute).start + first * width;
            self.parameters[start..start + by.count * width]
                .copy_from_slice(&by.parameters[by.plane(spec.attribute)]);
        }
    }

    /// Adds a constant to the colour from every direction.
    #[doc(hidden)]
    pub fn shift_colors(&mut self, by: f32) {
        for dc in self.dc_mut() {
            *dc += by / SH_C0;
        }
    }
}

/// Accessors of every plane, with its element type.
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
    /// Positions in the world, relative to the origin, (count).
    Means: means, means_mut -> Vec3,
    /// Rotations (w, x, y, z), not normalised, (count).
    Quats: quats, quats_mut -> [f32; 4],
    /// Natural logarithms of the standard deviations, (count).
    LogScales: log_scales, log_scales_mut -> Vec3,
    /// Opacities before the sigmoid, (count).
    RawOpacities: raw_opacities, raw_opacities_mut -> f32,
    /// SH coefficients of degree 0, RGB, (count).
    Dc: dc, dc_mut -> Vec3,
    /// Blended values in addition to colour, (count, features).
    Features: features, features_mut -> f32,
    /// SH coefficients above degree 0, RGB, (count, (degree + 1)^2 - 1).
    Rest: rest, rest_mut -> Vec3,
}
