//! Charts as inline SVG: series of points with a mark each, on one pair of axes.

use std::fmt::Write as _;

use glam::{DVec2, dvec2};

use super::axis::Axis;
use super::escape;
use super::labels::{Labels, letters, text};

/// How the points of a series are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mark {
    /// A line, named in the legend.
    #[default]
    Line,
    /// [`Mark::Line`] with a dot at each point.
    Dots,
    /// A star at each point, with the name beside it.
    Star,
    /// A line that ends in a disc with the name beside it.
    Disc,
    /// [`Mark::Disc`] for a minor series: a thin line and a ring.
    Ring,
    /// Dotted steps: level from each point to the next one.
    Steps,
    /// A horizontal bar to y for each point, labelled with name and value; x is its row. Bars begin at zero, or at a
    /// labelled value where the differences would be small beside the bars. All series of a chart are bars, or none.
    Bar,
}

impl Mark {
    fn has_legend(self) -> bool {
        matches!(self, Self::Line | Self::Dots)
    }
}

/// Points of a chart that belong together.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Its name.
    pub name: String,
    /// Its tooltip; if empty, the name.
    pub title: String,
    /// How it is drawn.
    pub mark: Mark,
    /// The number of its colour and dash, the same in every chart of a page; by default its index in this chart.
    pub color: Option<usize>,
    /// (x, y) in the order of x; points that are not finite or exceed 1e30 are omitted, and on a logarithmic axis those
    /// that are not above 0.
    pub points: Vec<(f64, f64)>,
    /// (x, minimum, maximum) of the values whose means are the points; may be empty.
    pub spreads: Vec<(f64, f64, f64)>,
}

/// A value of x that a vertical line marks, if the x axis contains it.
#[derive(Clone, Debug, Default)]
pub struct VerticalLine {
    /// Its position.
    pub x: f64,
    /// Its label.
    pub name: String,
}

/// A chart, in the colours of the page's style. One without a legend is half as wide: two fit side by side, and one is
/// readable on a phone.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    /// The name of the x axis.
    pub x_name: String,
    /// The name of the y axis.
    pub y_name: String,
    /// Whether the x axis is logarithmic.
    pub is_logarithmic: bool,
    /// The series.
    pub series: Vec<Series>,
    /// Marked values of x.
    pub lines: Vec<VerticalLine>,
    /// The maximum number of series of a panel: more are divided into panels with the same axes, one below the other.
    pub panel: Option<usize>,
}

/// SVG user units.
const WIDTH: f64 = 720.0;
const HALF_WIDTH: f64 = 420.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = 34.0;
/// The height of a bar with the space around it, and the space for its value.
const ROW: f64 = 22.0;
const VALUE: f64 = 64.0;
/// Space between two panels.
const GAP: f64 = 24.0;
/// The length of a line's sample in the legend: two periods of a dash.
const SAMPLE: f64 = 28.0;

/// The colours that the page's style defines.
const COLORS: usize = 5;
/// Dash patterns that distinguish lines of one colour.
const DASHES: [&str; 4] =
    ["", " stroke-dasharray=\"7 3\"", " stroke-dasharray=\"2 3\"", " stroke-dasharray=\"9 3 2 3\""];

// Writing to a string cannot fail, so the results below are ignored.

impl Chart {
    /// A chart of lines.
    pub fn new(x_name: &str, y_name: &str, series: Vec<Series>) -> Self {
        Self { x_name: x_name.to_owned(), y_name: y_name.to_owned(), series, ..Self::default() }
    }

    /// The chart as an SVG element.
    pub fn svg(&self) -> String {
        let frame = Frame::new(self);
        let (mut panels, mut height) = (String::new(), 0.0);
        let size = self.panel.unwrap_or(usize::MAX);
        let groups = self.series.chunks(size).chain(self.series.is_empty().then_some(&[][..]));
        for series in groups {
            let (legend, above) = legend_places(series);
            height += if height > 0.0 { GAP + above } else { above };
            let panel = frame.axes(self) + &frame.series(series, &legend);
            let _ = writeln!(
                panels,
                "<g class=\"panel\" transform=\"translate(0 {height})\">\n{panel}</g>"
            );
            height += frame.height;
        }
        let class = if frame.width < WIDTH { " class=\"half\"" } else { "" };
        let (x, y) = (escape(&self.x_name), escape(&self.y_name));
        let label = if x.is_empty() { y } else { format!("{y} against {x}") };
        format!(
            "<svg{class} viewBox=\"0 0 {} {height}\" role=\"img\" aria-label=\"{label}\" font-size=\"12\" \
             fill=\"var(--quiet)\">\n{panels}</svg>",
            frame.width
        )
    }

    /// The chart as an SVG file.
    pub fn svg_file(&self) -> String {
        let style = include_str!("style.css");
        // The custom properties come before the first other rule.
        let colors = style.split("* {").next().unwrap_or_default();
        let begin = "<svg xmlns=\"http://www.w3.org/2000/svg\" style=\"background: var(--ground)\" \
                     font-family=\"sans-serif\" ";
        let whole = self.svg().replacen("<svg ", begin, 1);
        whole.replacen(">\n", &format!(">\n<style>\n{colors}</style>\n"), 1)
    }
}

/// The drawing area of a panel.
struct Frame {
    x: Axis,
    y: Axis,
    width: f64,
    height: f64,
    /// Whether x is down, in rows, and y to the right.
    has_bars: bool,
}

impl Frame {
    /// The axes contain every drawable point.
    fn new(chart: &Chart) -> Self {
        let of_points = |series: &Series| {
            let spreads = series.spreads.iter().flat_map(|&(x, low, high)| [(x, low), (x, high)]);
            series.points.iter().copied().chain(spreads).collect::<Vec<_>>()
        };
        let points: Vec<(f64, f64)> = chart.series.iter().flat_map(of_points).collect();
        let is_drawable = |&&(x, y): &&(f64, f64)| is_drawable(x, y, chart.is_logarithmic);
        let xs = || points.iter().filter(is_drawable).map(|point| point.0);
        let ys = || points.iter().filter(is_drawable).map(|point| point.1);
        let bars = chart.series.iter().filter(|series| series.mark == Mark::Bar);
        let is_half =
            !chart.series.is_empty() && !chart.series.iter().any(|one| one.mark.has_legend());
        let (width, rows) = (if is_half { HALF_WIDTH } else { WIDTH }, bars.clone().count());
        let has_bars = rows > 0;
        if has_bars {
            let names = bars.map(|bar| letters(&bar.name)).max().unwrap_or(0);
            // Names take at most half of the width.
            let left = (7.0 * names as f64 + 12.0).min(width / 2.0);
            let height = TOP + ROW * rows as f64;
            let x = Axis::rows(rows, TOP, height);
            let y = Axis::around(ys().chain(bar_start(ys())), left, width - VALUE);
            return Self { x, y, width, height, has_bars };
        }
        let x = match chart.is_logarithmic {
            true => Axis::logarithmic(xs(), LEFT, width - RIGHT),
            false => Axis::around(xs(), LEFT, width - RIGHT),
        };
        let y = Axis::around(ys(), HEIGHT - BOTTOM, TOP);
        Self { x, y, width, height: HEIGHT, has_bars }
    }

    fn position(&self, x: f64, y: f64) -> DVec2 {
        match self.has_bars {
            true => dvec2(self.y.position(y), self.x.position(x + 0.5)),
            false => dvec2(self.x.position(x), self.y.position(y)),
        }
    }

    /// The positions of the drawable points.
    fn positions(&self, points: &[(f64, f64)]) -> Vec<DVec2> {
        let drawn = points.iter().filter(|&&(x, y)| is_drawable(x, y, self.x.is_logarithmic()));
        drawn.map(|&(x, y)| self.position(x, y)).collect()
    }

    /// Ticks, names of the axes and marked values.
    fn axes(&self, chart: &Chart) -> String {
        let mut svg = text(dvec2(0.0, 14.0), "", &chart.y_name);
        if self.has_bars {
            let start = self.y.start();
            if start > 0.0 {
                let x = self.y.from;
                svg += &text(dvec2(x, TOP - 4.0), "", &format!("from {}", self.y.label(start)));
                svg += &line(dvec2(x, TOP), dvec2(x, self.height), " stroke=\"var(--line)\"");
            }
            return svg + "\n";
        }
        let (right, bottom) = (self.width - RIGHT, HEIGHT - BOTTOM);
        let style = " text-anchor=\"end\"";
        svg += &text(dvec2(right, HEIGHT - 1.0), style, &chart.x_name);
        for tick in self.y.ticks() {
            let y = self.y.position(tick);
            svg += &line(dvec2(LEFT, y), dvec2(right, y), " stroke=\"var(--line)\"");
            svg += &text(dvec2(LEFT - 8.0, y + 4.0), style, &self.y.label(tick));
        }
        for tick in self.x.ticks() {
            let at = dvec2(self.x.position(tick), HEIGHT - 14.0);
            svg += &text(at, " text-anchor=\"middle\"", &self.x.label(tick));
        }
        for VerticalLine { x, name } in chart.lines.iter().filter(|one| self.x.contains(one.x)) {
            let x = self.x.position(*x);
            let style = " stroke=\"var(--quiet)\" stroke-dasharray=\"4 3\"";
            svg += &line(dvec2(x, TOP), dvec2(x, bottom), style);
            svg += &text(dvec2(x + 4.0, TOP + 12.0), "", name);
        }
        svg + "\n"
    }

    fn series(&self, series: &[Series], legend: &[DVec2]) -> String {
        let has_label = |mark| matches!(mark, Mark::Star | Mark::Disc | Mark::Ring);
        let labelled = series.iter().filter(|one| has_label(one.mark));
        let ends = labelled.filter_map(|one| self.positions(&one.points).last().copied());
        let mut labels = Labels::around(ends, dvec2(self.width, HEIGHT - BOTTOM));
        let (mut svg, mut legend) = (String::new(), legend.iter());
        for (index, one) in series.iter().enumerate() {
            let Series { name, title, mark, .. } = one;
            let number = one.color.unwrap_or(index);
            let color = format!("var(--series-{})", number % COLORS);
            let dashes = DASHES[number / COLORS % DASHES.len()];
            let points = self.positions(&one.points);
            let is_minor = *mark == Mark::Ring;
            let is_line = points.len() > 1 && matches!(mark, Mark::Disc | Mark::Ring);
            let mut drawn = String::new();
            if is_line || mark.has_legend() {
                drawn += &polyline(&points, &color, if is_minor { 1.2 } else { 2.0 }, dashes);
            }
            match mark {
                Mark::Line => {}
                Mark::Dots => {
                    drawn.extend(points.iter().map(|&at| circle(at, 3.5, &color, &color)));
                }
                Mark::Star => {
                    for &at in &points {
                        drawn += &star(at);
                        drawn += &labels.label(at, name, " fill=\"var(--best)\"", false);
                    }
                }
                Mark::Disc | Mark::Ring => {
                    let Some(&end) = points.last() else { continue };
                    let (radius, fill, weight) = match is_minor {
                        true => (3.5, "var(--ground)", ""),
                        false => (5.0, color.as_str(), " font-weight=\"600\""),
                    };
                    drawn += &circle(end, radius, fill, &color);
                    let style = format!(" fill=\"{color}\"{weight}");
                    drawn += &labels.label(end, name, &style, is_line);
                }
                Mark::Steps => drawn += &self.steps(&points),
                Mark::Bar => drawn += &self.bar(one, &points, &color),
            }
            if mark.has_legend() {
                let entry = |&at: &DVec2| legend_entry(at, name, &color, dashes);
                drawn.extend(legend.next().map(entry));
            }
            drawn += &self.spreads(one, if *mark == Mark::Bar { "var(--text)" } else { &color });
            let title = escape(if title.is_empty() { name } else { title });
            let _ = writeln!(svg, "<g class=\"series\"><title>{title}</title>{drawn}</g>");
        }
        svg
    }

    fn spreads(&self, series: &Series, color: &str) -> String {
        let spread = |&(x, low, high): &(f64, f64, f64)| {
            let ends = self.positions(&[(x, low), (x, high)]);
            let style = format!(" class=\"spread\" stroke=\"{color}\" stroke-width=\"1.5\"");
            if let [low, high] = ends[..] { line(low, high, &style) } else { String::new() }
        };
        series.spreads.iter().map(spread).collect()
    }

    /// The best result for a cost: level up to the next point of the front, then higher.
    fn steps(&self, front: &[DVec2]) -> String {
        let Some(first) = front.first() else { return String::new() };
        let mut path = format!("M{:.1} {:.1}V{:.1}", first.x, HEIGHT - BOTTOM, first.y);
        for DVec2 { x, y } in &front[1..] {
            let _ = write!(path, "H{x:.1}V{y:.1}");
        }
        format!(
            "<path d=\"{path}H{:.1}\" fill=\"none\" stroke=\"var(--quiet)\" stroke-width=\"1.5\" \
             stroke-dasharray=\"2 3\"/>",
            self.width - RIGHT
        )
    }

    /// Names, bars and values; `ends` are the positions of the drawable points.
    fn bar(&self, series: &Series, ends: &[DVec2], color: &str) -> String {
        let begin = self.position(0.0, self.y.start().max(0.0)).x;
        let rows = series.points.iter().filter(|(x, _)| is_drawable(*x, 0.0, false));
        let name = |&(x, _): &(f64, f64)| {
            let at = dvec2(self.y.from - 8.0, self.x.position(x + 0.5) + 4.0);
            text(at, " text-anchor=\"end\"", &series.name)
        };
        let mut svg: String = rows.map(name).collect();
        let values = series.points.iter().filter(|&&(x, y)| is_drawable(x, y, false));
        for (&(_, value), end) in values.zip(ends) {
            let highest = series.spreads.iter().map(|&(x, _, high)| self.position(x, high).x);
            let highest = highest.filter(|x| x.is_finite()).fold(end.x.max(begin), f64::max);
            let (x, y, width) = (end.x.min(begin), end.y - ROW / 2.0 + 2.0, (end.x - begin).abs());
            let height = ROW - 5.0;
            let _ = write!(
                svg,
                "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height}\" rx=\"2\" fill=\"{color}\"/>"
            );
            svg += &text(dvec2(highest + 6.0, end.y + 4.0), "", &format!("{value:.2}"));
        }
        svg
    }
}

/// The value at which bars begin: zero, unless all values are far from it and close to each other.
fn bar_start(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (low, high) =
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), y| (a.min(y), b.max(y)));
    let is_far = low <= high && low > 0.0 && low > 0.5 * high;
    // The lowest keeps a bar.
    Some(if is_far { low - (0.5 * (high - low)).max(0.02 * low) } else { 0.0 })
}

/// Written so that a NaN fails. The bound keeps differences finite.
fn is_drawable(x: f64, y: f64, is_logarithmic: bool) -> bool {
    x.abs() <= 1e30 && y.abs() <= 1e30 && (!is_logarithmic || x > 1e-9)
}

/// The positions of the samples in the legend, and the height of its rows above the first.
fn legend_places(series: &[Series]) -> (Vec<DVec2>, f64) {
    const ROW: f64 = 16.0;
    const FIRST: f64 = LEFT + 60.0;
    let mut at = dvec2(FIRST, 14.0);
    let mut places: Vec<DVec2> = vec![];
    for one in series.iter().filter(|one| one.mark.has_legend()) {
        let width = 7.0 * letters(&one.name) as f64 + SAMPLE + 24.0;
        if at.x + width > WIDTH && at.x > FIRST {
            at = dvec2(FIRST, at.y + ROW);
        }
        places.push(at);
        at.x += width;
    }
    // The last row is that of the axis label.
    let above = at.y - 14.0;
    places.iter_mut().for_each(|corner| corner.y -= above);
    (places, above)
}

fn legend_entry(at: DVec2, name: &str, color: &str, dashes: &str) -> String {
    let style = format!(" class=\"sample\" stroke=\"{color}\" stroke-width=\"2\"{dashes}");
    let from = at - dvec2(0.0, 4.0);
    line(from, from + dvec2(SAMPLE, 0.0), &style)
        + &text(at + dvec2(SAMPLE + 6.0, 0.0), " fill=\"var(--text)\"", name)
}

fn line(from: DVec2, to: DVec2, style: &str) -> String {
    let (x1, y1, x2, y2) = (from.x, from.y, to.x, to.y);
    format!("<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"{style}/>")
}

fn polyline(points: &[DVec2], color: &str, width: f64, dashes: &str) -> String {
    let points: Vec<String> = points.iter().map(|at| format!("{:.1},{:.1}", at.x, at.y)).collect();
    format!(
        "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\"{dashes} stroke-linejoin=\"round\" \
         points=\"{}\"/>",
        points.join(" ")
    )
}

fn circle(at: DVec2, radius: f64, fill: &str, stroke: &str) -> String {
    let DVec2 { x, y } = at;
    format!(
        "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{fill}\" stroke=\"{stroke}\" stroke-width=\"1.5\"/>"
    )
}

/// A star with five points.
fn star(at: DVec2) -> String {
    let corner = |index: u32| {
        let radius = if index.is_multiple_of(2) { 9.0 } else { 4.0 };
        let corner =
            at - radius * DVec2::from_angle(std::f64::consts::PI * (0.5 + f64::from(index) / 5.0));
        format!("{:.1} {:.1}", corner.x, corner.y)
    };
    let corners: Vec<String> = (0..10).map(corner).collect();
    format!("<path d=\"M{}Z\" fill=\"var(--best)\"/>", corners.join("L"))
}
