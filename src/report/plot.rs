//! Line plots as inline SVG.
//!
//! A line through many points is a line alone; one through few shows where they are, and which of them is special.

use std::fmt::Write as _;

use super::axis::Axis;
use super::escape;

/// A line of a plot.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// (x, y) in the order of x; points that are not finite, or beyond 1e30, are left out.
    pub points: Vec<(f64, f64)>,
}

/// The drawing area, SVG user units.
const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = 34.0;

/// The colours that the page's style defines.
const COLORS: usize = 5;

/// A point apart from the lines, drawn as a star.
#[derive(Clone, Debug, Default)]
pub struct Mark {
    /// What it is, written beside it.
    pub name: String,
    /// (x, y); left out where it is not finite.
    pub point: (f64, f64),
}

/// Draws `y_name` against `x_name` (loss or PSNR against the step, say); the colours are those of the page's style.
pub fn plot(x_name: &str, y_name: &str, series: &[Series]) -> String {
    draw(x_name, y_name, series, 0.0, &[])
}

/// As [`plot`], for few points (PSNR against a setting, say): each has a dot, and `marks` are drawn as stars.
pub fn plot_points(x_name: &str, y_name: &str, series: &[Series], marks: &[Mark]) -> String {
    draw(x_name, y_name, series, 3.5, marks)
}

fn draw(x_name: &str, y_name: &str, series: &[Series], dot: f64, marks: &[Mark]) -> String {
    // Positive phrasing: a NaN fails the test too. The bound keeps differences of values finite.
    let is_drawable = |&(x, y): &(f64, f64)| x.abs() <= 1e30 && y.abs() <= 1e30;
    let marked = || marks.iter().map(|mark| mark.point);
    let points = || {
        let lines = series.iter().flat_map(|series| series.points.iter().copied());
        lines.chain(marked()).filter(is_drawable)
    };
    let x_axis = Axis::around(points().map(|(x, _)| x), LEFT, WIDTH - RIGHT);
    let y_axis = Axis::around(points().map(|(_, y)| y), HEIGHT - BOTTOM, TOP);

    let mut svg = format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{} against {}\" \
         font-size=\"12\" fill=\"var(--quiet)\">\n",
        escape(y_name),
        escape(x_name)
    );
    // Writing to a string cannot fail, so the results below hold nothing.
    for tick in y_axis.ticks() {
        let y = y_axis.place(tick);
        let _ = writeln!(
            svg,
            "<line x1=\"{LEFT}\" x2=\"{}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"var(--line)\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            WIDTH - RIGHT,
            LEFT - 8.0,
            y + 4.0,
            y_axis.label(tick)
        );
    }
    for tick in x_axis.ticks() {
        let (x, label) = (x_axis.place(tick), x_axis.label(tick));
        let _ = writeln!(
            svg,
            "<text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{label}</text>",
            HEIGHT - 14.0
        );
    }
    let _ = writeln!(
        svg,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{}</text><text x=\"0\" y=\"14\">{}</text>",
        WIDTH - RIGHT,
        HEIGHT - 1.0,
        escape(x_name),
        escape(y_name)
    );
    let mut legend = LEFT + 60.0;
    for (index, Series { name, points }) in series.iter().enumerate() {
        let color = format!("var(--series-{})", index % COLORS);
        let places = points.iter().filter(|point| is_drawable(point));
        let places: Vec<(f64, f64)> =
            places.map(|&(x, y)| (x_axis.place(x), y_axis.place(y))).collect();
        let line = places.iter().map(|(x, y)| format!("{x:.1},{y:.1}"));
        let _ = writeln!(
            svg,
            "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"2\" stroke-linejoin=\"round\" points=\"{}\"/>\
             <text x=\"{legend}\" y=\"14\" fill=\"{color}\">{}</text>",
            line.collect::<Vec<_>>().join(" "),
            escape(name)
        );
        for (x, y) in places.iter().filter(|_| dot > 0.0) {
            let _ =
                writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{dot}\" fill=\"{color}\"/>");
        }
        legend += 8.0 * name.chars().count() as f64 + 24.0;
    }
    for Mark { name, point } in marks.iter().filter(|mark| is_drawable(&mark.point)) {
        let (x, y) = (x_axis.place(point.0), y_axis.place(point.1));
        let _ = writeln!(
            svg,
            "<path d=\"{}\" fill=\"var(--best)\"/><text x=\"{:.1}\" y=\"{:.1}\" fill=\"var(--best)\">{}</text>",
            star(x, y),
            // Towards the middle, where there is room.
            if x > WIDTH / 2.0 { x - 10.0 - 7.0 * name.chars().count() as f64 } else { x + 12.0 },
            y - 8.0,
            escape(name)
        );
    }
    svg.push_str("</svg>");
    svg
}

/// The outline of a star with five points around (x, y).
fn star(x: f64, y: f64) -> String {
    let corner = |index: u32| {
        let radius = if index.is_multiple_of(2) { 9.0 } else { 4.0 };
        let (sin, cos) = (std::f64::consts::PI * f64::from(index) / 5.0).sin_cos();
        format!("{:.1} {:.1}", x + radius * sin, y - radius * cos)
    };
    format!("M{}Z", (0..10).map(corner).collect::<Vec<_>>().join("L"))
}
