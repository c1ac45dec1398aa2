//! Plot of the pairs and the curves as an SVG file.

use nightsplat_fit::{Channels, FitOptions, Histogram, Pair};
use nightsplat_photographs::tone::{Statistics, ToneCurve, ToneSettings};
use nightsplat_report::{Chart, Series};

use super::Fitted;

/// Share of the pixels that the t axis covers.
const SHARE: f64 = 0.995;
/// Points per curve.
const POINTS: usize = 200;
/// Bins of the measured lines.
const BINS: usize = 64;
/// Bins with a smaller share of the pixels are left out as too noisy.
const MIN_COLUMN: f64 = 1e-4;
/// Reference against t: mean and standard deviation of the pairs, the fitted curve, and AP3 with its defaults.
/// Adaptive curves are drawn for the mean statistics.
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
        let point = |column: &nightsplat_fit::HistogramColumn| {
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
        let point = |i: usize| {
            let t = end * i as f64 / (POINTS - 1) as f64;
            (t, settings.value(t, &statistics))
        };
        let points = (0..POINTS).map(point).collect();
        Series { name: name.to_owned(), points, ..Series::default() }
    };
    let series = vec![
        curve(&format!("{} fitted", fitted.family), &fitted.fit.settings),
        line("pairs, mean", 0.0),
        curve("AP3", &ToneSettings::new(ToneCurve::Ap3)),
        line("mean - 1 sd", -1.0),
        line("mean + 1 sd", 1.0),
    ];
    Chart::new("t = x / p90", "reference", series).svg_file()
}
