//! EXR files: linear light by convention, or plain numbers.

use std::io::Cursor;
use std::path::Path;

use exr::meta::attribute::AttributeValue;
use exr::prelude::{ReadChannels, ReadLayers, SpecificChannels, Vec2, WritableImage};
use nightsplat_core::output::write_whole;
use nightsplat_core::{Error, Result};

use super::budget::Permit;
use super::colour::{self, Chromaticities, Conversion};
use super::decoded::{DecodedImage, Meaning};
use super::levels::{Levels, SampleFormat, extremes};
use super::source::{BufReadSeek, not_an_image};
use super::{Image, srgb_from_linear};

/// The magic number of EXR files.
pub(super) const MAGIC: [u8; 4] = [0x76, 0x2F, 0x31, 0x01];

/// The first layer's R, G and B (or Y), and the mask of its finite pixels. Colours are encoded as sRGB, with their
/// sign; those that are not finite become 0, and are counted in a remark.
pub(super) fn load(
    path: &Path,
    bytes: Vec<u8>,
    meaning: Meaning,
    levels: &Levels,
) -> Result<DecodedImage> {
    let permit = Permit::wait(layer_bytes(&headers(&bytes).unwrap_or_default()));
    let (mut image, chromaticities) = decoded(path, bytes)?;
    drop(permit);
    let alpha = finite_part(&image);
    let conversion = match chromaticities {
        Some(chromaticities) if meaning == Meaning::Colour => {
            colour::convert_linear(&mut image, chromaticities)
        }
        _ => Conversion::default(),
    };
    let mut replaced = 0_usize;
    for value in image.data.iter_mut().filter(|value| !value.is_finite()) {
        replaced += 1;
        *value = 0.0;
    }
    let remark = match extremes(&image) {
        _ if replaced > 0 => Some(format!("{replaced} values are not finite: masked")),
        _ if meaning == Meaning::Number => None,
        [least, most] if least == most => Some(format!(
            "every value is {most}: it shows nothing; leave it out or export it again"
        )),
        [_, most] if most < 0.0 => {
            Some(format!("every value is negative, {most} at most: it is black; export it again"))
        }
        _ => None,
    };
    if meaning == Meaning::Colour {
        levels.apply(&mut image, SampleFormat::Float);
        image.data.iter_mut().for_each(|value| *value = srgb_from_linear(*value));
    }
    Ok(DecodedImage { image, alpha, conversion, is_beyond: false, remark })
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
    let names: Vec<String> =
        layer.channel_data.list.iter().map(|channel| channel.name.to_string()).collect();
    let group = group(&names);
    let mut data = Vec::with_capacity(3 * pixels);
    for name in ["R", "G", "B"] {
        let named = [format!("{group}{name}"), "Y".to_owned()];
        let at = named.iter().find_map(|name| names.iter().position(|other| other == name));
        let channel = at.map(|at| &layer.channel_data.list[at]).ok_or_else(|| {
            let problem = format!(
                "this EXR file has neither {name} nor Y, but {}; export one layer as R, G and B",
                names.join(", ")
            );
            Error::input(path, problem)
        })?;
        if channel.sample_data.len() != pixels {
            let problem = "this EXR file has subsampled channels; save it as plain RGB";
            return Err(Error::input(path, problem));
        }
        data.extend(channel.sample_data.values_as_f32());
    }
    let (width, height) = (layer.size.width() as u32, layer.size.height() as u32);
    Ok((Image { width, height, data }, chromaticities))
}

/// What the header of a file says of a layer.
type ExrHeader = exr::meta::header::Header;

pub(super) fn headers(bytes: &[u8]) -> Option<exr::meta::Headers> {
    let bytes: Box<dyn BufReadSeek> = Box::new(Cursor::new(bytes));
    Some(exr::meta::MetaData::read_from_buffered(bytes, false).ok()?.headers)
}

pub(super) fn size(header: &ExrHeader) -> [u64; 2] {
    [header.layer_size.width(), header.layer_size.height()].map(|side| side as u64)
}

/// The bytes of the samples of all layers.
pub(super) fn layer_bytes(headers: &[ExrHeader]) -> u64 {
    let samples = |header: &ExrHeader| {
        let [width, height] = size(header);
        width.saturating_mul(height).saturating_mul(header.channels.bytes_per_pixel as u64)
    };
    headers.iter().map(samples).fold(0, u64::saturating_add)
}

/// What precedes the names of red, green and blue: nothing, or the name of the only group of channels that has all
/// three, or of the only one that is called `Combined`, as Blender calls the picture.
fn group(names: &[String]) -> &str {
    let has = |name: String| names.contains(&name);
    let is_whole = |group: &&str| ["G", "B"].iter().all(|color| has(format!("{group}{color}")));
    let groups = names.iter().filter_map(|name| name.strip_suffix('R')).filter(is_whole);
    let mut groups: Vec<&str> = groups.collect();
    if groups.iter().any(|group| group.ends_with("Combined.")) {
        groups.retain(|group| group.ends_with("Combined."));
    }
    match groups[..] {
        [only] if !names.iter().any(|name| name == "R" || name == "Y") => only,
        _ => "",
    }
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
