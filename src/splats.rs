//! Gaussians: their memory layout, their rendering and their optimisation.
//!
//! In: points or a model file, cameras, the gradient of the loss with respect to a render. Out: renders, and updated
//! Gaussians.
//!
//! - [`packed_sh`]: storage formats, and 16-bit SH coefficients
//! - [`batches`]: buffers of Gaussians that exceed one binding
//! - [`device`]: Gaussians on the device
//! - [`model`]: a model with what a renderer must know of it
//! - [`lamp`]: a lamp that moves with the camera
//! - [`sort`]: scan and radix sort on the device
//! - [`optimizer`]: Adam, learned parameters other than the Gaussians, and learning-rate schedules
//! - [`render`]: the differentiable rasteriser
//! - [`densify`]: density control: clone, split, prune
//! - [`smoothing`]: no Gaussian smaller than training views resolve

pub mod batches;
pub(crate) mod camera;
#[cfg(feature = "train")]
pub mod densify;
pub mod device;
pub mod lamp;
pub mod model;
#[cfg(feature = "train")]
pub mod optimizer;
pub mod packed_sh;
pub mod render;
#[cfg(feature = "train")]
pub mod smoothing;
pub mod sort;

use nightsplat_models::attributes::Attribute;
use nightsplat_models::{gaussians, harmonics};

use crate::kernels;

// The host has the numbers of the shaders.
const _: () = {
    assert!(Attribute::Means.column(0) as u32 == kernels::gaussian::MEANS_COLUMN);
    assert!(Attribute::Quats.column(0) as u32 == kernels::gaussian::QUATS_COLUMN);
    assert!(Attribute::LogScales.column(0) as u32 == kernels::gaussian::LOG_SCALES_COLUMN);
    assert!(Attribute::RawOpacities.column(0) as u32 == kernels::gaussian::RAW_OPACITIES_COLUMN);
    assert!(Attribute::Dc.column(0) as u32 == kernels::gaussian::DC_COLUMN);
    assert!(Attribute::Features.column(0) as u32 == kernels::gaussian::FEATURES_COLUMN);
    assert!(gaussians::ATTRIBUTES.len() as u32 == kernels::gaussian::PLANE_COUNT);
    assert!(gaussians::MAX_SH_DEGREE == kernels::sh::MAX_SH_DEGREE);
    assert!(gaussians::LOG_SCALE_MIN.to_bits() == kernels::log_scale::LOG_SCALE_MIN.to_bits());
    assert!(gaussians::LOG_SCALE_MAX.to_bits() == kernels::log_scale::LOG_SCALE_MAX.to_bits());
    assert!(harmonics::SH_C0.to_bits() == kernels::sh::SH_C0.to_bits());
    assert!(harmonics::SH_C1.to_bits() == kernels::sh::SH_C1.to_bits());
    let mut k = 0;
    while k < harmonics::SH_C3.len() {
        assert!(k >= 5 || harmonics::SH_C2[k].to_bits() == kernels::sh::SH_C2[k].to_bits());
        assert!(harmonics::SH_C3[k].to_bits() == kernels::sh::SH_C3[k].to_bits());
        k += 1;
    }
};
