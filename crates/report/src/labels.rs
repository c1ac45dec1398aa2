//! Text in a chart: labels beside points, which do not overlap.

use glam::{DVec2, dvec2};

use super::escape;

/// A text as an SVG element.
pub(super) fn text(at: DVec2, style: &str, content: &str) -> String {
    let DVec2 { x, y } = at;
    format!("<text x=\"{x:.1}\" y=\"{y:.1}\"{style}>{}</text>", escape(content))
}

/// The number of letters of a name.
pub(super) fn letters(name: &str) -> usize {
    name.chars().count()
}

/// The boxes that points and labels take: their lower and their upper corner.
pub(super) struct Labels {
    taken: Vec<[DVec2; 2]>,
    /// The right end and the bottom of the drawing.
    area: DVec2,
}

impl Labels {
    pub(super) fn around(points: impl Iterator<Item = DVec2>, area: DVec2) -> Self {
        Self { taken: points.map(|at| [at - 5.0, at + 5.0]).collect(), area }
    }

    /// A label beside a point, at a free place if there is one. At the end of a line, it is rather on the right.
    pub(super) fn label(&mut self, at: DVec2, name: &str, style: &str, ends_line: bool) -> String {
        // The maximum width of a semibold letter of the page's font.
        let width = 8.4 * letters(name) as f64;
        let mut sides = [8.0, -8.0 - width];
        if !ends_line {
            sides.reverse();
        }
        let beside = |down: f64| sides.map(|right| at + dvec2(right, down));
        let middle = |down: f64| at + dvec2(-width / 2.0, down);
        let mut places: Vec<DVec2> = beside(4.0).to_vec();
        places.extend([-9.0, 18.0].map(middle));
        places.extend([-7.0, 15.0, -18.0, 26.0, -29.0, 37.0].into_iter().flat_map(beside));
        let corners = |base: DVec2| [base - dvec2(0.0, 10.0), base + dvec2(width, 3.0)];
        let is_free = |base: &&DVec2| {
            let [low, high] = corners(**base);
            let is_inside =
                low.cmpge(dvec2(0.0, 16.0)).all() && high.cmple(self.area + dvec2(0.0, 4.0)).all();
            let meets = |[other_low, other_high]: &[DVec2; 2]| {
                low.cmplt(*other_high).all() && other_low.cmplt(high).all()
            };
            is_inside && !self.taken.iter().any(meets)
        };
        let base = places.iter().find(is_free).copied().unwrap_or(places[0]);
        self.taken.push(corners(base));
        text(base, &format!(" class=\"label\"{style}"), name)
    }
}
