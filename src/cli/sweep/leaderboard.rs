//! The leaderboard: a row per point, seeds averaged, the best first.

use std::path::Path;

use serde_json::Value;

use crate::Result;
use crate::base::output::{csv_field, write_whole};
use crate::cli::batch::Run;
use crate::cli::batch::csv::number;
use crate::cli::batch::point::{ADAPTIVE, OFFSET, Point, SEED};
use crate::cli::batch::runner::Failure;
use crate::cli::batch::sample::{deviation, mean};
use crate::gpu::Gpu;
use crate::networks::lpips::Measure;
use crate::photographs::dataset::Dataset;
use crate::photographs::image::Image;
use crate::results::eval::{AGAINST, WITH_REFERENCE};
use crate::results::report::{
    Bar, Best, Column, Comparison, Mark, Picture, Report, Series, Table, bars, plot_points,
};

/// The files of a leaderboard.
pub(super) const FILES: [&str; 4] =
    ["leaderboard.csv", "leaderboard.md", "index.html", "timings.csv"];

/// More lines than this in a plot are no longer told apart.
const MAX_LINES: usize = 8;

/// The best rows whose pictures are shown.
const MAX_PICTURES: usize = 8;

/// The scores of a point, over its seeds.
#[derive(Clone, Debug)]
struct Row {
    /// The point without its seed.
    point: Point,
    /// `metrics.json` of every finished run.
    metrics: Vec<Value>,
}

/// What a sweep found. It holds nothing that depends on how long anything took, but for the timings.
#[derive(Clone, Debug)]
pub(super) struct Leaderboard {
    dataset: String,
    /// What all runs have in common.
    settings: String,
    /// Those whose values differ, in the order of the names; never the seed.
    keys: Vec<String>,
    /// The best PSNR first.
    rows: Vec<Row>,
    /// The names of the scores, as `metrics.json` has them.
    scores: Vec<String>,
    has_seeds: bool,
    baseline: Option<&'static str>,
    /// delta0 of the adaptive black level.
    adaptive_offset: Option<f64>,
    /// Name and seconds of every finished run.
    timings: Vec<(String, Option<f64>)>,
}

impl Leaderboard {
    /// Reads what the finished ones of `runs` scored; differences are to the row of the curve `baseline`.
    pub(super) fn new(
        runs: &[Run],
        baseline: Option<&'static str>,
        adaptive_offset: Option<f64>,
        shared: &[String],
    ) -> Self {
        let mut rows: Vec<Row> = vec![];
        let (mut timings, mut scores, mut seeds) = (vec![], vec![], vec![]);
        for run in runs {
            let mut point = run.point.clone();
            point.values.retain(|(key, _)| key != SEED);
            seeds.extend(run.point.value(SEED).filter(|seed| !seeds.contains(seed)));
            let index = rows.iter().position(|row| row.point == point).unwrap_or_else(|| {
                rows.push(Row { point, metrics: vec![] });
                rows.len() - 1
            });
            let Some(metrics) = run.metrics() else { continue };
            for name in metrics["mean"].as_object().into_iter().flat_map(|mean| mean.keys()) {
                if !scores.contains(name) {
                    scores.push(name.clone());
                }
            }
            timings.push((run.name.clone(), metrics["seconds"].as_f64()));
            rows[index].metrics.push(metrics);
        }
        // Stable: equals keep the order of the grid, and what has no score comes last.
        let psnr = |row: &Row| row.mean("psnr").unwrap_or(f64::NEG_INFINITY);
        rows.sort_by(|a, b| psnr(b).total_cmp(&psnr(a)));
        let dataset = runs.first().map(|run| run.config.dataset.display().to_string());
        Self {
            dataset: dataset.unwrap_or_default(),
            settings: settings(runs, &seeds, shared),
            keys: differing(runs),
            rows,
            scores,
            has_seeds: seeds.len() > 1,
            baseline,
            adaptive_offset,
            timings,
        }
    }

    /// Writes [`FILES`] to `folder`.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(super) fn save(
        &self,
        folder: &Path,
        failures: &[Failure],
        pictures: Option<Comparison>,
    ) -> Result<()> {
        let [csv, markdown, html, timings] = FILES.map(|file| folder.join(file));
        write_whole(&csv, self.csv().as_bytes())?;
        write_whole(&markdown, self.markdown(failures).as_bytes())?;
        write_whole(&html, self.html(failures, pictures).as_bytes())?;
        let mut text = "point,seconds\n".to_owned();
        for (name, seconds) in &self.timings {
            text += &format!("{},{}\n", csv_field(name), number(*seconds));
        }
        write_whole(&timings, text.as_bytes())
    }

    /// The rows with their scores and, where there is a baseline, how far they are from it.
    pub(super) fn table(&self) -> Table {
        let mut columns = vec![];
        let baseline = self.baseline_row();
        for score in &self.scores {
            let column = column(score);
            let beside = |what: &str| Column {
                name: what.to_owned(),
                best: Best::Unmarked,
                ..column.clone()
            };
            let spread = self.has_seeds.then(|| beside("sd"));
            let gain = baseline.map(|_| beside("gain"));
            columns.push(column);
            columns.extend(spread.into_iter().chain(gain));
        }
        let plain = |name: &str| Column { name: name.to_owned(), ..Column::default() };
        columns.push(plain("Gaussians"));
        columns.extend(self.has_seeds.then(|| plain("seeds")));
        let values = |row: &Row| {
            let mut values = vec![];
            for score in &self.scores {
                let mean = row.mean(score);
                values.push(mean);
                values.extend(self.has_seeds.then(|| row.deviation(score)));
                let gain = |base: &Row| Some(mean? - base.mean(score)?);
                values.extend(baseline.map(gain));
            }
            values.push(row.gaussians());
            values.extend(self.has_seeds.then_some(Some(row.metrics.len() as f64)));
            values
        };
        Table {
            title: "Means over the test views".to_owned(),
            label: self
                .keys
                .first()
                .filter(|_| self.keys.len() == 1)
                .map_or("point", |key| key)
                .to_owned(),
            columns,
            rows: self.rows.iter().map(|row| (self.label(row, None), values(row))).collect(),
        }
    }

    fn csv(&self) -> String {
        let mut header = self.keys.clone();
        for score in &self.scores {
            header.push(score.clone());
            header.extend(self.has_seeds.then(|| format!("{score}_sd")));
        }
        let is_marked = self.rows.iter().any(Row::knows_references);
        header.extend(["gaussians", "runs"].map(str::to_owned));
        let against = self.rows.iter().any(|row| row.yardstick().is_some());
        header.extend(is_marked.then(|| WITH_REFERENCE.to_owned()));
        header.extend(against.then(|| AGAINST.to_owned()));
        let cells = |row: &Row| {
            let values =
                self.keys.iter().map(|key| csv_field(row.point.value(key).unwrap_or_default()));
            let mut cells: Vec<String> = values.collect();
            for score in &self.scores {
                cells.push(number(row.mean(score)));
                cells.extend(self.has_seeds.then(|| number(row.deviation(score))));
            }
            cells.extend([number(row.gaussians()), row.metrics.len().to_string()]);
            cells.extend(is_marked.then(|| row.knows_references().to_string()));
            cells.extend(against.then(|| csv_field(row.yardstick().unwrap_or_default())));
            cells.join(",")
        };
        let lines = std::iter::once(header.join(",")).chain(self.rows.iter().map(cells));
        lines.map(|line| line + "\n").collect()
    }

    fn markdown(&self, failures: &[Failure]) -> String {
        let mut text = format!("# {}\n\n{}", self.title(), self.table().markdown());
        for paragraph in self.notes(failures) {
            text += &format!("\n{paragraph}\n");
        }
        text
    }

    /// The first test view with a reference image as it came in, as the best rows show it, and as it should be.
    ///
    /// # Errors
    /// A model cannot be read, or the device is lost.
    pub(super) fn pictures(
        &self,
        runs: &[Run],
        dataset: &Dataset,
        gpu: &Gpu,
    ) -> Result<Option<Comparison>> {
        let Some(view) = dataset.test_views().find(|view| view.has_reference()) else {
            return Ok(None);
        };
        let picture = |caption: &str, scores: String, image: &Image| Picture {
            caption: caption.to_owned(),
            scores,
            image: image.clone(),
        };
        let dark = view.loaded()?;
        let mut pictures: Vec<Picture> =
            dark.iter().map(|dark| picture("photograph", String::new(), dark)).collect();
        for row in &self.rows {
            let is_its = |run: &&Run| is_point(&run.point, &row.point) && run.metrics().is_some();
            let Some(run) = runs.iter().find(is_its) else { continue };
            let metrics = run.metrics().unwrap_or_default();
            let psnr = metrics["views"][&view.name]["psnr"].as_f64();
            let scores = psnr.map_or_else(String::new, |psnr| format!("{psnr:.2} dB"));
            pictures.push(picture(&self.label(row, None), scores, &run.render(gpu, view)?));
            if pictures.len() > MAX_PICTURES {
                break;
            }
        }
        let reference = view.loaded_reference()?;
        pictures.extend(reference.map(|image| picture("reference", String::new(), &image)));
        Ok(Some(Comparison { title: format!("Test view {}", view.name), pictures }))
    }

    fn html(&self, failures: &[Failure], pictures: Option<Comparison>) -> String {
        let report = Report {
            title: self.title(),
            intro: self.notes(failures),
            tables: vec![self.table()],
            plots: self.plots(),
            comparisons: pictures.into_iter().collect(),
            ..Report::default()
        };
        report.html()
    }

    fn title(&self) -> String {
        format!("Sweep of {}", self.dataset)
    }

    fn notes(&self, failures: &[Failure]) -> Vec<String> {
        let mut notes = vec![self.settings.clone()];
        if self.baseline_row().is_some() {
            let curve = self.baseline.unwrap_or_default();
            notes.push(format!("Gains are differences to the row of the curve {curve}."));
        }
        if self.scores.is_empty() {
            notes.push(
                "No test view has a reference image or a photograph, so there is nothing to rank."
                    .to_owned(),
            );
        }
        if self.rows.iter().any(Row::knows_references) {
            notes.push("Rows with reference have targets that know references and are not comparable with the others.".to_owned());
        }
        let mut yardsticks: Vec<&str> = self.rows.iter().filter_map(Row::yardstick).collect();
        yardsticks.sort_unstable();
        yardsticks.dedup();
        notes.extend(yardsticks.iter().map(|against| format!("Test views are scored {against}.")));
        if let Some(offset) = self.adaptive_offset {
            notes.push(format!(
                "The adaptive black level is {offset:.4}, the mean of delta0 over the training views."
            ));
        }
        let failed =
            failures.iter().map(|Failure { name, reason }| format!("{name} failed: {reason}"));
        notes.extend(failed);
        notes
    }

    /// PSNR against every setting whose values are numbers; where there is none, a bar per row.
    fn plots(&self) -> Vec<String> {
        let psnr = column("psnr");
        // The same line has the same number in every plot.
        let mut lines = vec![];
        let numeric = self.keys.iter().filter_map(|key| self.against(key, &psnr.name, &mut lines));
        let plots: Vec<String> = numeric.collect();
        let has_scores = self.rows.iter().any(|row| row.mean("psnr").is_some());
        if !plots.is_empty() || !has_scores {
            return plots;
        }
        let bar = |row: &Row| Bar {
            name: self.label(row, None),
            value: row.mean("psnr").unwrap_or(f64::NAN),
            spread: row.extremes("psnr"),
        };
        let rows: Vec<Bar> = self.rows.iter().map(bar).collect();
        vec![bars(&psnr.name, psnr.digits, &rows)]
    }

    /// A line for every combination of the other settings; none where `key` is no number, or lines are too many.
    fn against(&self, key: &str, y_name: &str, known: &mut Vec<String>) -> Option<String> {
        let is_special = |value: &str| key == OFFSET && value == ADAPTIVE;
        let values = self.rows.iter().filter_map(|row| row.point.value(key));
        let numbers: Vec<f64> = values
            .filter(|value| !is_special(value))
            .map(|value| value.parse().ok().filter(|number: &f64| number.is_finite()))
            .collect::<Option<_>>()?;
        let low = numbers.iter().copied().min_by(f64::total_cmp)?;
        let high = numbers.iter().copied().max_by(f64::total_cmp)?;
        if low == high {
            return None;
        }
        let (mut lines, mut marks): (Vec<Series>, Vec<Mark>) = (vec![], vec![]);
        for row in &self.rows {
            let Some(psnr) = row.mean("psnr") else { continue };
            let name = self.label(row, Some(key));
            let points = match row.point.value(key) {
                Some(value) if is_special(value) => {
                    let offset = self.adaptive_offset?;
                    let name = format!("{name} adaptive {offset:.3}").trim().to_owned();
                    marks.push(Mark { name, point: (offset, psnr) });
                    continue;
                }
                Some(value) => vec![(value.parse().ok()?, psnr)],
                // What has no such setting is level.
                None => vec![(low, psnr), (high, psnr)],
            };
            let spread = row.extremes("psnr").filter(|_| points.len() == 1);
            let spreads = spread.map(|[low, high]| (points[0].0, low, high));
            match lines.iter_mut().find(|line| line.name == name) {
                Some(line) => {
                    line.points.extend(points);
                    line.spreads.extend(spreads);
                }
                None => {
                    let spreads = spreads.into_iter().collect();
                    lines.push(Series { name, points, spreads, ..Series::default() });
                }
            }
        }
        // A lone point shows nothing of the setting.
        lines.retain(|line| line.points.len() > 1);
        for line in &mut lines {
            line.points.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        lines.sort_by(|a, b| a.name.cmp(&b.name));
        for line in &mut lines {
            let place = known.iter().position(|name| *name == line.name);
            line.line = Some(place.unwrap_or(known.len()));
            if place.is_none() {
                known.push(line.name.clone());
            }
        }
        let is_legible = (1..=MAX_LINES).contains(&lines.len());
        is_legible.then(|| plot_points(key, y_name, &lines, &marks))
    }

    /// What distinguishes the row, but for `except`.
    fn label(&self, row: &Row, except: Option<&str>) -> String {
        let keys = || self.keys.iter().filter(|key| Some(key.as_str()) != except);
        let speaks = |key: &str| key == "curve" || (except.is_none() && self.keys.len() == 1);
        let word = |key: &String| {
            let value = row.point.value(key)?;
            Some(if speaks(key) { value.to_owned() } else { format!("{key} {value}") })
        };
        let words: Vec<String> = keys().filter_map(word).collect();
        let label =
            if words.is_empty() && except.is_none() { "all".to_owned() } else { words.join(", ") };
        if row.knows_references() { format!("{label} (with reference)") } else { label }
    }

    /// The row that others are compared with; none where it is not the only one of its curve.
    fn baseline_row(&self) -> Option<&Row> {
        let baseline = self.baseline?;
        let mut rows = self.rows.iter().filter(|row| row.point.value("curve") == Some(baseline));
        rows.next().filter(|_| rows.next().is_none())
    }
}

impl Row {
    /// The mean of a score over the runs that have it.
    fn mean(&self, score: &str) -> Option<f64> {
        mean(&self.values(score))
    }

    /// The standard deviation of a sample of at least two.
    fn deviation(&self, score: &str) -> Option<f64> {
        deviation(&self.values(score))
    }

    /// The least and the greatest of at least two runs.
    fn extremes(&self, score: &str) -> Option<[f64; 2]> {
        let values = self.values(score);
        let least = values.iter().copied().min_by(f64::total_cmp)?;
        let greatest = values.iter().copied().max_by(f64::total_cmp)?;
        (values.len() > 1).then_some([least, greatest])
    }

    /// A run's targets knew references.
    fn knows_references(&self) -> bool {
        self.metrics.iter().any(|metrics| metrics.get(WITH_REFERENCE).is_some())
    }

    /// What its scores are against, where that is no reference image.
    fn yardstick(&self) -> Option<&str> {
        self.metrics.iter().find_map(|metrics| metrics.get(AGAINST)?.as_str())
    }

    fn gaussians(&self) -> Option<f64> {
        let counts = self.metrics.iter().filter_map(|metrics| metrics["gaussians"].as_f64());
        mean(&counts.collect::<Vec<_>>())
    }

    fn values(&self, score: &str) -> Vec<f64> {
        self.metrics.iter().filter_map(|metrics| metrics["mean"][score].as_f64()).collect()
    }
}

/// Whether a run's point is a row's but for the seed.
fn is_point(of_run: &Point, of_row: &Point) -> bool {
    let mut point = of_run.clone();
    point.values.retain(|(key, _)| key != SEED);
    point == *of_row
}

/// A sentence on what the runs are, and what all were given.
fn settings(runs: &[Run], seeds: &[&str], shared: &[String]) -> String {
    let mut steps: Vec<u64> = runs.iter().map(|run| run.config.steps).collect();
    steps.sort_unstable();
    steps.dedup();
    let steps: Vec<String> = steps.iter().map(u64::to_string).collect();
    let mut text = format!("{} runs of {} steps", runs.len(), steps.join(" or "));
    if seeds.len() > 1 {
        let seeds = seeds.join(", ");
        text += &format!(
            "; scores are means over the seeds {seeds}, and bars their least and greatest"
        );
    }
    if !shared.is_empty() {
        text += &format!("; all with {}", shared.join(" "));
    }
    text + ". The folder of each run has its config.toml."
}

/// The axes but for the seed along which the runs differ; all of them where there is one run.
fn differing(runs: &[Run]) -> Vec<String> {
    // The run with the most axes has all of them in order.
    let longest = runs.iter().map(|run| &run.point).max_by_key(|point| point.values.len());
    let keys: Vec<&String> =
        longest.into_iter().flat_map(|point| &point.values).map(|(key, _)| key).collect();
    let keys = || keys.iter().filter(|key| key.as_str() != SEED).map(|key| (*key).clone());
    let differs = |key: &String| {
        runs.windows(2).any(|pair| pair[0].point.value(key) != pair[1].point.value(key))
    };
    let differing: Vec<String> = keys().filter(differs).collect();
    if differing.is_empty() { keys().collect() } else { differing }
}

/// How a score of `metrics.json` is shown.
fn column(score: &str) -> Column {
    if let Some(measure) = Measure::all().find(|measure| measure.key() == score) {
        return Column { name: measure.title(), digits: 3, best: Best::Least };
    }
    let (name, digits, best) = match score {
        "psnr" => ("PSNR, dB", 2, Best::Greatest),
        "psnr_channel_mean" => ("channel-mean PSNR, dB", 2, Best::Greatest),
        "ssim" => ("SSIM", 3, Best::Greatest),
        other => (other, 4, Best::Unmarked),
    };
    Column { name: name.to_owned(), digits, best }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_every_lpips_the_least_is_best() {
        for measure in Measure::all() {
            let Column { name, best, .. } = column(&measure.key());
            assert!(matches!(best, Best::Least) && name == measure.title(), "{name}");
        }
    }
}
