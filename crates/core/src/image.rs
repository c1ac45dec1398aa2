//! Images in memory: planar floats.
//!
//! Values are sRGB-encoded, as an 8-bit file stores them divided by 255 (IEC 61966-2-1, including the linear toe, with
//! the power law continued above 1).

use rayon::prelude::*;

/// A colour image: planes of red, green and blue, sRGB-encoded, in [0, 1]. Values of RAW and float files may exceed 1,
/// and are negative where noise is below black; they are clamped when an image is shown or written with integers.
///
/// The centre of the pixel in column `x` and row `y` is at `(x + 0.5, y + 0.5)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `(3, height, width)`, row-major.
    pub data: Vec<f32>,
}

/// Middle grey in linear light: the mean of a photograph that is exposed by a light meter.
pub const MIDDLE_GREY: f32 = 0.18;

/// The sRGB encoding of a linear-light value; inverse of [`linear_from_srgb`]. It is odd: noise at black has no bias.
pub fn srgb_from_linear(linear: f32) -> f32 {
    let light = linear.abs();
    let encoded =
        if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
    encoded.copysign(linear)
}

/// The linear light of an sRGB-encoded value.
pub fn linear_from_srgb(srgb: f32) -> f32 {
    let value = srgb.abs();
    let linear =
        if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
    linear.copysign(srgb)
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

    /// The image at another size: every output pixel is the mean of the area it covers (a box filter, in floats).
    ///
    /// At an integer factor this is the mean of whole pixels. Sides below 1 count as 1.
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
                columns.iter().map(move |taps| taps.mean_of(&line))
            })
            .collect();
        Self { width, height, data }
    }
}

/// The input pixels that one output pixel covers along one axis, with weights that sum to 1.
#[derive(Clone, Debug)]
pub struct Area {
    /// The first of them.
    pub first: usize,
    /// From the first on.
    pub weights: Vec<f64>,
}

impl Area {
    /// Index and weight of each.
    pub fn taps(&self) -> impl Iterator<Item = (usize, f64)> + '_ {
        self.weights.iter().enumerate().map(|(index, weight)| (self.first + index, *weight))
    }

    /// The mean of a line of pixels.
    pub fn mean_of(&self, line: &[f64]) -> f32 {
        self.taps().map(|(x, weight)| weight * line[x]).sum::<f64>() as f32
    }
}

/// In units of 1/output input pixels: every boundary is then an integer, and integer factors are exact.
pub fn area_weights(input: u32, output: u32) -> Vec<Area> {
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

/// For tests of images.
#[doc(hidden)]
pub mod testing {
    use super::Image;

    /// Three gradients.
    pub fn gradient(width: u32, height: u32) -> Image {
        Image::from_fn(width, height, |x, y| {
            let (x, y) = (x as f32 / width as f32, y as f32 / height as f32);
            [x, y, (0.3 + x * y) % 1.0]
        })
    }

    /// The largest difference of a value.
    pub fn worst(a: &Image, b: &Image) -> f32 {
        assert_eq!((a.width, a.height), (b.width, b.height));
        a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::testing::{gradient, worst};
    use super::*;

    #[test]
    fn the_transfer_functions_are_inverses_and_continuous_at_the_toe() {
        for step in -4000..=4000 {
            let srgb = step as f32 / 1000.0;
            assert_eq!(linear_from_srgb(-srgb), -linear_from_srgb(srgb));
            assert!(
                (srgb_from_linear(linear_from_srgb(srgb)) - srgb).abs()
                    < 2e-6 * srgb.abs().max(1.0),
                "{srgb}"
            );
        }
        assert!((srgb_from_linear(0.003_130_8) - srgb_from_linear(0.003_130_9)).abs() < 1e-5);
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
}
