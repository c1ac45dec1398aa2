//! Photographs as planar float images, and the files they come from and go to.
//!
//! Values are sRGB-encoded, as an 8-bit file stores them divided by 255. EXR files hold linear light by
//! convention; they are encoded on the way in and decoded on the way out (IEC 61966-2-1, linear toe included,
//! the power law continued above 1).

mod exr_file;
pub(crate) mod files;
mod jpeg;

use std::io::Cursor;
use std::path::Path;

use ::image::{
    DynamicImage, ExtendedColorType, ImageEncoder, ImageFormat, ImageReader,
    codecs::png::PngEncoder,
};
use rayon::prelude::*;

use crate::output::write_whole;
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
        Ok(Self::load_with_gaps(path)?.0)
    }

    /// As [`Image::load`], with the pixels of which a value is NaN or infinite: indices into a plane, ascending. They are
    /// black.
    ///
    /// # Errors
    /// As [`Image::load`].
    pub fn load_with_gaps(path: impl AsRef<Path>) -> Result<(Self, Vec<usize>)> {
        let path = path.as_ref();
        let bytes = std::fs::read(path)
            .map_err(|error| Error::input(path, format!("cannot be read: {error}")))?;
        let encode = |linear: f32| (linear >= 0.0).then(|| srgb_from_linear(linear));
        Self::decode(path, bytes, encode)
    }

    /// The same for numbers that are no colour, such as depth: EXR values are taken as they are, also negative ones.
    ///
    /// # Errors
    /// As [`Image::load`].
    pub fn load_as_stored(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path)
            .map_err(|error| Error::input(path, format!("cannot be read: {error}")))?;
        Ok(Self::decode(path, bytes, Some)?.0)
    }

    fn decode(
        path: &Path,
        bytes: Vec<u8>,
        from_exr_value: exr_file::FromExrValue,
    ) -> Result<(Self, Vec<usize>)> {
        if bytes.starts_with(&exr_file::MAGIC) {
            return exr_file::load(path, bytes, from_exr_value);
        }
        if bytes.starts_with(&jpeg::MAGIC)
            && let Some(image) = jpeg::load(path, &bytes)?
        {
            return Ok((image, vec![]));
        }
        let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format();
        let decoded = reader.map_err(::image::ImageError::from).and_then(ImageReader::decode);
        Ok((from_decoded(decoded.map_err(|error| not_an_image(path, &error))?), vec![]))
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
        if reader.format() != Some(ImageFormat::OpenExr) {
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
        exr_file::save(self, path.as_ref(), linear_from_srgb)
    }

    /// The same for numbers that are no colour: they are written as they are.
    ///
    /// # Errors
    /// As [`Image::save_exr`].
    pub fn save_exr_as_stored(&self, path: impl AsRef<Path>) -> Result<()> {
        exr_file::save(self, path.as_ref(), |value| value)
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

fn not_an_image(path: &Path, error: &dyn std::error::Error) -> Error {
    Error::input(
        path,
        format!("is not a readable PNG, JPEG or EXR image ({error}); replace or remove it"),
    )
}

fn from_decoded(decoded: DynamicImage) -> Image {
    let (width, height) = (decoded.width(), decoded.height());
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
    from_interleaved(width, height, &interleaved)
}

/// Planes from pixels of red, green and blue.
fn from_interleaved(width: u32, height: u32, values: &[f32]) -> Image {
    let data = (0..3).flat_map(|plane| values.iter().skip(plane).step_by(3).copied()).collect();
    Image { width, height, data }
}

#[cfg(test)]
mod tests {
    use ::image::{ImageBuffer, Luma, LumaA, Rgb, Rgba};

    use super::*;

    /// A path in a folder that goes when the second is dropped.
    fn file(name: &str) -> (std::path::PathBuf, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        (folder.path().join(name), folder)
    }

    fn gradient(width: u32, height: u32) -> Image {
        Image::from_fn(width, height, |x, y| {
            let (x, y) = (x as f32 / width as f32, y as f32 / height as f32);
            [x, y, (0.3 + x * y) % 1.0]
        })
    }

    fn worst(a: &Image, b: &Image) -> f32 {
        assert_eq!((a.width, a.height), (b.width, b.height));
        a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn every_png_layout_gives_the_same_colours_and_alpha_is_dropped() {
        let (path, _folder) = file("a.png");
        let grey = |x: u32, y: u32| (40 * x + 7 * y) as u8;
        let expected = Image::from_fn(5, 3, |x, y| [f32::from(grey(x, y)) / 255.0; 3]);
        let save: [&dyn Fn() -> ::image::ImageResult<()>; 6] = [
            &|| ImageBuffer::from_fn(5, 3, |x, y| Luma([grey(x, y)])).save(&path),
            &|| ImageBuffer::from_fn(5, 3, |x, y| LumaA([grey(x, y), 9])).save(&path),
            &|| ImageBuffer::from_fn(5, 3, |x, y| Rgb([grey(x, y); 3])).save(&path),
            &|| {
                ImageBuffer::from_fn(5, 3, |x, y| Rgba([grey(x, y), grey(x, y), grey(x, y), 0]))
                    .save(&path)
            },
            &|| ImageBuffer::from_fn(5, 3, |x, y| Luma([u16::from(grey(x, y)) * 257])).save(&path),
            &|| {
                ImageBuffer::from_fn(5, 3, |x, y| Rgb([u16::from(grey(x, y)) * 257; 3])).save(&path)
            },
        ];
        for (layout, save) in save.iter().enumerate() {
            save().unwrap();
            assert!(worst(&Image::load(&path).unwrap(), &expected) < 1e-7, "layout {layout}");
            assert_eq!(Image::size_of(&path).unwrap(), (5, 3));
        }
    }

    #[test]
    fn what_is_saved_is_loaded_to_the_formats_precision() {
        let image = gradient(7, 5);
        let (path, _folder) = file("a");
        image.save_png8(&path).unwrap();
        assert!(worst(&Image::load(&path).unwrap(), &image) <= 0.5 / 255.0 + 1e-6);
        image.save_png16(&path).unwrap();
        assert!(worst(&Image::load(&path).unwrap(), &image) <= 0.5 / 65_535.0 + 1e-6);
        let bright = Image { data: image.data.iter().map(|value| 3.0 * value).collect(), ..image };
        bright.save_exr(&path).unwrap();
        assert!(worst(&Image::load(&path).unwrap(), &bright) < 1e-5);
        assert_eq!(Image::size_of(&path).unwrap(), (7, 5));
    }

    #[test]
    fn an_exr_is_linear_light_and_its_unusable_values_count_as_black() {
        let (path, _folder) = file("a.exr");
        let values = [0.5_f32, 0.001, f32::NAN, f32::INFINITY, -0.5, 4.0];
        exr::prelude::write_rgb_file(&path, 6, 1, |x, _| (values[x], values[x], values[x]))
            .unwrap();
        let loaded = Image::load(&path).unwrap();
        let expected =
            [0.735_357, 0.012_92, 0.0, 0.0, 0.0, 1.055 * 4.0_f32.powf(1.0 / 2.4) - 0.055];
        for (x, expected) in expected.into_iter().enumerate() {
            assert!((loaded.data[x] - expected).abs() < 1e-5, "{}: {}", values[x], loaded.data[x]);
        }
    }

    #[test]
    fn a_grey_exr_is_grey_and_one_without_colour_is_refused() {
        use exr::prelude::{SpecificChannels, Vec2, WritableImage};
        let (path, _folder) = file("a.exr");
        let save = |name: &str| {
            let channels = SpecificChannels::build().with_channel(name);
            let channels = channels.with_pixel_fn(|Vec2(x, _): Vec2<usize>| (0.25_f32 * x as f32,));
            exr::image::Image::from_channels((3, 2), channels).write().to_file(&path).unwrap();
        };
        save("Y");
        let [red, green, blue] = Image::load(&path).unwrap().pixel(2, 1);
        assert!((red - 0.735_357).abs() < 1e-5 && red == green && green == blue);
        save("Z");
        assert!(Image::load(&path).unwrap_err().to_string().contains("neither R nor Y"));
    }

    #[test]
    fn the_transfer_functions_invert_each_other_and_meet_at_the_toe() {
        for step in 0..=4000 {
            let srgb = step as f32 / 1000.0;
            assert!(
                (srgb_from_linear(linear_from_srgb(srgb)) - srgb).abs() < 2e-6 * srgb.max(1.0),
                "{srgb}"
            );
        }
        assert!((srgb_from_linear(0.003_130_8) - srgb_from_linear(0.003_130_9)).abs() < 1e-5);
    }

    #[test]
    fn a_jpeg_is_loaded_whole_or_refused() {
        let (path, _folder) = file("a.jpg");
        ImageBuffer::from_fn(64, 48, |x, y| Rgb([(x * 3) as u8, (y * 4) as u8, 90]))
            .save(&path)
            .unwrap();
        let pixel = Image::load(&path).unwrap().pixel(40, 20);
        assert!(
            (pixel[0] - 120.0 / 255.0).abs() < 0.06 && (pixel[1] - 80.0 / 255.0).abs() < 0.06,
            "{pixel:?}"
        );
        let bytes = std::fs::read(&path).unwrap();
        for length in 0..bytes.len() - 1 {
            std::fs::write(&path, &bytes[..length]).unwrap();
            let error = Image::load(&path).unwrap_err().to_string();
            assert!(error.contains("a.jpg") && !error.contains('\n'), "{length}: {error}");
        }
    }

    #[test]
    fn a_file_that_is_no_image_is_named() {
        let (path, _folder) = file("noise.png");
        assert!(Image::load(&path).unwrap_err().to_string().contains("noise.png: cannot be read"));
        let (exr, _exr_folder) = file("whole.exr");
        gradient(9, 9).save_exr(&exr).unwrap();
        let exr = std::fs::read(exr).unwrap();
        for bytes in [
            &b""[..],
            b"not an image",
            b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
            &exr_file::MAGIC,
            &exr[..exr.len() / 2],
        ] {
            std::fs::write(&path, bytes).unwrap();
            let error = Image::load(&path).unwrap_err().to_string();
            assert!(error.contains("noise.png: is not a readable"), "{error}");
        }
    }

    #[test]
    fn shrinking_by_an_integer_takes_the_mean_of_whole_pixels() {
        let image = gradient(12, 9);
        let third = image.resized(4, 3);
        for (x, y) in (0..3).flat_map(|y| (0..4).map(move |x| (x, y))) {
            let block = (0..9).map(|index| image.pixel(3 * x + index % 3, 3 * y + index / 3));
            let mean = block.fold([0.0_f64; 3], |sum, color| {
                [0, 1, 2].map(|plane| sum[plane] + f64::from(color[plane]) / 9.0)
            });
            for (ours, mean) in third.pixel(x, y).into_iter().zip(mean) {
                assert!((f64::from(ours) - mean).abs() < 1e-7);
            }
        }
    }

    #[test]
    fn resizing_to_any_size_keeps_the_mean_and_constants() {
        let image = gradient(13, 11);
        let mean = |image: &Image| {
            image.data.iter().copied().map(f64::from).sum::<f64>() / image.data.len() as f64
        };
        for (width, height) in [(5, 4), (13, 11), (12, 3), (1, 1), (20, 17), (0, 0)] {
            let other = image.resized(width, height);
            assert_eq!(other.data.len(), 3 * other.pixel_count());
            assert!((mean(&other) - mean(&image)).abs() < 1e-6, "{width}x{height}");
            let flat = Image::filled(13, 11, [0.1, 0.5, 0.9]).resized(width, height);
            assert!(worst(&flat, &Image::filled(flat.width, flat.height, [0.1, 0.5, 0.9])) < 1e-7);
        }
    }

    #[test]
    fn a_failed_write_leaves_nothing_behind() {
        let (path, folder) = file("taken");
        std::fs::create_dir(&path).unwrap();
        let error = gradient(4, 4).save_png8(&path).unwrap_err();
        assert!(
            matches!(&error, Error::Output { .. }) && error.to_string().contains("taken"),
            "{error}"
        );
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
