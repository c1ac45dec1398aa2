//! The blur of a photograph's edges.
//!
//! A step edge blurred by sigma has a gradient of 1 / sigma at its middle; blurred once more by one known width s it
//! has 1 / sqrt(sigma^2 + s^2). The ratio of both gradients R gives sigma = s / sqrt(R^2 - 1) (Zhuo and Sim 2011). The
//! estimate is the median over the strongest gradients, after a first blur against noise, whose variance is subtracted.
//! The second blur selects the gradients, since the first would favour those that noise raises.

/// Standard deviations of the first and the second blur, in pixels.
const FIRST: f64 = 1.0;
const SECOND: f64 = 1.5;
/// The variance of the gradient's support, a box two pixels wide.
const DIFFERENCE: f64 = 1.0 / 3.0;
/// The fraction of the pixels that count as edges.
const EDGES: f64 = 0.01;

/// The blur of the edges of a luminance plane as the standard deviation of a Gaussian, in pixels; `None` without edges.
/// A sharp photograph has about half a pixel.
pub(super) fn blur(luminance: &[f32], width: usize) -> Option<f64> {
    let height = luminance.len() / width.max(1);
    if width.min(height) < 16 {
        return None;
    }
    let first = blurred(luminance, width, FIRST);
    let second = blurred(&first, width, SECOND);
    let gradient = |plane: &[f32], index: usize| {
        let (dx, dy) =
            (plane[index + 1] - plane[index - 1], plane[index + width] - plane[index - width]);
        [f64::from(dx), f64::from(dy)]
    };
    let square = |[dx, dy]: [f64; 2]| dx * dx + dy * dy;
    let mut edges: Vec<(f64, usize)> = Vec::with_capacity((width - 8) * (height - 8));
    for first in (4..height - 4).map(|y| y * width) {
        let inside = first + 4..first + width - 4;
        edges.extend(inside.map(|index| (square(gradient(&second, index)), index)));
    }
    let count = ((edges.len() as f64 * EDGES) as usize).max(1).min(edges.len());
    edges.select_nth_unstable_by(count - 1, |a, b| b.0.total_cmp(&a.0));
    let length = |plane, index| {
        let [dx, dy] = gradient(plane, index);
        dx.hypot(dy)
    };
    let of_edge = |&(_, index): &(f64, usize)| (length(&first, index), length(&second, index));
    let lengths = edges[..count].iter().map(of_edge).filter(|(_, blurred)| *blurred > 1e-6);
    let mut ratios: Vec<f64> = lengths.map(|(sharp, blurred)| sharp / blurred).collect();
    if ratios.is_empty() {
        return None;
    }
    ratios.sort_unstable_by(f64::total_cmp);
    let ratio = ratios[ratios.len() / 2].max(1.0 + 1e-6);
    let variance = SECOND * SECOND / (ratio * ratio - 1.0) - FIRST * FIRST - DIFFERENCE;
    Some(variance.max(0.0).sqrt())
}

/// A Gaussian blur with clamped borders.
fn blurred(plane: &[f32], width: usize, sigma: f64) -> Vec<f32> {
    let reach = (3.0 * sigma).ceil() as isize;
    let mut kernel: Vec<f32> =
        (-reach..=reach).map(|x| (-0.5 * (x as f64 / sigma).powi(2)).exp() as f32).collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|weight| *weight /= sum);
    let height = plane.len() / width;
    let reach = reach as usize;
    let mut across = Vec::with_capacity(plane.len());
    for row in plane.chunks_exact(width) {
        let mut padded = vec![row[0]; reach];
        padded.extend_from_slice(row);
        padded.extend(std::iter::repeat_n(row[width - 1], reach));
        across.extend(weighted(&kernel, width, |tap| &padded[tap..][..width]));
    }
    let mut down = Vec::with_capacity(plane.len());
    for y in 0..height {
        let row = |tap: usize| &across[(y + tap).saturating_sub(reach).min(height - 1) * width..];
        down.extend(weighted(&kernel, width, row));
    }
    down
}

/// The sum of a row for each tap of the kernel, each with its weight.
fn weighted<'a>(kernel: &[f32], width: usize, row: impl Fn(usize) -> &'a [f32]) -> Vec<f32> {
    let mut sums = vec![0.0; width];
    for (tap, weight) in kernel.iter().enumerate() {
        for (sum, value) in sums.iter_mut().zip(row(tap)) {
            *sum += weight * value;
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::random::Stream;

    #[test]
    fn the_blur_of_an_edge_is_found_despite_noise() {
        let (width, height) = (96, 64);
        let stream = Stream::new(1, 0);
        for sigma in [1.0, 2.0, 4.0] {
            let step: Vec<f32> =
                (0..width * height).map(|i| if i % width < 48 { 0.2 } else { 0.8 }).collect();
            let mut plane = blurred(&step, width, sigma);
            for (index, value) in plane.iter_mut().enumerate() {
                *value += 0.01 * stream.normal(index as u64) as f32;
            }
            let found = blur(&plane, width).unwrap();
            assert!((found / sigma - 1.0).abs() < 0.15, "{sigma}: {found}");
        }
    }

    #[test]
    fn a_sharp_edge_has_half_a_pixel_of_blur_and_a_flat_plane_no_estimate() {
        let step: Vec<f32> = (0..96 * 64).map(|i| if i % 96 < 48 { 0.2 } else { 0.8 }).collect();
        assert!(blur(&step, 96).unwrap() < 0.7);
        assert_eq!(blur(&[0.5; 96 * 64], 96), None);
        assert_eq!(blur(&[0.5; 9], 3), None);
    }
}
