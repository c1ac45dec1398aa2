//! EXR files: linear light by convention, or plain numbers.

use std::io::Cursor;
use std::path::Path;

use exr::meta::attribute::AttributeValue;
use exr::prelude::{ReadChannels, ReadLayers, SpecificChannels, Vec2, WritableImage};

use super::colour::{self, Chromaticities, Conversion};
use super::decoded::{DecodedImage, Meaning};
use super::source::{BufReadSeek, not_an_image};
use super::{Image, srgb_from_linear};
use crate::base::output::write_whole;
use crate::{Error, Result};

/// The magic number of EXR files.
pub(super) const MAGIC: [u8; 4] = [0x76, 0x2F, 0x31, 0x01];

/// The first layer's R, G and B (or Y), and the mask of its finite pixels. Colours are encoded as sRGB; those that are
/// negative or not finite become 0, with a warning that counts them.
pub(super) fn load(path: &Path, bytes: Vec<u8>, meaning: Meaning) -> Result<DecodedImage> {
    let (mut image, chromaticities) = decoded(path, bytes)?;
    let alpha = finite_part(&image);
    let conversion = match chromaticities {
        Some(chromaticities) if meaning == Meaning::Colour => {
            colour::convert_linear(&mut image, chromaticities)
        }
        _ => Conversion::default(),
    };
    let mut replaced = 0_usize;
    for value in &mut image.data {
        let usable = match meaning {
            Meaning::Colour => {
                (*value >= 0.0 && value.is_finite()).then(|| srgb_from_linear(*value))
            }
            Meaning::Number => value.is_finite().then_some(*value),
        };
        replaced += usize::from(usable.is_none());
        *value = usable.unwrap_or(0.0);
    }
    if replaced > 0 {
        tracing::warn!(
            "{}: {replaced} values are negative colours or not finite; they count as 0",
            path.display()
        );
    }
    Ok(DecodedImage { image, alpha, conversion })
}

/// 1 at pixels whose values are all finite, 0 elsewhere, in all three planes; `None` if all are finite.
fn finite_part(Image { width, height, data }: &Image) -> Option<Image> {
    if data.iter().all(|value| value.is_finite()) {
        return None;
    }
    let pixels = data.len() / 3;
    let is_finite = |pixel: usize| (0..3).all(|plane| data[plane * pixels + pixel].is_finite());
    let shown: Vec<f32> = (0..pixels).map(|pixel| f32::from(is_finite(pixel))).collect();
    Some(Image { width: *width, height: *height, data: shown.repeat(3) })
}

/// The first layer's R, G and B (or Y) as stored, and the chromaticities of its primaries.
fn decoded(path: &Path, bytes: Vec<u8>) -> Result<(Image, Option<Chromaticities>)> {
    let bytes: Box<dyn BufReadSeek> = Box::new(Cursor::new(bytes));
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_buffered(bytes)
        .map_err(|error| not_an_image(path, &error))?;
    let chromaticities = image.attributes.chromaticities.map(|of| {
        [of.white, of.red, of.green, of.blue].map(|pair| [pair.0, pair.1].map(f64::from))
    });
    let layer = image.layer_data;
    let pixels = layer.size.width() * layer.size.height();
    let channel = |name: &str| layer.channel_data.list.iter().find(|channel| channel.name.eq(name));
    let mut data = Vec::with_capacity(3 * pixels);
    for name in ["R", "G", "B"] {
        let channel = channel(name).or_else(|| channel("Y"));
        let channel = channel
            .ok_or_else(|| Error::input(path, format!("this EXR file has neither {name} nor Y")))?;
        if channel.sample_data.len() != pixels {
            let problem = "this EXR file has subsampled channels; save it as plain RGB";
            return Err(Error::input(path, problem));
        }
        data.extend(channel.sample_data.values_as_f32());
    }
    let (width, height) = (layer.size.width() as u32, layer.size.height() as u32);
    Ok((Image { width, height, data }, chromaticities))
}

/// Writes R, G and B as 32-bit floats, each value through `to_exr_value`, with these numbers in the header.
pub(super) fn save(
    image: &Image,
    path: &Path,
    to_exr_value: fn(f32) -> f32,
    header: &[(&str, f32)],
) -> Result<()> {
    let channels = SpecificChannels::rgb(|Vec2(x, y): Vec2<usize>| {
        let [red, green, blue] = image.pixel(x as u32, y as u32).map(to_exr_value);
        (red, green, blue)
    });
    let size = (image.width as usize, image.height as usize);
    let mut file = Cursor::new(Vec::new());
    let mut image = exr::image::Image::from_channels(size, channels);
    let named = header.iter().map(|&(name, value)| (name.into(), AttributeValue::F32(value)));
    image.layer_data.attributes.other.extend(named);
    image
        .write()
        .to_buffered(&mut file)
        .map_err(|error| Error::output(path, format!("cannot be encoded: {error}")))?;
    write_whole(path, file.get_ref())
}
