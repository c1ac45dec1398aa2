//! Joint histograms of dark and reference values: what a fit requires of millions of pixels.

use nightsplat_photographs::tone::measurable;

/// Reference values are counted as 8-bit code values.
const LEVELS: usize = 256;

/// The key of a column drops the last twelve bits of an f32: values of 8-bit files have different columns, values
/// closer than a factor of 2^-11 share one.
const KEY_SHIFT: u32 = 12;

/// The key of the largest value, 65504.
const LARGEST_KEY: usize = (65504.0_f32.to_bits() >> KEY_SHIFT) as usize;

/// Pixels of one reference value, within a column.
#[derive(Clone, Copy, Debug)]
pub struct HistogramCell {
    level: u8,
    count: f64,
}

impl HistogramCell {
    /// The reference value, in [0, 1].
    pub fn y(self) -> f64 {
        f64::from(self.level) / (LEVELS - 1) as f64
    }

    /// The number of pixels, times their weight.
    pub fn count(self) -> f64 {
        self.count
    }
}

/// Pixels with the same dark value.
#[derive(Clone, Debug, Default)]
pub struct HistogramColumn {
    /// The mean of their dark values.
    pub x: f64,
    /// Their number.
    pub count: f64,
    /// The sum of their reference values, in f64.
    pub sum_y: f64,
    /// The sum of the squares of their reference values.
    pub sum_y2: f64,
    /// Their reference values to 8 bits, ascending.
    pub cells: Vec<HistogramCell>,
}

/// Columns in the order of their dark values; none is empty.
#[derive(Clone, Debug, Default)]
pub struct Histogram {
    /// The columns.
    pub columns: Vec<HistogramColumn>,
}

/// A column under construction.
#[derive(Clone)]
struct OpenColumn {
    sums: [f64; 3],
    counts: [f64; LEVELS],
}

impl OpenColumn {
    const EMPTY: Self = Self { sums: [0.0; 3], counts: [0.0; LEVELS] };

    fn closed(&self) -> Option<HistogramColumn> {
        let count: f64 = self.counts.iter().sum();
        let cells = self.counts.iter().zip(0..=u8::MAX).filter(|&(&count, _)| count > 0.0);
        let cells = cells.map(|(&count, level)| HistogramCell { level, count }).collect();
        let [sum_x, sum_y, sum_y2] = self.sums;
        (count > 0.0).then(|| HistogramColumn { x: sum_x / count, count, sum_y, sum_y2, cells })
    }
}

impl Histogram {
    /// The histogram of one plane, (H, W) each: one column per dark value, exact for 8-bit photographs. Reference
    /// values are clamped to [0, 1], dark values as in [`Statistics`](nightsplat_photographs::tone::Statistics).
    pub fn new(dark: &[f32], reference: &[f32]) -> Self {
        let key = |x: f32| (measurable(x).to_bits() >> KEY_SHIFT) as usize;
        let mut columns = vec![0_u32; LARGEST_KEY + 1];
        for &x in dark {
            columns[key(x)] = 1;
        }
        let mut used = 0;
        for column in columns.iter_mut().filter(|column| **column > 0) {
            *column = used;
            used += 1;
        }
        let mut open = vec![OpenColumn::EMPTY; used as usize];
        for (&x, &y) in dark.iter().zip(reference) {
            let column = &mut open[columns[key(x)] as usize];
            let y = measurable(y).min(1.0);
            column.counts[(y * (LEVELS - 1) as f32).round() as usize] += 1.0;
            let y = f64::from(y);
            for (sum, value) in column.sums.iter_mut().zip([f64::from(measurable(x)), y, y * y]) {
                *sum += value;
            }
        }
        Self { columns: open.iter().filter_map(OpenColumn::closed).collect() }
    }

    /// Merges several histograms into one of `bins` columns, each with a factor for its dark values and a weight for
    /// its counts.
    ///
    /// Bins are uniform in t / (1 + t): fine in the shadows, and the few values far above 1 do not widen the others.
    pub fn pooled<'a>(parts: impl IntoIterator<Item = (&'a Self, [f64; 2])>, bins: usize) -> Self {
        let mut open = vec![OpenColumn::EMPTY; bins];
        for (histogram, [factor, weight]) in parts {
            for column in &histogram.columns {
                let t = column.x * factor;
                let bin = (t / (1.0 + t) * bins as f64) as usize;
                let into = &mut open[bin.min(bins - 1)];
                let sums = [t * column.count, column.sum_y, column.sum_y2];
                for (sum, value) in into.sums.iter_mut().zip(sums) {
                    *sum += weight * value;
                }
                for cell in &column.cells {
                    into.counts[usize::from(cell.level)] += weight * cell.count;
                }
            }
        }
        Self { columns: open.iter().filter_map(OpenColumn::closed).collect() }
    }

    /// The number of pixels, times their weights.
    pub fn count(&self) -> f64 {
        self.columns.iter().map(|column| column.count).sum()
    }

    /// The sums of the residuals y - f(x) and of their squares over all pixels, exact except for values that share a
    /// column.
    pub fn residuals(&self, f: impl Fn(f64) -> f64) -> [f64; 2] {
        self.columns.iter().fold([0.0; 2], |[sum, squares], column| {
            let (y, HistogramColumn { count, sum_y, sum_y2, .. }) = (f(column.x), column);
            [sum + sum_y - count * y, squares + sum_y2 - 2.0 * y * sum_y + count * y * y]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::Histogram;

    #[test]
    fn sums_are_those_of_the_pixels_for_any_pooling() {
        let dark: Vec<f32> = (0..5000).map(|i| (i % 61) as f32 / 255.0).collect();
        let reference: Vec<f32> = (0..5000).map(|i| (i * 7 % 256) as f32 / 255.0).collect();
        let histogram = Histogram::new(&dark, &reference);
        assert_eq!(histogram.columns.len(), 61);
        let f = |x: f64| 3.0 * x;
        let direct = dark.iter().zip(&reference).map(|(&x, &y)| f64::from(y) - f(x.into()));
        let direct = direct.fold([0.0; 2], |[sum, squares], r| [sum + r, squares + r * r]);
        let close = |found: [f64; 2]| {
            found.iter().zip(direct).all(|(a, b)| (a - b).abs() < 1e-8 * b.abs().max(1.0))
        };
        assert!(close(histogram.residuals(f)));
        let pooled = Histogram::pooled([(&histogram, [4.0, 0.5]), (&histogram, [4.0, 1.5])], 4096);
        assert_eq!((pooled.count(), pooled.columns.len()), (10_000.0, 61));
        assert!(close(pooled.residuals(|t| f(t / 4.0)).map(|sum| sum / 2.0)));
        // The cells of every column contain its pixels.
        for column in &pooled.columns {
            let sum: f64 = column.cells.iter().map(|cell| cell.count() * cell.y()).sum();
            assert!((sum - column.sum_y).abs() < 1e-4 * column.count);
        }
    }

    #[test]
    fn invalid_values_and_empty_planes_are_counted_as_in_the_statistics() {
        let histogram =
            Histogram::new(&[f32::NAN, -1.0, f32::INFINITY, 1e9], &[2.0, f32::NAN, 0.5, 0.5]);
        let x: Vec<f64> = histogram.columns.iter().map(|column| column.x).collect();
        assert_eq!(x, [0.0, 65504.0]);
        assert_eq!(histogram.columns[0].sum_y, 1.0);
        assert!(Histogram::new(&[], &[]).columns.is_empty());
        assert!(Histogram::pooled([], 8).columns.is_empty());
    }
}
