//! Photographs as planar float images, and the files they come from and go to.
//!
//! Values are sRGB-encoded, as an 8-bit file stores them divided by 255. EXR files hold linear light by
//! convention; they are encoded on the way in and decoded on the way out (IEC 61966-2-1, linear toe included,
//! the power law continued above 1).

use std::io::Cursor;
use std::path::Path;

use ::image::{
    DynamicImage, ExtendedColorType, ImageEncoder, ImageReader, codecs::png::PngEncoder,
};
use rayon::prelude::*;

use crate::{Error, Result};

/// A colour image: planes of red, green and blue, sRGB-encoded, [0, 1] but for EXR input, which may exceed 1.
///
/// The centre of the pixel in column `x` and row `y` lies at `(x + 0.5, y + 0.5)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `(3, height, width)`, row-major.
    pub data: Vec<f32>,
}

/// The sRGB encoding of a linear-light value; inverse of [`linear_from_srgb`].
pub fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The linear light of an sRGB-encoded value.
pub fn linear_from_srgb(srgb: f32) -> f32 {
    if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

impl Image {
    /// An image of one colour.
    pub fn filled(width: u32, height: u32, color: [f32; 3]) -> Self {
        Self::from_fn(width, height, |_, _| color)
    }

    /// An image whose pixel in column `x` and row `y` is `color(x, y)`.
    pub fn from_fn(width: u32, height: u32, color: impl Fn(u32, u32) -> [f32; 3]) -> Self {
        let pixels = width as usize * height as usize;
        let mut data = vec![0.0; 3 * pixels];
        let positions = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        for (index, (x, y)) in positions.enumerate() {
            for (plane, value) in color(x, y).into_iter().enumerate() {
                data[plane * pixels + index] = value;
            }
        }
        Self { width, height, data }
    }

    /// Pixels per plane.
    pub fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The colour in column `x` and row `y`; panics outside the image.
    pub fn pixel(&self, x: u32, y: u32) -> [f32; 3] {
        let index = y as usize * self.width as usize + x as usize;
        [0, 1, 2].map(|plane| self.data[plane * self.pixel_count() + index])
    }

    /// Reads an 8- or 16-bit PNG, a JPEG or an EXR file; the content decides, not the file's name.
    ///
    /// Alpha is dropped, grey is repeated. Of an EXR file the first layer's R, G and B (or Y) are taken as linear
    /// light; values that are negative or not finite become 0, with a warning that counts them.
    ///
    /// # Errors
    /// [`Error::Input`] names the file when it cannot be read, is cut short or is of another format.
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path)
            .map_err(|error| Error::input(path, format!("cannot be read: {error}")))?;
        if bytes.starts_with(&EXR_MAGIC) {
            return from_exr(path, bytes);
        }
        if bytes.starts_with(&[0xFF, 0xD8]) && !jpeg_is_whole(&bytes) {
            return Err(Error::input(path, "this JPEG is cut short; copy it again"));
        }
        let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format();
        let decoded = reader.map_err(::image::ImageError::from).and_then(ImageReader::decode);
        Ok(from_decoded(decoded.map_err(|error| not_an_image(path, &error))?))
    }

    /// Width and height of an image file, from its header alone.
    ///
    /// # Errors
    /// [`Error::Input`] names the file when it is no image.
    pub fn size_of(path: impl AsRef<Path>) -> Result<(u32, u32)> {
        let path = path.as_ref();
        let reader = ImageReader::open(path).and_then(ImageReader::with_guessed_format);
        let reader =
            reader.map_err(|error| Error::input(path, format!("cannot be read: {error}")))?;
        if reader.format().is_some() {
            return reader.into_dimensions().map_err(|error| not_an_image(path, &error));
        }
        let meta = exr::meta::MetaData::read_from_file(path, false)
            .map_err(|error| not_an_image(path, &error))?;
        let size = meta.headers.first().map(|header| header.layer_size);
        let size = size.ok_or_else(|| Error::input(path, "this EXR file has no layer"))?;
        Ok((size.width() as u32, size.height() as u32))
    }

    /// Writes an 8-bit RGB PNG: values clamped to [0, 1], rounded to nearest.
    ///
    /// # Errors
    /// [`Error::Output`] names the file; nothing half-written is left under its name.
    pub fn save_png8(&self, path: impl AsRef<Path>) -> Result<()> {
        let bytes: Vec<u8> =
            self.interleaved().map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        self.save_png(path.as_ref(), &bytes, ExtendedColorType::Rgb8)
    }

    /// Writes a 16-bit RGB PNG: values clamped to [0, 1], rounded to nearest.
    ///
    /// # Errors
    /// [`Error::Output`] names the file; nothing half-written is left under its name.
    pub fn save_png16(&self, path: impl AsRef<Path>) -> Result<()> {
        let samples =
            self.interleaved().map(|value| (value.clamp(0.0, 1.0) * 65_535.0).round() as u16);
        let bytes: Vec<u8> = samples.flat_map(u16::to_ne_bytes).collect();
        self.save_png(path.as_ref(), &bytes, ExtendedColorType::Rgb16)
    }

    /// Writes a 32-bit float EXR in linear light, unclamped: [`Image::load`] gives the same values back to rounding.
    ///
    /// # Errors
    /// [`Error::Output`] names the file; nothing half-written is left under its name.
    pub fn save_exr(&self, path: impl AsRef<Path>) -> Result<()> {
        use exr::prelude::{SpecificChannels, Vec2, WritableImage};
        let channels = SpecificChannels::rgb(|Vec2(x, y): Vec2<usize>| {
            let [red, green, blue] = self.pixel(x as u32, y as u32).map(linear_from_srgb);
            (red, green, blue)
        });
        let size = (self.width as usize, self.height as usize);
        let mut file = Cursor::new(Vec::new());
        exr::image::Image::from_channels(size, channels)
            .write()
            .to_buffered(&mut file)
            .map_err(|error| Error::output(path.as_ref(), format!("cannot be encoded: {error}")))?;
        write_whole(path.as_ref(), file.get_ref())
    }

    /// The image at another size: every output pixel is the mean of the area it covers (a box filter, in float).
    ///
    /// At an integer factor that is the mean of whole pixels. Sides below 1 count as 1.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let columns = area_weights(self.width, width);
        let rows = area_weights(self.height, height);
        let stride = self.width as usize;
        let data = (0..3 * height as usize)
            .into_par_iter()
            .flat_map_iter(|row| {
                let (plane, y) = (row / height as usize, row % height as usize);
                let plane = &self.data[plane * self.pixel_count()..][..self.pixel_count()];
                let mut line = vec![0.0_f64; stride];
                for (source, weight) in rows[y].taps() {
                    for (sum, value) in line.iter_mut().zip(&plane[source * stride..][..stride]) {
                        *sum += weight * f64::from(*value);
                    }
                }
                let mean = move |taps: &Area| {
                    taps.taps().map(|(x, weight)| weight * line[x]).sum::<f64>() as f32
                };
                columns.iter().map(mean)
            })
            .collect();
        Self { width, height, data }
    }

    fn interleaved(&self) -> impl Iterator<Item = f32> + '_ {
        let pixels = self.pixel_count();
        (0..pixels).flat_map(move |index| [0, 1, 2].map(|plane| self.data[plane * pixels + index]))
    }

    fn save_png(&self, path: &Path, bytes: &[u8], color: ExtendedColorType) -> Result<()> {
        let mut file = Vec::new();
        PngEncoder::new(&mut file)
            .write_image(bytes, self.width, self.height, color)
            .map_err(|error| Error::output(path, format!("cannot be encoded: {error}")))?;
        write_whole(path, &file)
    }
}

/// The input pixels that one output pixel covers along one axis, with weights that sum to 1.
struct Area {
    first: usize,
    weights: Vec<f64>,
}

impl Area {
    fn taps(&self) -> impl Iterator<Item = (usize, f64)> + '_ {
        self.weights.iter().enumerate().map(|(index, weight)| (self.first + index, *weight))
    }
}

/// In units of 1/output input pixels, so that every boundary is an integer and integer factors are exact.
fn area_weights(input: u32, output: u32) -> Vec<Area> {
    let (input, output) = (u64::from(input), u64::from(output));
    let area = |index: u64| {
        let (start, end) = (index * input, (index + 1) * input);
        let (first, last) = (start / output, (end - 1) / output);
        let covered = |pixel: u64| end.min((pixel + 1) * output) - start.max(pixel * output);
        let weights = (first..=last).map(|pixel| covered(pixel) as f64 / input as f64).collect();
        Area { first: first as usize, weights }
    };
    (0..output).map(area).collect()
}

const EXR_MAGIC: [u8; 4] = [0x76, 0x2F, 0x31, 0x01];

fn not_an_image(path: &Path, error: &dyn std::error::Error) -> Error {
    Error::input(
        path,
        format!("is not a readable PNG, JPEG or EXR image ({error}); replace or remove it"),
    )
}

fn from_decoded(decoded: DynamicImage) -> Image {
    let (width, height) = (decoded.width(), decoded.height());
    let pixels = width as usize * height as usize;
    let wide = decoded.color().bytes_per_pixel() > decoded.color().channel_count();
    let interleaved: Vec<f32> = if wide {
        decoded
            .into_rgb16()
            .into_raw()
            .into_iter()
            .map(|value| f32::from(value) / 65_535.0)
            .collect()
    } else {
        decoded.into_rgb8().into_raw().into_iter().map(|value| f32::from(value) / 255.0).collect()
    };
    let data =
        (0..3 * pixels).map(|index| interleaved[3 * (index % pixels) + index / pixels]).collect();
    Image { width, height, data }
}

fn from_exr(path: &Path, bytes: Vec<u8>) -> Result<Image> {
    use exr::prelude::{ReadChannels, ReadLayers};
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_buffered(Cursor::new(bytes))
        .map_err(|error| not_an_image(path, &error))?;
    let layer = image.layer_data;
    let pixels = layer.size.width() * layer.size.height();
    let channel = |name: &str| layer.channel_data.list.iter().find(|channel| channel.name.eq(name));
    let mut data = Vec::with_capacity(3 * pixels);
    let mut replaced = 0_usize;
    for name in ["R", "G", "B"] {
        let channel = channel(name).or_else(|| channel("Y"));
        let channel = channel
            .ok_or_else(|| Error::input(path, format!("this EXR file has neither {name} nor Y")))?;
        if channel.sample_data.len() != pixels {
            return Err(Error::input(
                path,
                "this EXR file has subsampled channels; save it as plain RGB",
            ));
        }
        data.extend(channel.sample_data.values_as_f32().map(|linear| {
            // Positive phrasing: a NaN fails the test too.
            let usable = linear >= 0.0 && linear.is_finite();
            replaced += usize::from(!usable);
            if usable { srgb_from_linear(linear) } else { 0.0 }
        }));
    }
    if replaced > 0 {
        tracing::warn!(
            "{}: {replaced} values are negative or not finite; they count as 0",
            path.display()
        );
    }
    Ok(Image { width: layer.size.width() as u32, height: layer.size.height() as u32, data })
}

/// Whether a JPEG reaches its end-of-image marker: the decoder paints what is missing grey and says nothing.
///
/// Segments are stepped over by their length, so a thumbnail's own marker does not count.
fn jpeg_is_whole(bytes: &[u8]) -> bool {
    let mut at = 2;
    let mut in_scan = false;
    while let [marker, rest @ ..] = bytes.get(at..).unwrap_or_default() {
        match (marker, rest) {
            (0xFF, [0xD9, ..]) => return true,
            (0xFF, [0x00 | 0xD0..=0xD7, ..]) if in_scan => at += 2,
            (0xFF, [0xFF, ..]) => at += 1,
            (0xFF, [kind, high, low, ..]) => {
                in_scan = *kind == 0xDA;
                at += 2 + usize::from(u16::from_be_bytes([*high, *low]));
            }
            _ => at += 1,
        }
    }
    false
}

/// Under a temporary name first, so that a full disk leaves nothing that looks complete.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    std::fs::write(&partial, bytes).and_then(|()| std::fs::rename(&partial, path)).map_err(
        |error| {
            // Whatever this leaves behind is reported by the error itself.
            let _ = std::fs::remove_file(&partial);
            Error::output(path, format!("cannot be written: {error}"))
        },
    )
}
