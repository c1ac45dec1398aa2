//! Takes the rows of an image as they are decoded: keeps them, reduces them to a smaller image, or shows them.
//!
//! Only what is kept takes memory. No other thread is waited for: a decoder may hold memory that others wait for.

use std::ops::ControlFlow;

use super::levels::SampleFormat;
use super::{Area, Image, area_weights, linear_from_srgb, srgb_from_linear};

/// Changes the three planes of a row before it is reduced.
pub(super) type RowChange<'a> = &'a mut dyn FnMut(&mut [f32], SampleFormat);

/// Sees the three planes of a row: its format, its number, and width and height of the image. No more rows are wanted
/// where it breaks.
pub(super) type RowObserver<'a> =
    &'a mut dyn FnMut(&[f32], SampleFormat, u32, (u32, u32)) -> ControlFlow<()>;

/// What becomes of the rows.
pub(super) enum Destination<'a> {
    /// All are kept.
    Whole,
    /// They are reduced to a size by the mean of values, or of linear light.
    Reduced { size: (u32, u32), is_light: bool, change: RowChange<'a> },
    /// Nothing is kept.
    Shown(RowObserver<'a>),
}

/// An image whose rows are being decoded.
pub(super) struct Rows<'a> {
    destination: Destination<'a>,
    size: (u32, u32),
    format: SampleFormat,
    channels: usize,
    /// Planes of red, green, blue, and alpha if the file has it.
    row: Vec<f32>,
    next: u32,
    /// Planes of the result.
    planes: Vec<f32>,
    reduction: Option<Reduction>,
    /// The smallest and the largest stored value of 16 bits.
    pub(super) extremes: [f32; 2],
    hides: bool,
}

impl<'a> Rows<'a> {
    pub(super) fn new(destination: Destination<'a>) -> Self {
        Self {
            destination,
            size: (0, 0),
            format: SampleFormat::Eight,
            channels: 3,
            row: vec![],
            next: 0,
            planes: vec![],
            reduction: None,
            extremes: [f32::INFINITY, f32::NEG_INFINITY],
            hides: false,
        }
    }

    /// How many pixels of an image of this size, each way, make one of the result.
    pub(super) fn factor(&self, (width, height): (u32, u32)) -> u32 {
        match &self.destination {
            Destination::Reduced { size, .. } => (width / size.0).min(height / size.1),
            _ => 1,
        }
    }

    /// Begins an image of grey (1), grey and alpha (2), RGB (3) or RGBA (4).
    pub(super) fn begin(&mut self, size: (u32, u32), format: SampleFormat, channels: usize) {
        (self.size, self.format, self.channels) = (size, format, channels);
        let planes = 3 + usize::from(channels.is_multiple_of(2));
        self.row = vec![0.0; planes * size.0 as usize];
        let kept = match &self.destination {
            Destination::Whole => size,
            Destination::Reduced { size: reduced, .. } => {
                self.reduction = Some(Reduction::new(size, *reduced, planes));
                *reduced
            }
            Destination::Shown(_) => (0, 0),
        };
        self.planes = vec![0.0; planes * kept.0 as usize * kept.1 as usize];
    }

    /// The next row, of samples of 8 bits.
    pub(super) fn push8(&mut self, samples: &[u8]) -> ControlFlow<()> {
        self.push(|at| f32::from(samples[at]) / 255.0)
    }

    /// The next row, of samples of 16 bits.
    pub(super) fn push16(&mut self, samples: impl Fn(usize) -> u16) -> ControlFlow<()> {
        self.push(|at| f32::from(samples(at)) / 65_535.0)
    }

    fn push(&mut self, value: impl Fn(usize) -> f32) -> ControlFlow<()> {
        let (width, channels) = (self.size.0 as usize, self.channels);
        for (plane, values) in self.row.chunks_exact_mut(width.max(1)).enumerate() {
            let channel = match plane {
                3 => channels - 1,
                _ if channels < 3 => 0,
                plane => plane,
            };
            for (x, kept) in values.iter_mut().enumerate() {
                *kept = value(channels * x + channel);
            }
        }
        let (colours, alpha) = self.row.split_at_mut(3 * width);
        self.hides |= alpha.iter().any(|&value| value < 1.0);
        if self.format == SampleFormat::Sixteen {
            let [low, high] = &mut self.extremes;
            for &value in &*colours {
                (*low, *high) = (value.min(*low), value.max(*high));
            }
        }
        let y = self.next;
        self.next += 1;
        match &mut self.destination {
            Destination::Shown(observer) => return observer(colours, self.format, y, self.size),
            Destination::Whole => {
                let pixels = width * self.size.1 as usize;
                for (plane, values) in self.row.chunks_exact(width.max(1)).enumerate() {
                    self.planes[plane * pixels + y as usize * width..][..width]
                        .copy_from_slice(values);
                }
            }
            Destination::Reduced { is_light, change, .. } => {
                change(colours, self.format);
                if *is_light {
                    colours.iter_mut().for_each(|x| *x = linear_from_srgb(*x));
                }
                if let Some(reduction) = &mut self.reduction {
                    reduction.push(&self.row, y as usize, &mut self.planes);
                }
            }
        }
        ControlFlow::Continue(())
    }

    /// The image, and its alpha in all three planes where that hides anything.
    pub(super) fn finish(mut self) -> (Image, Option<Image>, SampleFormat) {
        let (mut is_encoded, mut size) = (true, self.size);
        if let Destination::Reduced { size: reduced, is_light, .. } = self.destination {
            (is_encoded, size) = (!is_light, reduced);
        }
        let (width, height) = size;
        let pixels = width as usize * height as usize;
        let alpha = self.planes.split_off((3 * pixels).min(self.planes.len()));
        if !is_encoded {
            self.planes.iter_mut().for_each(|x| *x = srgb_from_linear(*x));
        }
        let alpha = self.hides.then(|| Image { width, height, data: alpha.repeat(3) });
        (Image { width, height, data: self.planes }, alpha, self.format)
    }
}

/// [`Image::resized`] of an image that comes row by row, to the bit.
struct Reduction {
    columns: Vec<Area>,
    rows: Vec<Area>,
    width: usize,
    /// The row of the result that is summed up, and its sums by plane and column.
    at: usize,
    sums: Vec<f64>,
}

impl Reduction {
    fn new(from: (u32, u32), to: (u32, u32), planes: usize) -> Self {
        let width = from.0 as usize;
        Self {
            columns: area_weights(from.0, to.0),
            rows: area_weights(from.1, to.1),
            width,
            at: 0,
            sums: vec![0.0; planes * width],
        }
    }

    fn push(&mut self, row: &[f32], y: usize, planes: &mut [f32]) {
        while let Some(area) = self.rows.get(self.at)
            && let Some(weight) = y.checked_sub(area.first).and_then(|tap| area.weights.get(tap))
        {
            for (sum, value) in self.sums.iter_mut().zip(row) {
                *sum += weight * f64::from(*value);
            }
            if y + 1 < area.first + area.weights.len() {
                return;
            }
            let (width, pixels) = (self.columns.len(), self.columns.len() * self.rows.len());
            for (plane, line) in self.sums.chunks_exact(self.width).enumerate() {
                let row = &mut planes[plane * pixels + self.at * width..][..width];
                for (mean, columns) in row.iter_mut().zip(&self.columns) {
                    *mean = columns.mean_of(line);
                }
            }
            self.sums.fill(0.0);
            self.at += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::image::testing::gradient;

    /// The image of rows of 16 bits, with alpha.
    fn through(codes: &[u16], size: (u32, u32), destination: Destination<'_>) -> [Image; 2] {
        let mut rows = Rows::new(destination);
        rows.begin(size, SampleFormat::Sixteen, 4);
        for row in codes.chunks_exact(4 * size.0 as usize) {
            assert!(rows.push16(|at| row[at]).is_continue());
        }
        let (image, alpha, _) = rows.finish();
        [image, alpha.unwrap()]
    }

    #[test]
    fn reducing_row_by_row_is_reducing_the_whole_to_the_bit() {
        let image = gradient(37, 29);
        let code = |at: usize, plane: usize| (image.data[plane * 37 * 29 + at] * 65_535.0) as u16;
        let codes: Vec<u16> = (0..37 * 29)
            .flat_map(|at| [code(at, 0), code(at, 1), code(at, 2), 777 * (at % 83) as u16])
            .collect();
        let whole = through(&codes, (37, 29), Destination::Whole);
        for size in [(37, 29), (18, 14), (12, 10), (9, 7), (5, 29), (1, 1)] {
            let change = &mut |_: &mut [f32], _| ();
            let by_rows = Destination::Reduced { size, is_light: false, change };
            let reduced = through(&codes, (37, 29), by_rows);
            assert!(reduced == [0, 1].map(|one| whole[one].resized(size.0, size.1)), "{size:?}");
        }
    }

    #[test]
    fn light_is_reduced_by_its_mean() {
        let change = &mut |_: &mut [f32], _| ();
        let mut rows = Rows::new(Destination::Reduced { size: (1, 1), is_light: true, change });
        rows.begin((2, 1), SampleFormat::Eight, 1);
        assert!(rows.push8(&[0, 255]).is_continue());
        assert!((rows.finish().0.data[0] - srgb_from_linear(0.5)).abs() < 1e-6);
    }
}
