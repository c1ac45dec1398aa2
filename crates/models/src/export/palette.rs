//! Quantisation by codebooks: 256 scalars, or a palette of vectors.

use std::ops::Range;

/// The numbers in a codebook.
const CODES: usize = 256;

/// A codebook of 256 ascending values: one-dimensional k-means, initialised with quantiles.
pub(super) fn codebook(values: impl Iterator<Item = f32>) -> Vec<f32> {
    const ROUNDS: usize = 24;
    let mut sorted: Vec<f32> = values.collect();
    sorted.sort_unstable_by(f32::total_cmp);
    if sorted.is_empty() {
        return vec![0.0; CODES];
    }
    let mut sums = vec![0.0];
    for value in &sorted {
        sums.push(sums[sums.len() - 1] + f64::from(*value));
    }
    let share = |code: usize| sorted[(2 * code + 1) * sorted.len() / (2 * CODES)];
    let mut codes: Vec<f32> = (0..CODES).map(share).collect();
    for _ in 0..ROUNDS {
        let mut begin = 0;
        for code in 0..CODES {
            let end = match codes.get(code + 1) {
                Some(next) => {
                    let middle = f64::midpoint(codes[code].into(), f64::from(*next));
                    begin + sorted[begin..].partition_point(|&value| f64::from(value) <= middle)
                }
                None => sorted.len(),
            };
            if end > begin {
                codes[code] = ((sums[end] - sums[begin]) / (end - begin) as f64) as f32;
            }
            begin = end;
        }
        codes.sort_unstable_by(f32::total_cmp);
    }
    codes
}

/// The index of the nearest code.
pub(super) fn nearest(codes: &[f32], value: f32) -> u8 {
    let above = codes.partition_point(|&code| code < value).min(codes.len() - 1);
    let below = above.saturating_sub(1);
    if (codes[above] - value).abs() < (value - codes[below]).abs() {
        above as u8
    } else {
        below as u8
    }
}

/// A palette of at most `size` vectors of `width`, and the index into it for each of `points`. The cell of the largest
/// error is split next, at its mean, across the axis of its largest variance.
pub(super) fn vectors(points: &[f32], width: usize, size: usize) -> (Vec<f32>, Vec<u32>) {
    let count = points.len() / width;
    let mut order: Vec<u32> = (0..count as u32).collect();
    let mut heap = std::collections::BinaryHeap::new();
    if count > 0 {
        heap.push(Cluster::new(points, width, &order, 0..count));
    }
    while heap.len() < size {
        let Some(cell) = heap.pop() else { break };
        if cell.error <= 0.0 {
            heap.push(cell);
            break;
        }
        let part = &mut order[cell.range.clone()];
        let value = |point: u32| points[width * point as usize + cell.axis];
        // A stable sort gives the same cells on every machine.
        part.sort_by_key(|&point| value(point) > cell.mean);
        let middle = cell.range.start + part.partition_point(|&point| value(point) <= cell.mean);
        if middle == cell.range.start || middle == cell.range.end {
            heap.push(Cluster { error: 0.0, ..cell });
            continue;
        }
        for range in [cell.range.start..middle, middle..cell.range.end] {
            heap.push(Cluster::new(points, width, &order, range));
        }
    }
    let mut cells = heap.into_vec();
    cells.sort_unstable_by_key(|cell| cell.range.start);
    let (mut means, mut labels) = (Vec::with_capacity(width * cells.len()), vec![0; count]);
    for (label, cell) in cells.iter().enumerate() {
        let members = &order[cell.range.clone()];
        members.iter().for_each(|&point| labels[point as usize] = label as u32);
        means.extend((0..width).map(|axis| moments(points, width, members, axis).0 as f32));
    }
    (means, labels)
}

/// A subset of the points.
struct Cluster {
    range: Range<usize>,
    /// The axis of the largest variance, with the mean along it and the sum of squared distances to the mean.
    axis: usize,
    mean: f32,
    error: f64,
}

impl Cluster {
    fn new(points: &[f32], width: usize, order: &[u32], range: Range<usize>) -> Self {
        let members = &order[range.clone()];
        let (axis, (mean, error)) = (0..width)
            .map(|axis| (axis, moments(points, width, members, axis)))
            .fold((0, (0.0, -1.0)), |best, next| if next.1.1 > best.1.1 { next } else { best });
        Self { range, axis, mean: mean as f32, error }
    }
}

/// Mean, and the sum of squared distances to it.
fn moments(points: &[f32], width: usize, members: &[u32], axis: usize) -> (f64, f64) {
    let value = |&point: &u32| f64::from(points[width * point as usize + axis]);
    let mean = members.iter().map(value).sum::<f64>() / members.len().max(1) as f64;
    (mean, members.iter().map(|point| (value(point) - mean).powi(2)).sum())
}

impl Ord for Cluster {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.error.total_cmp(&other.error).then(other.range.start.cmp(&self.range.start))
    }
}

impl PartialOrd for Cluster {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Cluster {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Cluster {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_values_are_kept_and_many_are_near_their_code() {
        let small = codebook([3.0, -1.0, 3.0, 0.5].into_iter());
        for value in [3.0, -1.0, 0.5] {
            assert_eq!(small[usize::from(nearest(&small, value))], value);
        }
        let many: Vec<f32> = (0..10_000).map(|i| (i as f32 / 10_000.0).powi(3)).collect();
        let codes = codebook(many.iter().copied());
        let error = many.iter().map(|&v| (codes[usize::from(nearest(&codes, v))] - v).abs());
        let mean = error.sum::<f32>() / 10_000.0;
        assert!(mean < 1.0 / 256.0 / 4.0, "{mean}");
        assert_eq!(codebook(std::iter::empty()), vec![0.0; 256]);
    }

    #[test]
    fn a_palette_keeps_every_point_if_it_can_and_clusters_them_otherwise() {
        let point =
            |i: usize| [(i % 4) as f32 * 10.0 + (i / 4) as f32 * 0.01, (i % 3) as f32 * 0.01];
        let points: Vec<f32> = (0..24).flat_map(point).collect();
        let (means, labels) = vectors(&points, 2, 100);
        for (i, &label) in labels.iter().enumerate() {
            assert_eq!(means[2 * label as usize..][..2], point(i), "{i}");
        }
        let (means, labels) = vectors(&points, 2, 4);
        assert_eq!(means.len(), 8);
        for (i, &label) in labels.iter().enumerate() {
            assert!((means[2 * label as usize] - point(i)[0]).abs() < 0.1, "{i}");
        }
        assert_eq!(vectors(&[], 2, 4), (vec![], vec![]));
    }
}
