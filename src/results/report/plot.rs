//! Line plots as inline SVG.
//!
//! A line of many points is drawn alone; a line of few points has dots, and marks for special ones.

use std::fmt::Write as _;

use super::axis::Axis;
use super::escape;

/// A line of a plot.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// (x, y) in the order of x; points that are not finite or exceed 1e30 are omitted.
    pub points: Vec<(f64, f64)>,
    /// The number of its colour and dash, the same in every plot of a page; by default its index in this plot.
    pub line: Option<usize>,
    /// (x, minimum, maximum) of the values whose means are the points; may be empty.
    pub spreads: Vec<(f64, f64, f64)>,
}

/// A value of x that a vertical line marks.
#[derive(Clone, Debug, Default)]
pub struct VerticalLine {
    /// Its position.
    pub x: f64,
    /// Its label.
    pub name: String,
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
/// Dash patterns that distinguish lines of one colour.
const DASHES: [&str; 4] =
    ["", " stroke-dasharray=\"7 3\"", " stroke-dasharray=\"2 3\"", " stroke-dasharray=\"9 3 2 3\""];

/// A separate point, drawn as a star.
#[derive(Clone, Debug, Default)]
pub struct Mark {
    /// Its label.
    pub name: String,
    /// (x, y); omitted if not finite.
    pub point: (f64, f64),
}

/// Draws `y_name` against `x_name` (for example loss against step); the colours are those of the page's style.
pub fn plot(x_name: &str, y_name: &str, series: &[Series]) -> String {
    draw(x_name, y_name, series, &Extras::default())
}

/// [`plot`] for few points (for example PSNR against a setting): each has a dot, and `marks` are stars.
pub fn plot_points(x_name: &str, y_name: &str, series: &[Series], marks: &[Mark]) -> String {
    draw(x_name, y_name, series, &Extras { dot: 3.5, marks, ..Extras::default() })
}

/// [`plot`] with vertical `lines`, if they are within the x axis. Many series are divided into several plots with the
/// same axes, one below the other.
pub fn plot_in_groups(
    x_name: &str,
    y_name: &str,
    series: &[Series],
    lines: &[VerticalLine],
) -> String {
    let extras = Extras { lines, frame: series, ..Extras::default() };
    let mut height = 0.0;
    let mut panels = String::new();
    for group in series.chunks(GROUP) {
        let (above, panel) = panel(x_name, y_name, group, &extras);
        let whole = HEIGHT + above;
        let _ = writeln!(
            panels,
            "<svg y=\"{height}\" overflow=\"visible\" width=\"{WIDTH}\" height=\"{whole}\" \
             viewBox=\"0 {} {WIDTH} {whole}\">\n{panel}</svg>",
            0.0 - above
        );
        height += whole + GAP;
    }
    framed(x_name, y_name, 0.0, height - GAP, &panels)
}

/// The maximum number of series in one plot.
const GROUP: usize = 6;
/// Space between two plots of one drawing.
const GAP: f64 = 24.0;

/// What a plot has in addition to its lines.
#[derive(Default)]
struct Extras<'a> {
    /// The radius of the points, or 0.
    dot: f64,
    marks: &'a [Mark],
    lines: &'a [VerticalLine],
    /// Series that the axes include without drawing them.
    frame: &'a [Series],
}

fn draw(x_name: &str, y_name: &str, series: &[Series], extras: &Extras<'_>) -> String {
    let (above, panel) = panel(x_name, y_name, series, extras);
    framed(x_name, y_name, 0.0 - above, HEIGHT + above, &panel)
}

/// The SVG element around a plot.
fn framed(x_name: &str, y_name: &str, top: f64, height: f64, panel: &str) -> String {
    let (x_name, y_name) = (escape(x_name), escape(y_name));
    format!(
        "<svg viewBox=\"0 {top} {WIDTH} {height}\" role=\"img\" aria-label=\"{y_name} against {x_name}\" \
         font-size=\"12\" fill=\"var(--quiet)\">\n{panel}</svg>"
    )
}

/// Axes, lines and legend, and the height of the legend above the drawing.
fn panel(x_name: &str, y_name: &str, series: &[Series], extras: &Extras<'_>) -> (f64, String) {
    let &Extras { dot, marks, lines, frame } = extras;
    // Written so that a NaN fails. The bound keeps differences finite.
    let is_drawable = |&(x, y): &(f64, f64)| x.abs() <= 1e30 && y.abs() <= 1e30;
    let marked = || marks.iter().map(|mark| mark.point);
    let points = || {
        let all = series.iter().chain(frame);
        let ends = |&(x, low, high): &(f64, f64, f64)| [(x, low), (x, high)];
        let of = move |series: &Series| {
            let spreads = series.spreads.iter().flat_map(ends);
            series.points.iter().copied().chain(spreads).collect::<Vec<_>>()
        };
        all.flat_map(of).chain(marked()).filter(is_drawable)
    };
    let x_axis = Axis::around(points().map(|(x, _)| x), LEFT, WIDTH - RIGHT);
    let y_axis = Axis::around(points().map(|(_, y)| y), HEIGHT - BOTTOM, TOP);
    let (legend, legend_height) = legend_places(series);
    let mut svg = String::new();
    // Writing to a string cannot fail, so the results below are ignored.
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
    for VerticalLine { x, name } in lines.iter().filter(|line| x_axis.contains(line.x)) {
        let x = x_axis.place(*x);
        let (bottom, below) = (HEIGHT - BOTTOM, TOP + 12.0);
        let _ = writeln!(
            svg,
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{TOP}\" y2=\"{bottom}\" stroke=\"var(--quiet)\" \
             stroke-dasharray=\"4 3\"/>\
             <text x=\"{:.1}\" y=\"{below}\">{}</text>",
            x + 4.0,
            escape(name)
        );
    }
    for (index, (series, [sample_x, text_y])) in series.iter().zip(legend).enumerate() {
        let (name, line) = (escape(&series.name), series.line.unwrap_or(index));
        let color = format!("var(--series-{})", line % COLORS);
        let dashes = DASHES[line / COLORS % DASHES.len()];
        let places = series.points.iter().filter(|point| is_drawable(point));
        let places: Vec<(f64, f64)> =
            places.map(|&(x, y)| (x_axis.place(x), y_axis.place(y))).collect();
        let sample_y = text_y - 4.0;
        let points = places.iter().map(|(x, y)| format!("{x:.1},{y:.1}"));
        let _ = writeln!(
            svg,
            "<g class=\"series\"><title>{name}</title>\
             <polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"2\"{dashes} stroke-linejoin=\"round\" \
             points=\"{}\"/>\
             <line class=\"sample\" x1=\"{sample_x}\" x2=\"{}\" y1=\"{sample_y}\" y2=\"{sample_y}\" stroke=\"{color}\" \
             stroke-width=\"2\"{dashes}/>\
             <text x=\"{}\" y=\"{text_y}\" fill=\"var(--text)\">{name}</text>",
            points.collect::<Vec<_>>().join(" "),
            sample_x + SAMPLE,
            sample_x + SAMPLE + 6.0,
        );
        for &(x, low, high) in &series.spreads {
            if is_drawable(&(x, low)) && is_drawable(&(x, high)) {
                let (x, low, high) = (x_axis.place(x), y_axis.place(low), y_axis.place(high));
                let _ = writeln!(
                    svg,
                    "<line class=\"spread\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{low:.1}\" y2=\"{high:.1}\" \
                     stroke=\"{color}\" stroke-width=\"1.5\"/>"
                );
            }
        }
        for (x, y) in places.iter().filter(|_| dot > 0.0) {
            let _ =
                writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{dot}\" fill=\"{color}\"/>");
        }
        svg.push_str("</g>\n");
    }
    for Mark { name, point } in marks.iter().filter(|mark| is_drawable(&mark.point)) {
        let (x, y) = (x_axis.place(point.0), y_axis.place(point.1));
        let _ = writeln!(
            svg,
            "<path d=\"{}\" fill=\"var(--best)\"/><text x=\"{:.1}\" y=\"{:.1}\" fill=\"var(--best)\">{}</text>",
            star(x, y),
            // The label extends towards the middle, where there is space.
            if x > WIDTH / 2.0 { x - 10.0 - 7.0 * name.chars().count() as f64 } else { x + 12.0 },
            y - 8.0,
            escape(name)
        );
    }
    (legend_height, svg)
}

/// The length of a line's sample in the legend: two periods of a dash.
const SAMPLE: f64 = 28.0;

/// The position of each sample in the legend, and the height of its rows above the drawing.
fn legend_places(series: &[Series]) -> (Vec<[f64; 2]>, f64) {
    const ROW: f64 = 16.0;
    let (mut x, mut y) = (LEFT + 60.0, 14.0);
    let mut places: Vec<[f64; 2]> = vec![];
    for Series { name, .. } in series {
        let width = 7.0 * name.chars().count() as f64 + SAMPLE + 24.0;
        if x + width > WIDTH && x > LEFT + 60.0 {
            (x, y) = (LEFT + 60.0, y + ROW);
        }
        places.push([x, y]);
        x += width;
    }
    // The last row is that of the axis label.
    let above = y - 14.0;
    places.iter_mut().for_each(|place| place[1] -= above);
    (places, above)
}

/// A plot as an SVG file, in the colours of the page's style.
pub fn svg_file(plot: &str) -> String {
    let style = include_str!("style.css");
    // The custom properties come before the first other rule.
    let colors = style.split("* {").next().unwrap_or_default();
    let begin = "<svg xmlns=\"http://www.w3.org/2000/svg\" style=\"background: var(--ground)\" \
                 font-family=\"sans-serif\" ";
    let whole = plot.replacen("<svg ", begin, 1);
    whole.replacen(">\n", &format!(">\n<style>\n{colors}</style>\n"), 1)
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
