//! The results of a sweep: points with seeds averaged, best PSNR first.

use serde_json::Value;

use super::point::{PARTS, PRESET, RENDERS, SEED, SweepPoint};
use super::run::SweepRun;
use crate::results::eval::{AGAINST, WITH_REFERENCE};
use crate::results::run::{RunProgress, load_progress};

/// The results of a sweep.
#[derive(Clone, Debug)]
pub struct SweepResults {
    /// The axes along which points differ, without the seed.
    pub keys: Vec<String>,
    /// Best PSNR first, points without a score last.
    pub rows: Vec<SweepRow>,
    /// Names of the scores, as `metrics.json` has them below `mean`.
    pub scores: Vec<String>,
    /// All seeds.
    pub seeds: Vec<String>,
    /// The number of runs, finished or not.
    pub runs: usize,
    /// Axis and value of the baseline.
    baseline: Option<(&'static str, &'static str)>,
}

/// A point with all its seeds.
#[derive(Clone, Debug)]
pub struct SweepRow {
    /// The point without its seed.
    pub point: SweepPoint,
    /// `metrics.json` of each finished run.
    pub metrics: Vec<Value>,
    /// Intermediate scores of the first finished run.
    pub progress: Vec<RunProgress>,
}

impl SweepResults {
    /// Reads the results of the finished `runs`; points without one have a row, too.
    pub fn new(runs: &[SweepRun], baseline: Option<(&'static str, &'static str)>) -> Self {
        let (mut rows, mut scores, mut seeds): (Vec<SweepRow>, Vec<String>, Vec<String>) =
            Default::default();
        for run in runs {
            let point = run.point.seedless();
            let seed = run.point.value(SEED).map(str::to_owned);
            seeds.extend(seed.filter(|seed| !seeds.contains(seed)));
            let index = rows.iter().position(|row| row.point == point).unwrap_or_else(|| {
                rows.push(SweepRow { point, metrics: vec![], progress: vec![] });
                rows.len() - 1
            });
            let Some(metrics) = run.metrics() else { continue };
            for name in score_names(&metrics["mean"]) {
                if !scores.contains(&name) {
                    scores.push(name);
                }
            }
            let row = &mut rows[index];
            if row.metrics.is_empty() {
                row.progress = load_progress(&run.folder);
            }
            row.metrics.push(metrics);
        }
        Self { runs: runs.len(), ..Self::from_rows(rows, scores, seeds, baseline) }
    }

    /// Sorts the rows.
    pub fn from_rows(
        mut rows: Vec<SweepRow>,
        scores: Vec<String>,
        seeds: Vec<String>,
        baseline: Option<(&'static str, &'static str)>,
    ) -> Self {
        // Stable, so that equal rows keep the order of the grid.
        let psnr = |row: &SweepRow| row.score("psnr").unwrap_or(f64::NEG_INFINITY);
        rows.sort_by(|a, b| psnr(b).total_cmp(&psnr(a)));
        Self { keys: differing(&rows), rows, scores, seeds, runs: 0, baseline }
    }

    pub fn has_seeds(&self) -> bool {
        self.seeds.len() > 1
    }

    /// The settings of a row as a label, without the axis `except`.
    pub fn label(&self, row: &SweepRow, except: Option<&str>) -> String {
        let speaks = |key: &str| {
            ["curve", PRESET, PARTS, RENDERS].contains(&key)
                || (except.is_none() && self.keys.len() == 1)
        };
        let word = |key: &String| {
            let value = row.point.value(key)?;
            Some(if speaks(key) { value.to_owned() } else { format!("{key} {value}") })
        };
        let keys = self.keys.iter().filter(|key| Some(key.as_str()) != except);
        let words: Vec<String> = keys.filter_map(word).collect();
        // A row without settings of its own is the one that others change.
        let whole = || row.point.values.last().map_or("all", |(_, value)| value).to_owned();
        let label = if words.is_empty() && except.is_none() { whole() } else { words.join(", ") };
        if row.knows_references() { format!("{label} (with reference)") } else { label }
    }

    /// The baseline and its name: of the rows with its value, the one with the fewest settings. `None` if there are
    /// several.
    pub fn baseline(&self) -> Option<(&SweepRow, String)> {
        let (key, value) = self.baseline?;
        let matching = || self.rows.iter().filter(|row| row.point.value(key) == Some(value));
        let fewest = matching().map(|row| row.point.values.len()).min()?;
        let mut rows = matching().filter(|row| row.point.values.len() == fewest);
        let row = rows.next().filter(|_| rows.next().is_none())?;
        Some((row, format!("{key} {value}")))
    }
}

impl SweepRow {
    /// Mean over finished runs of the number at a JSON pointer in `metrics.json`.
    pub fn mean(&self, pointer: &str) -> Option<f64> {
        mean(&self.values(pointer))
    }

    /// Sample standard deviation; `None` for fewer than two runs.
    pub fn deviation(&self, pointer: &str) -> Option<f64> {
        let values = self.values(pointer);
        let mean = mean(&values).filter(|_| values.len() > 1)?;
        let squares = values.iter().map(|value| (value - mean) * (value - mean));
        Some((squares.sum::<f64>() / (values.len() - 1) as f64).sqrt())
    }

    /// Mean of a score.
    pub fn score(&self, name: &str) -> Option<f64> {
        self.mean(&pointer(name))
    }

    /// Minimum and maximum of a score; `None` for fewer than two runs.
    pub fn extremes(&self, name: &str) -> Option<[f64; 2]> {
        let values = self.values(&pointer(name));
        let least = values.iter().copied().min_by(f64::total_cmp)?;
        let greatest = values.iter().copied().max_by(f64::total_cmp)?;
        (values.len() > 1).then_some([least, greatest])
    }

    /// Whether the targets of a run depend on references.
    pub fn knows_references(&self) -> bool {
        self.metrics.iter().any(|metrics| metrics.get(WITH_REFERENCE).is_some())
    }

    /// The images that scores compare with, unless these are the references.
    pub fn against(&self) -> Option<&str> {
        self.metrics.iter().find_map(|metrics| metrics.get(AGAINST)?.as_str())
    }

    fn values(&self, pointer: &str) -> Vec<f64> {
        // Without a denoiser, the scored image is R_0.
        let value = |metrics: &Value| {
            let found =
                metrics.pointer(pointer).or_else(|| metrics.pointer(&pointer.replace("/r0", "")));
            found?.as_f64()
        };
        self.metrics.iter().filter_map(value).collect()
    }
}

/// The JSON pointer of a score in `metrics.json`.
fn pointer(score: &str) -> String {
    format!("/mean/{score}")
}

/// Names of scores: `psnr`, or `r0/psnr` for R_0.
fn score_names(mean: &Value) -> Vec<String> {
    let names = |(name, value): (&String, &Value)| match value.as_object() {
        Some(inner) => inner.keys().map(|key| format!("{name}/{key}")).collect(),
        None => vec![name.clone()],
    };
    mean.as_object().into_iter().flatten().flat_map(names).collect()
}

/// The axes along which the points differ; all axes if there is one point.
fn differing(rows: &[SweepRow]) -> Vec<String> {
    let mut keys: Vec<&String> = vec![];
    // The point with the most axes determines the order.
    let mut points: Vec<&SweepPoint> = rows.iter().map(|row| &row.point).collect();
    points.sort_by_key(|point| std::cmp::Reverse(point.values.len()));
    for (key, _) in points.iter().flat_map(|point| &point.values) {
        if !keys.contains(&key) {
            keys.push(key);
        }
    }
    let differs =
        |key: &&&String| points.windows(2).any(|pair| pair[0].value(key) != pair[1].value(key));
    let differing: Vec<String> = keys.iter().filter(differs).map(|key| (*key).clone()).collect();
    if differing.is_empty() { keys.into_iter().cloned().collect() } else { differing }
}

/// The mean; `None` if empty.
fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// A number for CSV with all digits; empty for `None`.
pub(super) fn number(value: Option<f64>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}
