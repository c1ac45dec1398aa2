//! What is burnt into photographs: a date, a logo, the overlay of a thermal camera. In nearly all views it has the same
//! edges at the same position, while the rest of the image moves.

use std::ops::Range;

use super::{BLOCK, PixelGrid, REACH, SOMETHING};

/// How many photographs of a size are needed.
const NEEDED: usize = 6;
/// Cells along the longer side, and their smallest side in pixels.
const CELLS: usize = 32;
const MIN_CELL: usize = 8;
/// The smallest difference between the values of a cell with text.
const MIN_CONTRAST: f32 = 0.15;
/// The difference from the cell's median that makes a pixel one of its marks, and that of a pixel which is the same in
/// another view, as parts of the contrast.
const MARK: f32 = 0.3;
const SAME: f32 = 0.2;
/// The smallest share of marks in a cell, against hot pixels, and the most pixels that change, per mark.
const MIN_MARKS: f64 = 0.05;
const MAX_CHANGED: f64 = 1.0 / 3.0;
/// The share of the views that may differ.
const MAX_OTHERS: f64 = 0.1;
/// The fewest cells of an overlay, and the largest share of a photograph.
const MIN_CELLS: usize = 3;
const MAX_AREA: f64 = 0.25;
/// Between views that move, the means of other cells differ by at least this part of their differences in one view.
const MIN_MOVED: f64 = 0.2;
/// A line is a bar around the text if this share of its values is black.
const BAR: f64 = 0.95;
/// Beside static text, text that changes has at least this part of its contrast in half of the views.
const LIVELY: f32 = 0.6;

/// Pixels that an overlay covers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Overlay {
    pub(super) rows: Range<usize>,
    pub(super) columns: Range<usize>,
    cells: usize,
}

impl Overlay {
    fn pixels(&self, width: usize) -> impl Iterator<Item = usize> + use<> {
        let columns = self.columns.clone();
        self.rows.clone().flat_map(move |y| columns.clone().map(move |x| y * width + x))
    }

    fn joined(&self, other: &Self) -> Self {
        let hull = |a: &Range<usize>, b: &Range<usize>| a.start.min(b.start)..a.end.max(b.end);
        Self {
            rows: hull(&self.rows, &other.rows),
            columns: hull(&self.columns, &other.columns),
            cells: self.cells + other.cells,
        }
    }

    /// Whether both are of one line of text: its digits change.
    fn is_beside(&self, other: &Self, cell: usize, width: usize) -> bool {
        let gap = |a: &Range<usize>, b: &Range<usize>| {
            a.start.saturating_sub(b.end).max(b.start.saturating_sub(a.end))
        };
        gap(&self.rows, &other.rows) <= cell && gap(&self.columns, &other.columns) <= width / 3
    }
}

/// A cell with marks in the first view.
struct MarkedCell {
    area: Overlay,
    contrast: f32,
    marks: usize,
    /// The views in which it is another.
    others: usize,
}

/// The overlays of photographs of one size; `plane` gives the largest channel of every pixel of one of them. Without
/// an overlay, one or two photographs are looked at.
pub(super) fn overlays<'a>(
    count: usize,
    plane: impl Fn(usize) -> Option<&'a [f32]>,
    grid: &PixelGrid,
) -> Vec<Overlay> {
    let Some(first) = plane(0).filter(|_| count >= NEEDED) else { return vec![] };
    let side = grid.width.max(grid.height).div_ceil(CELLS).max(MIN_CELL);
    let cells = cells(grid, side);
    let marked = |area: &Overlay| MarkedCell::new(first, area, grid.width);
    let mut marked: Vec<MarkedCell> = cells.iter().filter_map(marked).collect();
    let (mut views, most) = (vec![first], (MAX_OTHERS * count as f64) as usize);
    for index in 1..count {
        if marked.is_empty() {
            return vec![];
        }
        let Some(view) = plane(index) else { continue };
        marked.retain_mut(|cell| {
            cell.others += usize::from(!cell.is_same(first, view, grid.width));
            cell.others <= most
        });
        views.push(view);
    }
    let areas: Vec<Overlay> = marked.into_iter().map(|cell| cell.area).collect();
    let others: Vec<&Overlay> = cells.iter().filter(|cell| !areas.contains(cell)).collect();
    if views.len() < NEEDED || !is_moving(&views, &others, grid.width) {
        return vec![];
    }
    let mut found = joined(areas, side, grid.width);
    found.retain(|overlay| overlay.cells >= MIN_CELLS);
    found.iter_mut().for_each(|overlay| OverlayViews { views: &views, grid }.fit(overlay, side));
    let area: usize = found.iter().map(|one| one.rows.len() * one.columns.len()).sum();
    if area as f64 > MAX_AREA * grid.len() as f64 { vec![] } else { found }
}

fn cells(grid: &PixelGrid, side: usize) -> Vec<Overlay> {
    let range = |at: usize, end: usize| at..(at + side).min(end);
    let cell = |y: usize, x: usize| Overlay {
        rows: range(y, grid.height),
        columns: range(x, grid.width),
        cells: 1,
    };
    let rows = (0..grid.height).step_by(side);
    rows.flat_map(|y| (0..grid.width).step_by(side).map(move |x| cell(y, x))).collect()
}

impl MarkedCell {
    fn new(view: &[f32], area: &Overlay, width: usize) -> Option<Self> {
        let mut values: Vec<f32> = area.pixels(width).map(|pixel| view[pixel]).collect();
        let contrast = contrast(values.iter().copied());
        if contrast < MIN_CONTRAST {
            return None;
        }
        let middle = values.len() / 2;
        let median = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
        let is_mark = |value: &&f32| (**value - median).abs() > MARK * contrast;
        let marks = values.iter().filter(is_mark).count();
        let is_text = marks as f64 >= MIN_MARKS * values.len() as f64;
        is_text.then(|| Self { area: area.clone(), contrast, marks, others: 0 })
    }

    fn is_same(&self, first: &[f32], view: &[f32], width: usize) -> bool {
        let is_changed = |&pixel: &usize| (view[pixel] - first[pixel]).abs() > SAME * self.contrast;
        let changed = self.area.pixels(width).filter(is_changed).count();
        changed as f64 <= MAX_CHANGED * self.marks as f64
    }
}

fn contrast(values: impl Iterator<Item = f32>) -> f32 {
    let [least, most] = values
        .fold([f32::INFINITY, f32::NEG_INFINITY], |[a, b], value| [a.min(value), b.max(value)]);
    most - least
}

/// Whether the means of cells change between the views.
fn is_moving(views: &[&[f32]], cells: &[&Overlay], width: usize) -> bool {
    let means = |view: &[f32]| -> Vec<f64> {
        let mean = |cell: &&Overlay| {
            let sum: f64 = cell.pixels(width).map(|pixel| f64::from(view[pixel])).sum();
            sum / (cell.rows.len() * cell.columns.len()) as f64
        };
        cells.iter().map(mean).collect()
    };
    let first = means(views[0]);
    let mean = first.iter().sum::<f64>() / first.len().max(1) as f64;
    let within: f64 = first.iter().map(|one| (one - mean).abs()).sum();
    let between =
        |view: &&[f32]| -> f64 { means(view).iter().zip(&first).map(|(a, b)| (a - b).abs()).sum() };
    let mut moved: Vec<f64> = views[1..].iter().map(between).collect();
    moved.sort_unstable_by(f64::total_cmp);
    moved[moved.len() / 2] >= MIN_MOVED * within && within > 0.0
}

/// Overlays of one line of text become one.
fn joined(mut found: Vec<Overlay>, cell: usize, width: usize) -> Vec<Overlay> {
    let mut index = 0;
    while index < found.len() {
        let later = (index + 1..found.len())
            .find(|&later| found[index].is_beside(&found[later], cell, width));
        match later {
            Some(later) => {
                let later = found.remove(later);
                found[index] = found[index].joined(&later);
                // A larger one may reach those before it.
                index = 0;
            }
            None => index += 1,
        }
    }
    found
}

/// The views that show an overlay.
struct OverlayViews<'a> {
    views: &'a [&'a [f32]],
    grid: &'a PixelGrid,
}

impl OverlayViews<'_> {
    /// Fits an overlay of whole cells to its text, the text that changes beside it, and the bar around both.
    fn fit(&self, overlay: &mut Overlay, cell: usize) {
        let PixelGrid { width, height } = *self.grid;
        let contrast = self.contrast(overlay, 0);
        let is_plain = |line: &Overlay| self.contrast(line, 0) < MARK * contrast;
        for side in SIDES {
            while overlay.rows.len() > 1
                && overlay.columns.len() > 1
                && is_plain(&side.last(overlay))
            {
                side.shrink(overlay);
            }
        }
        for side in [Side::Left, Side::Right] {
            while let Some(next) = side.next(overlay, cell, (width, height)) {
                let views = 0..self.views.len();
                let dull = views.filter(|&view| self.contrast(&next, view) < LIVELY * contrast);
                if 2 * dull.count() > self.views.len() {
                    break;
                }
                *overlay = overlay.joined(&next);
            }
        }
        for side in SIDES {
            let most = match side {
                Side::Left | Side::Right => width,
                Side::Top | Side::Bottom => overlay.rows.len(),
            };
            for step in 0..most {
                let next = side.next(overlay, 1, (width, height));
                let Some(next) = next.filter(|next| self.is_bar(next, step < BLOCK)) else { break };
                *overlay = overlay.joined(&next);
            }
        }
        for side in SIDES {
            if let Some(next) = side.next(overlay, REACH, (width, height)) {
                *overlay = overlay.joined(&next);
            }
        }
    }

    fn contrast(&self, area: &Overlay, view: usize) -> f32 {
        contrast(area.pixels(self.grid.width).map(|pixel| self.views[view][pixel]))
    }

    /// Whether a line is black in the views; JPEG turns black beside text into something.
    fn is_bar(&self, line: &Overlay, is_beside_text: bool) -> bool {
        let most = if is_beside_text { 1.5 * SOMETHING } else { 0.625 * SOMETHING };
        let black = |view: &&[f32]| {
            line.pixels(self.grid.width).filter(|&pixel| view[pixel] <= most).count()
        };
        let count = self.views.len() * line.rows.len() * line.columns.len();
        self.views.iter().map(black).sum::<usize>() as f64 >= BAR * count as f64
    }
}

#[derive(Clone, Copy)]
enum Side {
    Left,
    Right,
    Top,
    Bottom,
}

const SIDES: [Side; 4] = [Side::Left, Side::Right, Side::Top, Side::Bottom];

impl Side {
    /// The line at this side of an area.
    fn last(self, area: &Overlay) -> Overlay {
        let Overlay { mut rows, mut columns, .. } = area.clone();
        match self {
            Self::Left => columns.end = columns.start + 1,
            Self::Right => columns.start = columns.end - 1,
            Self::Top => rows.end = rows.start + 1,
            Self::Bottom => rows.start = rows.end - 1,
        }
        Overlay { rows, columns, cells: 0 }
    }

    fn shrink(self, area: &mut Overlay) {
        match self {
            Self::Left => area.columns.start += 1,
            Self::Right => area.columns.end -= 1,
            Self::Top => area.rows.start += 1,
            Self::Bottom => area.rows.end -= 1,
        }
    }

    /// The next `reach` lines beyond this side; `None` at the edge of the image.
    fn next(
        self,
        area: &Overlay,
        reach: usize,
        (width, height): (usize, usize),
    ) -> Option<Overlay> {
        let Overlay { mut rows, mut columns, .. } = area.clone();
        let before = |range: &Range<usize>| range.start.saturating_sub(reach)..range.start;
        let after = |range: &Range<usize>, end: usize| range.end..(range.end + reach).min(end);
        match self {
            Self::Left => columns = before(&columns),
            Self::Right => columns = after(&columns, width),
            Self::Top => rows = before(&rows),
            Self::Bottom => rows = after(&rows, height),
        }
        (!rows.is_empty() && !columns.is_empty()).then_some(Overlay { rows, columns, cells: 0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: PixelGrid = PixelGrid { width: 160, height: 96 };

    /// A scene that moves by `shift` pixels a view, with a bar of text in its last rows.
    fn views(count: usize, shift: usize, has_text: bool) -> Vec<Vec<f32>> {
        let scene = |x: usize, y: usize| 0.02 + 0.3 * ((x / 9 * 7 + y / 7 * 13) % 11) as f32 / 11.0;
        let text = |x: usize, y: usize| f32::from(u8::from(x % 5 < 2 && y % 6 < 4));
        let view = |view: usize| {
            let pixel = |index: usize| {
                let (x, y) = (index % GRID.width, index / GRID.width);
                match (has_text && y >= 80, x) {
                    (false, _) => scene(x + shift * view, y + shift * view),
                    // The digits at the end change.
                    (true, 64..94) if (83..93).contains(&y) => text(x + view, y),
                    (true, ..64) if (83..93).contains(&y) => text(x, y),
                    (true, _) => 0.0,
                }
            };
            (0..GRID.len()).map(pixel).collect()
        };
        (0..count).map(view).collect()
    }

    fn found(views: &[Vec<f32>]) -> Vec<Overlay> {
        overlays(views.len(), |index| views.get(index).map(Vec::as_slice), &GRID)
    }

    #[test]
    fn a_date_is_found_with_its_bar_and_the_digits_that_change() {
        let found = found(&views(8, 17, true));
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!((found[0].rows.clone(), found[0].columns.clone()), (78..96, 0..160));
    }

    #[test]
    fn nothing_is_found_without_text_in_few_views_on_a_tripod_or_for_hot_pixels() {
        assert_eq!(found(&views(8, 17, false)), []);
        assert_eq!(found(&views(5, 17, true)), [], "few views");
        assert_eq!(found(&views(8, 0, true)), [], "a tripod");
        assert_eq!(found(&views(8, 0, false)), [], "a tripod");
        let mut hot = views(8, 17, false);
        for view in &mut hot {
            view.iter_mut().step_by(97).for_each(|value| *value = 1.0);
        }
        assert_eq!(found(&hot), [], "hot pixels");
        assert_eq!(found(&vec![vec![0.0; GRID.len()]; 8]), [], "black");
    }

    #[test]
    fn without_an_overlay_few_photographs_are_looked_at() {
        let views = views(8, 17, false);
        let looked_at = std::cell::Cell::new(0);
        let plane = |index: usize| {
            looked_at.set(looked_at.get().max(index + 1));
            Some(views[index].as_slice())
        };
        overlays(8, plane, &GRID);
        assert!(looked_at.get() <= 3, "{looked_at:?}");
    }
}
