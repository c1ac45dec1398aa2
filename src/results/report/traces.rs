//! Runs of a batch in one drawing as inline SVG: final or intermediate results against their cost.
//!
//! Half as wide as other plots: two fit side by side, and one is readable on a phone.

use std::fmt::Write as _;

use super::axis::Axis;
use super::escape;

/// A run in a drawing.
#[derive(Clone, Debug, Default)]
pub struct Trace {
    /// Its label at the last point.
    pub name: String,
    /// The tooltip.
    pub title: String,
    /// The index of its colour, the same in every drawing of a page.
    pub color: usize,
    /// Whether it is a minor run, with a ring as its dot and a thin line.
    pub is_minor: bool,
    /// (x, y) in the order of x; points that are not finite, not above 0 in x or beyond 1e30 are omitted.
    pub points: Vec<(f64, f64)>,
}

/// The drawing area, SVG user units.
const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 290.0;
const LEFT: f64 = 54.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 34.0;

/// The colours that the page's style defines.
const COLORS: usize = 5;

/// Draws `y_name` against the logarithm of `x_name`: the line and the last point of each run, and below them the dotted
/// steps of the Pareto front, whose points are in the order of x.
pub fn traces(x_name: &str, y_name: &str, of: &[Trace], front: &[(f64, f64)]) -> String {
    // Written so that a NaN fails. The bound keeps differences finite.
    let is_drawable = |&(x, y): &(f64, f64)| x > 1e-9 && x <= 1e30 && y.abs() <= 1e30;
    let points = || of.iter().flat_map(|trace| trace.points.iter().copied()).filter(is_drawable);
    let x_axis = Axis::logarithmic(points().map(|(x, _)| x), LEFT, WIDTH - RIGHT);
    let y_axis = Axis::around(points().map(|(_, y)| y), HEIGHT - BOTTOM, TOP);
    let mut svg = format!(
        "<svg class=\"half\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{y} against {x}\" \
         font-size=\"12\" fill=\"var(--quiet)\">\n<text x=\"0\" y=\"14\">{y}</text>\
         <text x=\"{}\" y=\"{}\" text-anchor=\"end\">{x}</text>\n",
        WIDTH - RIGHT,
        HEIGHT - 5.0,
        x = escape(x_name),
        y = escape(y_name),
    );
    grid(&mut svg, &x_axis, &y_axis);
    let place = |&(x, y): &(f64, f64)| (x_axis.place(x), y_axis.place(y));
    let placed = |points: &[(f64, f64)]| -> Vec<(f64, f64)> {
        points.iter().filter(|point| is_drawable(point)).map(place).collect()
    };
    steps(&mut svg, &placed(front));
    let lines: Vec<Vec<(f64, f64)>> = of.iter().map(|trace| placed(&trace.points)).collect();
    let mut labels = Labels::around(lines.iter().filter_map(|line| line.last().copied()));
    for (trace, line) in of.iter().zip(&lines) {
        draw(&mut svg, trace, line, &mut labels);
    }
    svg.push_str("</svg>");
    svg
}

// Writing to a string cannot fail, so the results below are ignored.

fn grid(svg: &mut String, x_axis: &Axis, y_axis: &Axis) {
    for tick in y_axis.ticks() {
        let y = y_axis.place(tick);
        let _ = writeln!(
            svg,
            "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"var(--line)\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            WIDTH - RIGHT,
            LEFT - 6.0,
            y + 4.0,
            y_axis.label(tick)
        );
    }
    for tick in x_axis.ticks() {
        let (x, label) = (x_axis.place(tick), x_axis.label(tick));
        let y = HEIGHT - BOTTOM + 16.0;
        let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y}\" text-anchor=\"middle\">{label}</text>");
    }
}

/// The best result for a cost: level up to the next point of the front, then higher.
fn steps(svg: &mut String, front: &[(f64, f64)]) {
    let (Some(first), Some(last)) = (front.first(), front.last()) else { return };
    let mut path = format!("M{:.1} {:.1}V{:.1}", first.0, HEIGHT - BOTTOM, first.1);
    for (x, y) in &front[1..] {
        let _ = write!(path, "H{x:.1}V{y:.1}");
    }
    let end = (WIDTH - RIGHT).max(last.0);
    let _ = writeln!(
        svg,
        "<path d=\"{path}H{end:.1}\" fill=\"none\" stroke=\"var(--quiet)\" stroke-width=\"1.5\" \
         stroke-dasharray=\"2 3\"/>"
    );
}

fn draw(svg: &mut String, trace: &Trace, line: &[(f64, f64)], labels: &mut Labels) {
    let Some(&(x, y)) = line.last() else { return };
    let color = format!("var(--series-{})", trace.color % COLORS);
    let (width, fill) = if trace.is_minor { (1.2, "var(--ground)") } else { (2.0, color.as_str()) };
    let radius = if trace.is_minor { 3.5 } else { 5.0 };
    let _ = writeln!(svg, "<g><title>{}</title>", escape(&trace.title));
    if line.len() > 1 {
        let points: Vec<String> = line.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let _ = writeln!(
            svg,
            "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\" stroke-linejoin=\"round\" \
             points=\"{}\"/>",
            points.join(" ")
        );
    }
    let (label_x, label_y) = labels.place(x, y, &trace.name, line.len() > 1);
    let weight = if trace.is_minor { "" } else { " font-weight=\"600\"" };
    let _ = writeln!(
        svg,
        "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{fill}\" stroke=\"{color}\" stroke-width=\"1.5\"/>\
         <text x=\"{label_x:.1}\" y=\"{label_y:.1}\" fill=\"{color}\" class=\"label\"{weight}>{}</text></g>",
        escape(&trace.name)
    );
}

/// The places that are taken by labels: left, top, right and bottom.
struct Labels(Vec<[f64; 4]>);

impl Labels {
    fn around(dots: impl Iterator<Item = (f64, f64)>) -> Self {
        Self(dots.map(|(x, y)| [x - 5.0, y - 5.0, x + 5.0, y + 5.0]).collect())
    }

    /// The left end of the baseline of a label next to (x, y), at a free place if there is one.
    fn place(&mut self, x: f64, y: f64, name: &str, ends_line: bool) -> (f64, f64) {
        // The maximum width of a semibold letter of the page's font.
        let width = 8.4 * name.chars().count() as f64;
        // A line comes from the left, a front continues to the right.
        let mut order = [x + 8.0, x - 8.0 - width];
        if !ends_line {
            order.reverse();
        }
        let sides = |down: f64| order.map(|left| (left, y + down));
        let middle = |down: f64| [(x - width / 2.0, y + down)];
        let mut places: Vec<(f64, f64)> = sides(4.0).to_vec();
        for down in [-9.0, 18.0] {
            places.extend(middle(down));
        }
        for down in [-7.0, 15.0, -18.0, 26.0, -29.0, 37.0] {
            places.extend(sides(down));
        }
        let boxed = |&(left, base): &(f64, f64)| [left, base - 10.0, left + width, base + 3.0];
        let is_free = |place: &&(f64, f64)| {
            let own = boxed(place);
            let is_inside = own[0] >= 0.0
                && own[2] <= WIDTH
                && own[1] >= 16.0
                && own[3] <= HEIGHT - BOTTOM + 4.0;
            let meets = |other: &[f64; 4]| {
                own[0] < other[2] && other[0] < own[2] && own[1] < other[3] && other[1] < own[3]
            };
            is_inside && !self.0.iter().any(meets)
        };
        let place = places.iter().find(is_free).copied().unwrap_or(places[0]);
        self.0.push(boxed(&place));
        place
    }
}
