//! Exact nearest neighbours.

use std::ops::Range;

use glam::DVec3;

/// A balanced k-d tree without nodes: the median of every range splits the others along the axis of their largest
/// extent; those before it are not above it, those after it not below it.
pub(super) struct Neighbours {
    /// With the place of each in the list that was given.
    positions: Vec<(DVec3, u32)>,
    /// The axis along which each position splits its range.
    axes: Vec<usize>,
}

impl Neighbours {
    /// All positions must be finite.
    pub(super) fn new(positions: Vec<DVec3>) -> Self {
        let mut positions: Vec<(DVec3, u32)> = positions.into_iter().zip(0..).collect();
        let mut axes = vec![0; positions.len()];
        split(&mut positions, &mut axes);
        Self { positions, axes }
    }

    /// The nearest positions to `place`, sorted by squared distance; infinity where there are no more.
    pub(super) fn nearest<const COUNT: usize>(&self, point: DVec3) -> [(f64, DVec3); COUNT] {
        self.find(point).map(|(squared, slot)| {
            (squared, self.positions.get(slot).map_or(DVec3::INFINITY, |(position, _)| *position))
        })
    }

    /// The indices of the nearest positions in the list that was given; there can be fewer.
    pub(super) fn nearest_indices<const COUNT: usize>(&self, point: DVec3) -> Vec<u32> {
        let found = self.find::<COUNT>(point).into_iter();
        found.filter_map(|(_, slot)| Some(self.positions.get(slot)?.1)).collect()
    }

    /// Squared distances and slots, sorted; beyond the last slot where there are no more.
    fn find<const COUNT: usize>(&self, point: DVec3) -> [(f64, usize); COUNT] {
        let mut found = [(f64::INFINITY, usize::MAX); COUNT];
        self.search(0..self.positions.len(), point, &mut found);
        found
    }

    fn search(&self, range: Range<usize>, point: DVec3, found: &mut [(f64, usize)]) {
        if range.is_empty() {
            return;
        }
        let middle = range.start + range.len() / 2;
        let (position, _) = self.positions[middle];
        let mut candidate = (point.distance_squared(position), middle);
        for slot in found.iter_mut() {
            if candidate.0 < slot.0 {
                std::mem::swap(slot, &mut candidate);
            }
        }
        let axis = self.axes[middle];
        let beyond = point[axis] - position[axis];
        let (below, above) = (range.start..middle, middle + 1..range.end);
        let (near, far) = if beyond < 0.0 { (below, above) } else { (above, below) };
        self.search(near, point, found);
        // Rounding is monotone: no squared distance is below that of its component along one axis.
        if found.last().is_some_and(|(farthest, _)| beyond * beyond < *farthest) {
            self.search(far, point, found);
        }
    }
}

fn split(positions: &mut [(DVec3, u32)], axes: &mut [usize]) {
    let Some(&(first, _)) = positions.first() else { return };
    let bounds =
        |(low, high): (DVec3, DVec3), &(point, _): &(DVec3, u32)| (low.min(point), high.max(point));
    let (low, high) = positions.iter().fold((first, first), bounds);
    let axis = (high - low).max_position();
    let middle = positions.len() / 2;
    positions.select_nth_unstable_by(middle, |(a, _), (b, _)| a[axis].total_cmp(&b[axis]));
    axes[middle] = axis;
    let ((below, above), (axes_below, axes_above)) =
        (positions.split_at_mut(middle), axes.split_at_mut(middle));
    split(below, axes_below);
    split(&mut above[1..], &mut axes_above[1..]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::random::Stream;

    #[test]
    fn the_nearest_are_those_of_an_exhaustive_search() {
        let draws = Stream::new(7, 0);
        for count in [0, 1, 2, 3, 7, 64, 1000] {
            // On a grid, many are equidistant, and many share a coordinate with their splitting position.
            for grid in [1e-9, 0.25] {
                let axis = |draw: u64| (4.0 * draws.uniform(draw) / grid).round() * grid;
                let position = |i: u64| DVec3::from_array([0, 1, 2].map(|k| axis(3 * i + k)));
                let positions: Vec<DVec3> = (0..count).map(position).collect();
                let tree = Neighbours::new(positions.clone());
                for point in (count..count + 50).map(position).chain(positions.iter().copied()) {
                    let squared = positions.iter().map(|other| point.distance_squared(*other));
                    let mut expected: Vec<f64> = squared.chain([f64::INFINITY; 4]).collect();
                    expected.sort_by(f64::total_cmp);
                    let found = tree.nearest::<4>(point);
                    let indices = tree.nearest_indices::<4>(point);
                    assert_eq!(indices.len(), positions.len().min(4));
                    for (index, (_, position)) in indices.into_iter().zip(found) {
                        assert_eq!(positions[index as usize], position, "{count}, {grid}");
                    }
                    assert_eq!(found.map(|(squared, _)| squared), expected[..4], "{count}, {grid}");
                    for (squared, position) in found.into_iter().filter(|found| found.0.is_finite())
                    {
                        assert_eq!(point.distance_squared(position), squared, "{count}, {grid}");
                    }
                }
            }
        }
    }
}
