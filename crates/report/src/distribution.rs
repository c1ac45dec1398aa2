//! Histograms of luminance: of a photograph, its target and the reference image.

use nightsplat_photographs::tone::{luminance, measurable};

use super::chart::{Chart, Series};

/// Bins over [0, 1]; higher values count in the last.
const BINS: usize = 64;

/// A histogram of luminance, and its moments.
#[derive(Clone, Debug)]
pub struct Distribution {
    /// Its name in the legend.
    pub name: String,
    counts: [u64; BINS],
    /// Sums of the first three powers of the luminance.
    sums: [f64; 3],
}

impl Distribution {
    /// Empty.
    pub fn new(name: impl Into<String>) -> Self {
        Self { name: name.into(), counts: [0; BINS], sums: [0.0; 3] }
    }

    /// Adds the pixels of a planar (3, H, W) image.
    pub fn add(&mut self, planes: &[f32]) {
        let pixels = planes.len() / 3;
        for i in 0..pixels {
            let y = luminance([0, 1, 2].map(|plane| measurable(planes[plane * pixels + i])));
            self.counts[((y * BINS as f32) as usize).min(BINS - 1)] += 1;
            let y = f64::from(y);
            for (sum, power) in self.sums.iter_mut().zip([y, y * y, y * y * y]) {
                *sum += power;
            }
        }
    }

    /// Skewness m3 / m2^(3/2) of the luminance; 0 if all pixels are equal or there are none.
    pub fn skewness(&self) -> f64 {
        let count = self.counts.iter().sum::<u64>().max(1) as f64;
        let [mean, square, cube] = self.sums.map(|sum| sum / count);
        let variance = square - mean * mean;
        let third = cube - 3.0 * mean * square + 2.0 * mean * mean * mean;
        // At a lower variance, the image is constant and its moments are rounding errors.
        if variance > 1e-12 * square { third / variance.powf(1.5) } else { 0.0 }
    }

    /// Centres of the bins with their densities; the integral over [0, 1] is 1.
    fn density(&self) -> Vec<(f64, f64)> {
        let scale = BINS as f64 / self.counts.iter().sum::<u64>().max(1) as f64;
        let centre = |bin: usize| (bin as f64 + 0.5) / BINS as f64;
        let bins = self.counts.iter().enumerate();
        bins.map(|(bin, &count)| (centre(bin), scale * count as f64)).collect()
    }
}

/// The densities in one chart, each relative to its peak, with the skewness in the legend.
pub fn distributions(of: &[Distribution]) -> Chart {
    let series = |distribution: &Distribution| {
        let density = distribution.density();
        let peak = density.iter().map(|&(_, y)| y).fold(f64::MIN_POSITIVE, f64::max);
        Series {
            name: format!("{} (skewness {:.2})", distribution.name, distribution.skewness()),
            points: density.into_iter().map(|(x, y)| (x, y / peak)).collect(),
            ..Series::default()
        }
    };
    Chart::new("luminance", "density / its peak", of.iter().map(series).collect())
}
