//! Photographs as planar float images, and their files.
//!
//! Values are sRGB-encoded, as an 8-bit file stores them divided by 255. A file in another colour space is converted
//! when it is read (`colour`). EXR files contain linear light by convention; they are encoded on reading and decoded on
//! writing (IEC 61966-2-1, including the linear toe, with the power law continued above 1).

mod budget;
mod codec;
mod colour;
mod declared;
mod decode;
mod decoded;
mod exif;
mod exr_file;
pub mod files;
mod jpeg;
mod level_search;
mod levels;
mod mask;
mod orientation;
mod png_file;
#[cfg(feature = "raw")]
mod raw;
#[cfg(not(feature = "raw"))]
#[path = "image/unread_raw.rs"]
mod raw;
mod rows;
mod source;

use nightsplat_core::image::{Area, area_weights};
pub use nightsplat_core::image::{Image, MIDDLE_GREY, linear_from_srgb, srgb_from_linear};

#[cfg(debug_assertions)]
pub use codec::openings;
pub use exif::lens_name;
pub use {
    budget::{decoded_at_once, reduced_size},
    codec::ImageFile,
    colour::ColourCounts,
    decode::PictureFile,
    exif::exposure_value,
    jpeg::exif_segment,
    levels::{Levels, StoredLight},
    mask::{Mask, MaskFile},
    orientation::Orientation,
};
