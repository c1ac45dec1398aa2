//! The leaderboard: a row per point, seeds averaged, the best first. It does not depend on training times.

use std::path::Path;

use nightsplat_core::output::write_whole;
use nightsplat_photographs::dataset::Dataset;
use nightsplat_photographs::image::Image;
use nightsplat_photographs::metrics::Scores;
use nightsplat_report::{Chart, Column, Comparison, Mark, NumberTable, Picture, Report, Series};

use super::point::{ADAPTIVE, OFFSET};
use super::rows::{SweepResults, SweepRow};
use super::run::{FailedPoint, SweepRun};
use super::table::{ColumnStatistic, CsvColumn, Quantity};
use crate::Result;
use crate::gpu::Gpu;
use crate::results::eval::{AGAINST, WITH_REFERENCE};

/// The files of a leaderboard.
pub const FILES: [&str; 3] = ["leaderboard.csv", "leaderboard.md", "index.html"];

/// The heading of the charted score.
const PSNR: &str = "PSNR, dB";

/// Lines in a plot beyond which they cannot be told apart.
const MAX_LINES: usize = 8;

/// Number of rows whose images are shown.
const MAX_PICTURES: usize = 8;

/// The leaderboard of a sweep.
#[derive(Clone, Debug)]
pub struct Leaderboard<'a> {
    pub rows: &'a SweepResults,
    pub title: String,
    /// First paragraphs of the page.
    pub intro: Vec<String>,
    /// A page of a model, shown first: address and text.
    pub window: Option<[String; 2]>,
    /// Mean delta0 of the adaptive black level.
    pub adaptive_offset: Option<f64>,
    pub failures: &'a [FailedPoint],
}

impl Leaderboard<'_> {
    /// Writes [`FILES`] to `folder`.
    pub fn save(&self, folder: &Path, pictures: Option<Comparison>) -> Result<()> {
        let [csv, markdown, html] = FILES.map(|file| folder.join(file));
        write_whole(&csv, self.csv().as_bytes())?;
        write_whole(&markdown, self.markdown().as_bytes())?;
        write_whole(&html, self.html(pictures).as_bytes())
    }

    /// The rows with their scores and the differences to the baseline, if there is one.
    pub fn table(&self) -> NumberTable {
        let SweepResults { keys, rows, scores, .. } = self.rows;
        let has_seeds = self.rows.has_seeds();
        let mut columns = vec![];
        for quantity in scores.iter().map(|score| Quantity::new(score)) {
            columns.push((quantity.clone(), ColumnStatistic::Mean));
            columns.extend(has_seeds.then(|| (quantity.clone(), ColumnStatistic::Deviation)));
            let gain = self.rows.baseline().map(|_| (quantity, ColumnStatistic::Gain));
            columns.extend(gain);
        }
        columns.push((Quantity::new("gaussians"), ColumnStatistic::Mean));
        let mut table = self.rows.table("Means over the test views", &columns);
        if let [key] = &keys[..] {
            table.label.clone_from(key);
        }
        if has_seeds {
            table.columns.push(Column { name: "seeds".to_owned(), ..Column::default() });
            for ((_, values), row) in table.rows.iter_mut().zip(rows) {
                values.push(Some(row.metrics.len() as f64));
            }
        }
        table
    }

    fn csv(&self) -> String {
        let SweepResults { rows, scores, .. } = self.rows;
        let has_seeds = self.rows.has_seeds();
        let numbers = scores.iter().flat_map(|score| self.rows.csv_numbers(score, has_seeds));
        let mut columns: Vec<CsvColumn> = numbers.collect();
        columns.extend(self.rows.csv_numbers("gaussians", false));
        columns.push(self.rows.csv_column("runs", |_, row| row.metrics.len().to_string()));
        if rows.iter().any(SweepRow::knows_references) {
            let cell = |_, row: &SweepRow| row.knows_references().to_string();
            columns.push(self.rows.csv_column(WITH_REFERENCE, cell));
        }
        if rows.iter().any(|row| row.against().is_some()) {
            let cell = |_, row: &SweepRow| row.against().unwrap_or_default().to_string();
            columns.push(self.rows.csv_column(AGAINST, cell));
        }
        self.rows.csv(columns)
    }

    fn markdown(&self) -> String {
        let mut text = format!("# {}\n\n{}", self.title, self.table().markdown());
        for paragraph in self.notes() {
            text += &format!("\n{paragraph}\n");
        }
        text
    }

    /// The first test view with a reference image: photograph, reference, renders of the best rows.
    pub fn pictures(
        &self,
        runs: &[SweepRun],
        dataset: &Dataset,
        gpu: &Gpu,
    ) -> Result<Option<Comparison>> {
        let Some(view) = dataset.test_views().find(|view| view.has_reference()) else {
            return Ok(None);
        };
        let picture = |caption: &str, scores: String, image: &Image| Picture {
            caption: caption.to_owned(),
            scores,
            image: view.upright(image.clone()),
        };
        let scored = |psnr: Option<f64>, ssim: Option<f64>| {
            let text = |(psnr, ssim)| format!("{psnr:.2} dB, SSIM {ssim:.3}");
            psnr.zip(ssim).map(text).unwrap_or_default()
        };
        let (dark, reference) = (view.loaded()?, view.loaded_reference()?);
        let mut pictures = vec![];
        if let Some(dark) = &dark {
            // A model must beat the score of the photograph itself.
            let of_photograph =
                reference.as_ref().and_then(|reference| Scores::measure(dark, reference).ok());
            let scores = scored(
                of_photograph.map(|scores| scores.psnr),
                of_photograph.map(|scores| scores.ssim),
            );
            pictures.push(picture("photograph", scores, dark));
        }
        // Second, so that it stays in the row of the best renders.
        pictures.extend(reference.map(|image| picture("reference", String::new(), &image)));
        for row in &self.rows.rows {
            let is_its =
                |run: &&SweepRun| run.point.seedless() == row.point && run.metrics().is_some();
            let Some(run) = runs.iter().find(is_its) else { continue };
            let metrics = run.metrics().unwrap_or_default();
            let score = |name: &str| metrics["views"][&view.name][name].as_f64();
            let scores = scored(score("psnr"), score("ssim"));
            pictures.push(picture(
                &self.rows.label(row, None),
                scores,
                &run.render(gpu, dataset, view)?,
            ));
            if pictures.len() > 1 + MAX_PICTURES {
                break;
            }
        }
        Ok(Some(Comparison { title: format!("Test view {}", view.name), pictures }))
    }

    fn html(&self, pictures: Option<Comparison>) -> String {
        let report = Report {
            title: self.title.clone(),
            window: self.window.clone(),
            intro: self.notes(),
            tables: vec![self.table()],
            charts: self.charts(),
            comparisons: pictures.into_iter().collect(),
            ..Report::default()
        };
        report.html()
    }

    /// The paragraphs of the page.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = self.intro.clone();
        if let Some((_, name)) = self.rows.baseline() {
            notes.push(format!("Gains are differences to {name}."));
        }
        if self.rows.rows.iter().any(SweepRow::knows_references) {
            notes.push("Rows marked \"with reference\" were trained on targets that depend on references; they do \
             not compare with the others.".to_owned());
        }
        let mut against: Vec<&str> = self.rows.rows.iter().filter_map(SweepRow::against).collect();
        against.sort_unstable();
        against.dedup();
        notes.extend(against.iter().map(|against| format!("Test views are scored {against}.")));
        if let Some(offset) = self.adaptive_offset {
            notes.push(format!(
                "The adaptive black level is {offset:.4}, the mean of delta0 over the training views."
            ));
        }
        let failed = self
            .failures
            .iter()
            .map(|FailedPoint { name, reason }| format!("{name} failed: {reason}"));
        notes.extend(failed);
        notes
    }

    /// PSNR against every numeric setting; without one, a bar per row.
    fn charts(&self) -> Vec<Chart> {
        // A line keeps its colour in every plot.
        let mut lines = vec![];
        let numeric = self.rows.keys.iter().filter_map(|key| self.against(key, PSNR, &mut lines));
        let charts: Vec<Chart> = numeric.collect();
        let has_scores = self.rows.rows.iter().any(|row| row.score("psnr").is_some());
        if !charts.is_empty() || !has_scores {
            return charts;
        }
        let bar = |(index, row): (usize, &SweepRow)| {
            let x = index as f64;
            let spread = row.extremes("psnr").map(|[low, high]| (x, low, high));
            Series {
                name: self.rows.label(row, None),
                mark: Mark::Bar,
                color: Some(1),
                points: vec![(x, row.score("psnr").unwrap_or(f64::NAN))],
                spreads: spread.into_iter().collect(),
                ..Series::default()
            }
        };
        vec![Chart::new("", PSNR, self.rows.rows.iter().enumerate().map(bar).collect())]
    }

    /// A line for each combination of the other settings; `None` if `key` is not numeric, or there are too many lines.
    fn against(&self, key: &str, y_name: &str, line_names: &mut Vec<String>) -> Option<Chart> {
        let is_special = |value: &str| key == OFFSET && value == ADAPTIVE;
        let values = self.rows.rows.iter().filter_map(|row| row.point.value(key));
        let numbers: Vec<f64> = values
            .filter(|value| !is_special(value))
            .map(|value| value.parse().ok().filter(|number: &f64| number.is_finite()))
            .collect::<Option<_>>()?;
        let low = numbers.iter().copied().min_by(f64::total_cmp)?;
        let high = numbers.iter().copied().max_by(f64::total_cmp)?;
        if low == high {
            return None;
        }
        let (mut lines, mut stars): (Vec<Series>, Vec<Series>) = (vec![], vec![]);
        for row in &self.rows.rows {
            let Some(psnr) = row.score("psnr") else { continue };
            let name = self.rows.label(row, Some(key));
            let points = match row.point.value(key) {
                Some(value) if is_special(value) => {
                    let offset = self.adaptive_offset?;
                    let name = format!("{name} adaptive {offset:.3}").trim().to_owned();
                    let points = vec![(offset, psnr)];
                    stars.push(Series { name, mark: Mark::Star, points, ..Series::default() });
                    continue;
                }
                Some(value) => vec![(value.parse().ok()?, psnr)],
                // A row without this setting is a horizontal line.
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
                    let mark = Mark::Dots;
                    lines.push(Series { name, mark, points, spreads, ..Series::default() });
                }
            }
        }
        // A single point shows no dependence.
        lines.retain(|line| line.points.len() > 1);
        for line in &mut lines {
            line.points.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        lines.sort_by(|a, b| a.name.cmp(&b.name));
        for line in &mut lines {
            let index = line_names.iter().position(|name| *name == line.name);
            line.color = Some(index.unwrap_or(line_names.len()));
            if index.is_none() {
                line_names.push(line.name.clone());
            }
        }
        let is_legible = (1..=MAX_LINES).contains(&lines.len());
        lines.extend(stars);
        is_legible.then(|| Chart::new(key, y_name, lines))
    }
}
