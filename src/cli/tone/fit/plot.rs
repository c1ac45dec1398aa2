//! The pairs and the curves as an SVG file that stands alone.

use super::Fitted;
use crate::photographs::fit::{Channels, FitOptions, Histogram, Pair};
use crate::photographs::tone::{Statistics, ToneCurve, ToneSettings};
use crate::results::report::{Series, plot};

/// The t up to which curves are drawn holds this share of all pixels.
const SHARE: f64 = 0.995;
/// Points of a curve.
const POINTS: usize = 200;
/// Columns of the pairs' own lines.
const BINS: usize = 64;
/// Below this share of the pixels, a column's mean says little.
const MIN_COLUMN: f64 = 1e-4;
/// What the page's style would say.
const COLORS: [(&str, &str); 8] = [
    ("--text", "#23211e"),
    ("--quiet", "#6f6a63"),
    ("--line", "#ddd8d0"),
    ("--series-0", "#c2571a"),
    ("--series-1", "#2f6fb3"),
    ("--series-2", "#0f8a6d"),
    ("--series-3", "#8a4fb0"),
    ("--series-4", "#a08010"),
];

/// The reference against t: the pairs' mean and one standard deviation to either side, the fitted curve, and AP3 as it is. Curves that adapt
/// are drawn for a photograph with the mean statistics.
pub(super) fn svg(fitted: &Fitted, pairs: &[&Pair], options: &FitOptions) -> String {
    let histograms = pairs.iter().flat_map(|pair| {
        let factor = 1.0 / f64::from(pair.statistics.p90);
        let of_pair: Vec<&Histogram> = match options.channels {
            Channels::Rgb => pair.channels.iter().collect(),
            Channels::Luminance => vec![&pair.luminance],
        };
        of_pair.into_iter().map(move |histogram| (histogram, [factor, 1.0]))
    });
    let pooled = Histogram::pooled(histograms, BINS);
    let count = pooled.count();
    let mut left = SHARE * count;
    let end = pooled.columns.iter().find(|column| {
        left -= column.count;
        left <= 0.0
    });
    let end = end.map_or(1.0, |column| column.x);
    let line = |name: &str, deviations: f64| {
        let columns = pooled.columns.iter();
        let columns = columns.filter(|column| column.count > MIN_COLUMN * count && column.x <= end);
        let point = |column: &crate::photographs::fit::Column| {
            let mean = column.sum_y / column.count;
            let deviation = (column.sum_y2 / column.count - mean * mean).max(0.0).sqrt();
            (column.x, mean + deviations * deviation)
        };
        let points = columns.map(point).collect();
        Series { name: name.to_owned(), points, ..Series::default() }
    };
    let statistics: Vec<Statistics> = pairs.iter().map(|pair| pair.statistics).collect();
    let statistics = Statistics::mean_of(&statistics).unwrap_or_default();
    let curve = |name: &str, settings: &ToneSettings| {
        let parameters = settings.parameters(&statistics);
        let point = |i: usize| {
            let t = end * i as f64 / (POINTS - 1) as f64;
            (t, f64::from(settings.curve.apply(t as f32 * statistics.p90, &parameters)))
        };
        let points = (0..POINTS).map(point).collect();
        Series { name: name.to_owned(), points, ..Series::default() }
    };
    let series = [
        curve(&format!("{} fitted", fitted.family), &fitted.fit.settings),
        line("pairs, mean", 0.0),
        curve("AP3", &ToneSettings::new(ToneCurve::Ap3)),
        line("mean - 1 sd", -1.0),
        line("mean + 1 sd", 1.0),
    ];
    let mut svg = plot("t = x / p90", "reference", &series);
    for (name, color) in COLORS {
        svg = svg.replace(&format!("var({name})"), color);
    }
    svg.replacen(
        "<svg ",
        "<svg xmlns=\"http://www.w3.org/2000/svg\" style=\"background:#fbfaf8\" font-family=\"system-ui, sans-serif\" ",
        1,
    ) + "\n"
}
