//! What stays in place in photographs that move, however dim it is: a dashboard at night, a date in grey.
//!
//! ```text
//! r = (var_x mean_v - mean_x var_v / n) / (mean_x var_v + rounding)    x: pixels of a cell; v: n views
//! ```
//!
//! r compares the contrast of the mean of the views, without what noise leaves of it, with the changes between views. A
//! scene that moves blurs its mean: r stays below .15 in photographs of rooms, plants and streets. What stays in place
//! exceeds .5 as soon as its contrast is that of the noise; black without contrast has 0. Gaps of what stays are
//! closed: a dashboard is dark between its instruments.

use super::PixelGrid;

/// How many photographs of a size are needed.
const NEEDED: usize = 6;
/// Cells along the longer side, and their smallest side in pixels.
const CELLS: usize = 64;
const MIN_CELL: usize = 8;
/// A region has cells above `SURE`, and extends over those above `LIKELY`.
const SURE: f64 = 0.5;
const LIKELY: f64 = 0.25;
/// The fewest cells of a region that are sure, and the largest share of a photograph.
const MIN_SURE: usize = 6;
const MAX_AREA: f64 = 0.5;
/// Gaps up to twice this number of cells are closed, to the edge of the image up to this number.
const GAP: usize = 4;
/// The share of a cell's pixels that do not count, farthest from its median: hot pixels stay in place, too.
const HOT: f64 = 0.05;
/// The variance of rounding to 8 bits.
const ROUNDING: f64 = 1.0 / (255.0 * 255.0 * 12.0);

/// The cells of an image, row by row.
struct StillCells {
    columns: usize,
    rows: usize,
    /// Of a cell, pixels.
    side: usize,
}

/// The pixels of images of one size that stay in place, of the largest channel of every pixel of each.
pub(super) fn still(planes: &[Vec<f32>], grid: &PixelGrid) -> Vec<usize> {
    if planes.len() < NEEDED {
        return vec![];
    }
    let side = grid.width.max(grid.height).div_ceil(CELLS).max(MIN_CELL);
    let [columns, rows] = [grid.width, grid.height].map(|length| length.div_ceil(side));
    let cells = StillCells { columns, rows, side };
    let ratios: Vec<f64> =
        (0..columns * rows).map(|cell| ratio(planes, &cells.pixels(cell, grid))).collect();
    let likely: Vec<bool> = ratios.iter().map(|&ratio| ratio > LIKELY).collect();
    let closed = cells.eroded(&cells.dilated(&likely, GAP), GAP);
    let regions = cells.regions(&closed, |cell| ratios[cell] > SURE);
    let masked = cells.dilated(&regions, 1);
    let of_cells = (0..masked.len()).filter(|&cell| masked[cell]);
    let mut pixels: Vec<usize> = of_cells.flat_map(|cell| cells.pixels(cell, grid)).collect();
    pixels.sort_unstable();
    // On a tripod, everything stays.
    if pixels.len() as f64 > MAX_AREA * grid.len() as f64 { vec![] } else { pixels }
}

/// r of a cell.
fn ratio(planes: &[Vec<f32>], pixels: &[usize]) -> f64 {
    let count = planes.len() as f64;
    let moments = |&pixel: &usize| {
        let values = || planes.iter().map(|plane| f64::from(plane[pixel]));
        let mean = values().sum::<f64>() / count;
        let variance = values().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0);
        (mean, variance)
    };
    let mut moments: Vec<(f64, f64)> = pixels.iter().map(moments).collect();
    moments.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let median = moments[moments.len() / 2].0;
    let off = |of: &(f64, f64)| (of.0 - median).abs();
    moments.sort_unstable_by(|a, b| off(a).total_cmp(&off(b)));
    moments.truncate(((1.0 - HOT) * moments.len() as f64).ceil() as usize);
    let mean_of = |of: &dyn Fn(&(f64, f64)) -> f64| {
        moments.iter().map(of).sum::<f64>() / moments.len() as f64
    };
    let (mean, changes) = (mean_of(&|one| one.0), mean_of(&|one| one.1));
    let contrast = mean_of(&|one| (one.0 - mean).powi(2));
    (contrast - changes / count) / (changes + ROUNDING)
}

impl StillCells {
    fn pixels(&self, cell: usize, grid: &PixelGrid) -> Vec<usize> {
        let [x, y] = [cell % self.columns, cell / self.columns].map(|at| at * self.side);
        let rows = y..(y + self.side).min(grid.height);
        let columns = x..(x + self.side).min(grid.width);
        rows.flat_map(|y| columns.clone().map(move |x| y * grid.width + x)).collect()
    }

    /// The cells up to `reach` away in both directions, and that itself.
    fn around(&self, cell: usize, reach: usize) -> impl Iterator<Item = usize> + use<> {
        let (x, y, columns) = (cell % self.columns, cell / self.columns, self.columns);
        let range = |at: usize, end: usize| at.saturating_sub(reach)..(at + reach + 1).min(end);
        let (rows, columns_near) = (range(y, self.rows), range(x, self.columns));
        rows.flat_map(move |y| columns_near.clone().map(move |x| y * columns + x))
    }

    fn dilated(&self, set: &[bool], reach: usize) -> Vec<bool> {
        (0..set.len()).map(|cell| self.around(cell, reach).any(|near| set[near])).collect()
    }

    /// What is beyond the image counts as set.
    fn eroded(&self, set: &[bool], reach: usize) -> Vec<bool> {
        (0..set.len()).map(|cell| self.around(cell, reach).all(|near| set[near])).collect()
    }

    /// The connected regions that have enough cells that are sure.
    fn regions(&self, set: &[bool], is_sure: impl Fn(usize) -> bool) -> Vec<bool> {
        let (mut is_reached, mut kept) = (vec![false; set.len()], vec![false; set.len()]);
        for first in 0..set.len() {
            let mut region = vec![];
            let mut open = vec![first];
            while let Some(cell) = open.pop() {
                if set[cell] && !std::mem::replace(&mut is_reached[cell], true) {
                    region.push(cell);
                    open.extend(self.around(cell, 1));
                }
            }
            if region.iter().filter(|&&cell| is_sure(cell)).count() >= MIN_SURE {
                region.into_iter().for_each(|cell| kept[cell] = true);
            }
        }
        kept
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: PixelGrid = PixelGrid { width: 400, height: 300 };
    /// A code of 8 bits.
    const CODE: f32 = 1.0 / 255.0;

    /// A reproducible value in -1 to 1.
    fn noise(seed: usize) -> f32 {
        let mut state = (seed as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        state ^= state >> 29;
        state = state.wrapping_mul(0xBF58_476D_1CE4_E5B9);
        ((state >> 40) as f32 / (1 << 23) as f32) - 1.0
    }

    /// Views of a scene that moves by `shift`, in codes with noise; from row 230 on, `still(x, y)`.
    fn views(shift: usize, still: Option<&dyn Fn(usize, usize) -> f32>) -> Vec<Vec<f32>> {
        let scene = |x: usize, y: usize| 3.0 + 30.0 * ((x / 9 * 7 + y / 7 * 13) % 11) as f32 / 11.0;
        let view = |view: usize| {
            let pixel = |index: usize| {
                let (x, y) = (index % GRID.width, index / GRID.width);
                let value = match still {
                    Some(still) if y >= 230 => still(x, y),
                    _ => scene(x + shift * view, y + shift * view),
                };
                CODE * (value + noise(view * GRID.len() + index)).round().max(0.0)
            };
            (0..GRID.len()).map(pixel).collect()
        };
        (0..8).map(view).collect()
    }

    /// Instruments of a few codes, with black between them.
    fn dashboard(x: usize, y: usize) -> f32 {
        let (dx, dy) = ((x % 80).abs_diff(40), y.abs_diff(265));
        let is_ring = (500..900).contains(&(dx * dx + dy * dy));
        if is_ring && (x + y) % 7 < 4 { 6.0 } else { 1.0 }
    }

    #[test]
    fn a_dashboard_of_a_few_codes_is_found_whole() {
        let found = still(&views(17, Some(&dashboard)), &GRID);
        let is_found = |x: usize, y: usize| found.binary_search(&(y * GRID.width + x)).is_ok();
        let inside = (0..GRID.len()).map(|pixel| (pixel % GRID.width, pixel / GRID.width));
        let ring = |&(x, y): &(usize, usize)| y >= 230 && dashboard(x, y) > 1.0;
        let missed = inside.clone().filter(ring).filter(|&(x, y)| !is_found(x, y)).count();
        assert_eq!(missed, 0);
        assert!(is_found(80, 265), "between two instruments");
        let beyond = inside.filter(|&(_, y)| y < 216).filter(|&(x, y)| is_found(x, y)).count();
        assert_eq!(beyond, 0);
    }

    #[test]
    fn a_scene_that_moves_black_hot_pixels_and_a_tripod_have_nothing_that_stays() {
        let found = |views: &[Vec<f32>]| still(views, &GRID).len();
        assert_eq!(found(&views(17, None)), 0, "a scene");
        let black = |view: usize| {
            let at = |pixel: usize| noise(view * GRID.len() + pixel) + 0.4;
            (0..GRID.len()).map(|pixel| CODE * at(pixel).round().max(0.0)).collect()
        };
        assert_eq!(found(&(0..8).map(black).collect::<Vec<Vec<f32>>>()), 0, "black");
        let mut hot = views(17, None);
        for view in &mut hot {
            view.iter_mut().step_by(499).for_each(|value| *value = 1.0);
        }
        assert_eq!(found(&hot), 0, "hot pixels");
        assert_eq!(found(&views(0, None)), 0, "a tripod");
        assert_eq!(found(&views(17, Some(&dashboard))[..5]), 0, "few views");
    }
}
