//! Bar charts as inline SVG.

use std::fmt::Write as _;

use super::axis::Axis;
use super::escape;

/// A named value.
#[derive(Clone, Debug, Default)]
pub struct Bar {
    /// Its name, to the left.
    pub name: String,
    /// Its length; a value that is not finite or exceeds 1e30 has no bar.
    pub value: f64,
    /// Minimum and maximum of the values whose mean this is.
    pub spread: Option<[f64; 2]>,
}

/// SVG user units, narrow enough for a phone.
const WIDTH: f64 = 480.0;
const ROW: f64 = 22.0;
const TOP: f64 = 24.0;
const RIGHT: f64 = 64.0;

/// Draws `bars` from top to bottom, from zero, each labelled with `digits` decimals.
pub fn bars(value_name: &str, digits: usize, bars: &[Bar]) -> String {
    let names = bars.iter().map(|bar| bar.name.chars().count()).max().unwrap_or(0);
    // Names take at most half of the width.
    let left = (7.0 * names as f64 + 12.0).min(WIDTH / 2.0);
    let is_drawable = |value: &f64| value.abs() <= 1e30;
    let ends = |bar: &Bar| bar.spread.unwrap_or([bar.value; 2]);
    let values = bars.iter().flat_map(ends).chain(bars.iter().map(|bar| bar.value));
    let values = values.filter(is_drawable);
    let axis = Axis::around(values.chain([0.0]), left, WIDTH - RIGHT);
    let zero = axis.place(0.0);

    let mut svg = format!(
        "<svg class=\"half\" viewBox=\"0 0 {WIDTH} {}\" role=\"img\" aria-label=\"{name}\" font-size=\"12\" \
         fill=\"var(--quiet)\">\n\
         <text x=\"{left}\" y=\"14\">{name}</text>\n",
        TOP + ROW * bars.len() as f64,
        name = escape(value_name)
    );
    // Writing to a string cannot fail, so the results below are ignored.
    for (row, Bar { name, value, spread }) in bars.iter().enumerate() {
        let y = TOP + ROW * row as f64;
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{}</text>",
            left - 8.0,
            y + 14.0,
            escape(name)
        );
        if is_drawable(value) {
            let end = axis.place(*value);
            let _ = write!(
                svg,
                "<rect x=\"{:.1}\" y=\"{}\" width=\"{:.1}\" height=\"{}\" rx=\"2\" fill=\"var(--series-1)\"/>\
                 <text x=\"{:.1}\" y=\"{}\">{value:.digits$}</text>",
                end.min(zero),
                y + 2.0,
                (end - zero).abs(),
                ROW - 5.0,
                spread.map_or(end, |[_, high]| axis.place(high).max(end)).max(zero) + 6.0,
                y + 14.0
            );
            if let Some([low, high]) = spread.filter(|ends| ends.iter().all(is_drawable)) {
                let (low, high, y) = (axis.place(low), axis.place(high), y + ROW / 2.0 - 0.5);
                let _ = write!(
                    svg,
                    "<line class=\"spread\" x1=\"{low:.1}\" x2=\"{high:.1}\" y1=\"{y}\" y2=\"{y}\" \
                     stroke=\"var(--text)\" stroke-width=\"2\"/>"
                );
            }
        }
        svg.push('\n');
    }
    svg.push_str("</svg>");
    svg
}
