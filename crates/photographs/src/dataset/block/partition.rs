//! Cells of a scene: a k-d tree over its points, split at weighted medians until every cell fits.
//!
//! The points are sorted by position alone, and sums are taken in that order: neither the order of the points in their
//! file nor the number of threads changes a bit.

use glam::DVec3;

use super::Cell;

/// The halo reaches this share of the core's side beyond each face of the core.
const HALO: f64 = 0.2;
/// A halo with fewer points in addition to those of the core is widened, up to [`WIDEST`].
const HALO_POINTS: usize = 200;
/// The largest share of the core's side that a halo reaches.
const WIDEST: f64 = 0.5;
/// An axis nearer to the up direction than this cosine is not split.
const UPRIGHT: f64 = 0.7;
/// A side of a cell is measured without this share of its points at either end.
const OUTLIERS: f64 = 0.02;

/// A point with its share of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeightedPoint {
    /// In world units.
    pub position: DVec3,
    /// What training on it costs, in any unit.
    pub weight: f64,
}

/// A cell with its surroundings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BlockCells {
    /// The cell; those of a scene do not overlap.
    pub core: Cell,
    /// The cell with its surroundings.
    pub halo: Cell,
    /// The weight of the points in core and halo, relative to all points.
    pub share: f64,
}

/// When to stop splitting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Until {
    /// There are this many cells.
    Count(usize),
    /// No cell with its halo has more than this share of the weight.
    Share(f64),
}

/// The cells of a scene, in the order of the tree; `None` if points at one place cannot be split further. `up` is the
/// scene's up direction.
pub fn partition(points: &[WeightedPoint], up: DVec3, until: Until) -> Option<Vec<BlockCells>> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| by_position(a, b, 0));
    let total: f64 = sorted.iter().map(|point| point.weight).sum();
    let mut leaves = vec![PartitionLeaf::new(sorted, Cell::WORLD, points, total)];
    loop {
        let next = match until {
            Until::Count(count) if leaves.len() >= count => None,
            // The first of the heaviest.
            Until::Count(_) => (0..leaves.len())
                .rev()
                .max_by(|&a, &b| leaves[a].part.share.total_cmp(&leaves[b].part.share)),
            Until::Share(most) => leaves.iter().position(|leaf| leaf.part.share > most),
        };
        let Some(at) = next else { break };
        let halves = leaves[at].halves(up)?;
        let new = halves.map(|(half, core)| PartitionLeaf::new(half, core, points, total));
        leaves.splice(at..=at, new);
    }
    Some(leaves.into_iter().map(|leaf| leaf.part).collect())
}

/// A cell that is not split yet.
struct PartitionLeaf {
    /// Its points, sorted by position.
    points: Vec<WeightedPoint>,
    part: BlockCells,
}

impl PartitionLeaf {
    fn new(points: Vec<WeightedPoint>, core: Cell, all: &[WeightedPoint], total: f64) -> Self {
        let mut reach = HALO;
        let sides = sides(&points);
        let within = |halo: &Cell| all.iter().filter(|point| halo.contains(point.position)).count();
        let mut halo = widened(&core, sides, reach);
        while reach < WIDEST && core != Cell::WORLD && within(&halo) < points.len() + HALO_POINTS {
            reach = (1.5 * reach).min(WIDEST);
            halo = widened(&core, sides, reach);
        }
        let mut inside: Vec<WeightedPoint> =
            all.iter().filter(|point| halo.contains(point.position)).copied().collect();
        inside.sort_by(|a, b| by_position(a, b, 0));
        let share = inside.iter().map(|point| point.weight).sum::<f64>() / total;
        Self { points, part: BlockCells { core, halo, share } }
    }

    /// The halves at the weighted median of the longest horizontal axis on which the points differ.
    fn halves(&self, up: DVec3) -> Option<[(Vec<WeightedPoint>, Cell); 2]> {
        let sides = sides(&self.points);
        let is_horizontal = |axis: &usize| up.to_array()[*axis].abs() <= UPRIGHT * up.length();
        let mut axes: Vec<usize> = (0..3).collect();
        axes.sort_by(|&a, &b| {
            let rank = |axis: usize| (is_horizontal(&axis), sides[axis]);
            let (a, b) = (rank(a), rank(b));
            b.0.cmp(&a.0).then(b.1.total_cmp(&a.1))
        });
        axes.into_iter().find_map(|axis| self.halves_along(axis))
    }

    /// `None` if all points have one coordinate on the axis.
    fn halves_along(&self, axis: usize) -> Option<[(Vec<WeightedPoint>, Cell); 2]> {
        let coordinate = |point: &WeightedPoint| point.position.to_array()[axis];
        let mut sorted = self.points.clone();
        sorted.sort_by(|a, b| by_position(a, b, axis));
        let (first, half) =
            (sorted.first()?, sorted.iter().map(|point| point.weight).sum::<f64>() / 2.0);
        let mut before = 0.0;
        let median = sorted.iter().find(|point| {
            before += point.weight;
            before >= half
        });
        // The plane is at a point, which belongs to the upper half; the lower half must not be empty.
        let lowest = coordinate(first);
        let plane = median.map(coordinate).filter(|&at| at > lowest);
        let plane = plane.or_else(|| sorted.iter().map(coordinate).find(|&at| at > lowest))?;
        let (mut below, mut above) = (self.part.core, self.part.core);
        (below.to[axis], above.from[axis]) = (plane, plane);
        let (lower, upper) = self.points.iter().partition(|point| coordinate(point) < plane);
        Some([(lower, below), (upper, above)])
    }
}

/// Ascending by the coordinate on one axis, then by the others, then by weight.
fn by_position(a: &WeightedPoint, b: &WeightedPoint, axis: usize) -> std::cmp::Ordering {
    let key = |point: &WeightedPoint| {
        let at = point.position.to_array();
        [at[axis], at[(axis + 1) % 3], at[(axis + 2) % 3], point.weight]
    };
    let pairs = key(a).into_iter().zip(key(b));
    pairs
        .map(|(a, b)| a.total_cmp(&b))
        .find(|order| order.is_ne())
        .unwrap_or(std::cmp::Ordering::Equal)
}

/// The sides of a cell's points along the axes, without outliers.
fn sides(points: &[WeightedPoint]) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let mut coordinates: Vec<f64> =
            points.iter().map(|point| point.position.to_array()[axis]).collect();
        coordinates.sort_by(f64::total_cmp);
        let cut = (OUTLIERS * coordinates.len() as f64) as usize;
        match (coordinates.get(cut), coordinates.get(coordinates.len().saturating_sub(cut + 1))) {
            (Some(from), Some(to)) => to - from,
            _ => 0.0,
        }
    })
}

/// The cell, reaching a share of its sides beyond its faces.
fn widened(core: &Cell, sides: [f64; 3], reach: f64) -> Cell {
    let mut halo = *core;
    for (axis, side) in sides.into_iter().enumerate() {
        halo.from[axis] -= reach * side;
        halo.to[axis] += reach * side;
    }
    halo
}

#[cfg(test)]
mod tests {
    use super::*;
    use nightsplat_core::random::Stream;

    fn street(count: u64) -> Vec<WeightedPoint> {
        let stream = Stream::new(3, 1);
        let unit = |draw: u64| stream.bits(draw) as f64 / u64::MAX as f64;
        let point = |i: u64| WeightedPoint {
            position: DVec3::new(40.0 * unit(3 * i), unit(3 * i + 1), 4.0 * unit(3 * i + 2)),
            weight: 1.0 + (i % 3) as f64,
        };
        (0..count).map(point).collect()
    }

    #[test]
    fn every_point_is_in_one_core_and_cores_have_equal_weight() {
        let points = street(5000);
        let parts = partition(&points, DVec3::Y, Until::Count(4)).unwrap();
        assert_eq!(parts.len(), 4);
        for point in &points {
            let cores = parts.iter().filter(|part| part.core.contains(point.position));
            assert_eq!(cores.count(), 1);
        }
        for part in &parts {
            let inside = points.iter().filter(|point| part.core.contains(point.position));
            let weight: f64 = inside.map(|point| point.weight).sum();
            let total: f64 = points.iter().map(|point| point.weight).sum();
            assert!((weight / total - 0.25).abs() < 0.01, "{}", weight / total);
            assert!(part.share > 0.25 && part.share < 0.36, "{}", part.share);
            // Along the street alone.
            assert_eq!([part.core.from[1], part.core.from[2]], [f64::NEG_INFINITY; 2]);
        }
    }

    #[test]
    fn neither_the_order_of_points_nor_of_equal_ones_changes_a_bit() {
        let mut points = street(2000);
        points.extend_from_within(..500);
        let parts = partition(&points, DVec3::Y, Until::Count(8)).unwrap();
        let mut shuffled = points.clone();
        shuffled.reverse();
        shuffled.rotate_left(777);
        assert_eq!(partition(&shuffled, DVec3::Y, Until::Count(8)).unwrap(), parts);
    }

    #[test]
    fn cells_are_split_until_each_fits() {
        let parts = partition(&street(5000), DVec3::Y, Until::Share(0.2)).unwrap();
        assert!(parts.len() >= 6, "{}", parts.len());
        assert!(parts.iter().all(|part| part.share <= 0.2));
        let whole = partition(&street(100), DVec3::Y, Until::Share(1.0)).unwrap();
        assert_eq!(whole, [BlockCells { core: Cell::WORLD, halo: Cell::WORLD, share: 1.0 }]);
    }

    #[test]
    fn points_at_one_place_cannot_be_split() {
        let points = vec![WeightedPoint { position: DVec3::ONE, weight: 1.0 }; 50];
        assert_eq!(partition(&points, DVec3::Y, Until::Count(2)), None);
    }
}
