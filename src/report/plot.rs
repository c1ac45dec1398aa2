//! Line plots as inline SVG.

use std::fmt::Write as _;

use super::escape;

/// A line of a plot.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// (x, y) in the order of x; points that are not finite, or beyond 1e30, are left out.
    pub points: Vec<(f64, f64)>,
}

/// A value of x that a vertical line marks.
#[derive(Clone, Debug, Default)]
pub struct Mark {
    /// Where.
    pub x: f64,
    /// What it is.
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
/// How lines of one colour differ.
const DASHES: [&str; 4] =
    ["", " stroke-dasharray=\"7 3\"", " stroke-dasharray=\"2 3\"", " stroke-dasharray=\"9 3 2 3\""];

/// Draws `y_name` against `x_name` (loss or PSNR against the step, say); the colours are those of the page's style.
pub fn plot(x_name: &str, y_name: &str, series: &[Series]) -> String {
    plot_with_marks(x_name, y_name, series, &[])
}

/// As [`plot`], with vertical lines where `marks` lie within the x axis.
pub fn plot_with_marks(x_name: &str, y_name: &str, series: &[Series], marks: &[Mark]) -> String {
    // Positive phrasing: a NaN fails the test too. The bound keeps differences of values finite.
    let is_drawable = |&(x, y): &(f64, f64)| x.abs() <= 1e30 && y.abs() <= 1e30;
    let points =
        || series.iter().flat_map(|series| series.points.iter().copied().filter(is_drawable));
    let x_axis = Axis::around(points().map(|(x, _)| x), LEFT, WIDTH - RIGHT);
    let y_axis = Axis::around(points().map(|(_, y)| y), HEIGHT - BOTTOM, TOP);

    let (legend, legend_height) = legend_places(series);
    let mut svg = format!(
        "<svg viewBox=\"0 {} {WIDTH} {}\" role=\"img\" aria-label=\"{} against {}\" \
         font-size=\"12\" fill=\"var(--quiet)\">\n",
        0.0 - legend_height,
        HEIGHT + legend_height,
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
    for Mark { x, name } in marks.iter().filter(|mark| (x_axis.low..=x_axis.high).contains(&mark.x))
    {
        let x = x_axis.place(*x);
        let (bottom, below) = (HEIGHT - BOTTOM, TOP + 12.0);
        let _ = writeln!(
            svg,
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{TOP}\" y2=\"{bottom}\" stroke=\"var(--quiet)\" stroke-dasharray=\"4 3\"/>\
             <text x=\"{:.1}\" y=\"{below}\">{}</text>",
            x + 4.0,
            escape(name)
        );
    }
    for (index, (Series { name, points }, [text_x, text_y])) in
        series.iter().zip(legend).enumerate()
    {
        let color = format!("var(--series-{})", index % COLORS);
        let dashes = DASHES[index / COLORS % DASHES.len()];
        let line = points.iter().filter(|point| is_drawable(point));
        let line = line.map(|&(x, y)| format!("{:.1},{:.1}", x_axis.place(x), y_axis.place(y)));
        let _ = writeln!(
            svg,
            "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"2\"{dashes} stroke-linejoin=\"round\" points=\"{}\"/>\
             <text x=\"{text_x}\" y=\"{text_y}\" fill=\"{color}\">{}</text>",
            line.collect::<Vec<_>>().join(" "),
            escape(name)
        );
    }
    svg.push_str("</svg>");
    svg
}

/// Where each name of the legend begins, and by how much its rows rise above the drawing.
fn legend_places(series: &[Series]) -> (Vec<[f64; 2]>, f64) {
    const ROW: f64 = 16.0;
    let (mut x, mut y) = (LEFT + 60.0, 14.0);
    let mut places = vec![];
    for Series { name, .. } in series {
        let width = 8.0 * name.chars().count() as f64 + 24.0;
        if x + width > WIDTH && x > LEFT + 60.0 {
            (x, y) = (LEFT + 60.0, y - ROW);
        }
        places.push([x, y]);
        x += width;
    }
    (places, 14.0 - y)
}

/// A plot as a file of its own, in the colours of the page's style.
pub fn svg_file(plot: &str) -> String {
    let style = include_str!("style.css");
    // The custom properties stand before the first rule that is not theirs.
    let colors = style.split("* {").next().unwrap_or_default();
    let begin = "<svg xmlns=\"http://www.w3.org/2000/svg\" style=\"background: var(--ground)\" font-family=\"sans-serif\" ";
    let whole = plot.replacen("<svg ", begin, 1);
    whole.replacen(">\n", &format!(">\n<style>\n{colors}</style>\n"), 1)
}

/// A range of values and where it lies on the drawing.
struct Axis {
    low: f64,
    high: f64,
    /// Between ticks; a round number.
    step: f64,
    from: f64,
    to: f64,
}

impl Axis {
    /// The axis from `from` to `to` that holds all of the values, with round ends.
    fn around(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        const TICKS: f64 = 5.0;
        let (low, high) = values
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let (low, high) = match (low <= high, low < high) {
            (false, _) => (0.0, 1.0),
            // All values are one; the margin must not vanish in rounding.
            (true, false) => (low - 0.5 - 0.01 * low.abs(), high + 0.5 + 0.01 * high.abs()),
            (true, true) => (low, high),
        };
        let rough = high / TICKS - low / TICKS;
        let power = 10f64.powf(rough.log10().floor());
        let step = power
            * [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= rough).unwrap_or(10.0);
        Self { low: (low / step).floor() * step, high: (high / step).ceil() * step, step, from, to }
    }

    fn ticks(&self) -> impl Iterator<Item = f64> {
        let count = ((self.high - self.low) / self.step).round() as u32;
        (0..=count).map(|tick| self.low + f64::from(tick) * self.step)
    }

    fn place(&self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    fn label(&self, tick: f64) -> String {
        let digits = (-self.step.log10().floor()).clamp(0.0, 6.0) as usize;
        let label = format!("{tick:.digits$}");
        if label.trim_start_matches('-').chars().all(|digit| matches!(digit, '0' | '.')) {
            "0".to_owned()
        } else {
            label
        }
    }
}
