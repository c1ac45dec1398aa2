//! The leaderboard: a row per point, seeds averaged, the best first. It does not depend on training times.

use std::path::Path;

use super::point::{ADAPTIVE, OFFSET};
use super::rows::{Row, Rows, number, place};
use super::run::Run;
use super::runner::Failure;
use crate::Result;
use crate::base::output::{csv_field, write_whole};
use crate::gpu::Gpu;
use crate::networks::lpips::Measure;
use crate::photographs::dataset::Dataset;
use crate::photographs::image::Image;
use crate::photographs::metrics::Scores;
use crate::results::eval::{AGAINST, WITH_REFERENCE};
use crate::results::report::{
    Best, Chart, Column, Comparison, Mark, Picture, Report, Series, Table,
};

/// The files of a leaderboard.
pub(super) const FILES: [&str; 3] = ["leaderboard.csv", "leaderboard.md", "index.html"];

/// Lines in a plot beyond which they cannot be told apart.
const MAX_LINES: usize = 8;

/// Number of rows whose images are shown.
const MAX_PICTURES: usize = 8;

/// The leaderboard of a sweep.
#[derive(Clone, Debug)]
pub(super) struct Leaderboard<'a> {
    pub(super) rows: &'a Rows,
    pub(super) title: String,
    /// First paragraphs of the page.
    pub(super) intro: Vec<String>,
    /// Links of the page: address and text.
    pub(super) links: Vec<[String; 2]>,
    /// Mean delta0 of the adaptive black level.
    pub(super) adaptive_offset: Option<f64>,
    pub(super) failures: &'a [Failure],
}

impl Leaderboard<'_> {
    /// Writes [`FILES`] to `folder`.
    pub(super) fn save(&self, folder: &Path, pictures: Option<Comparison>) -> Result<()> {
        let [csv, markdown, html] = FILES.map(|file| folder.join(file));
        write_whole(&csv, self.csv().as_bytes())?;
        write_whole(&markdown, self.markdown().as_bytes())?;
        write_whole(&html, self.html(pictures).as_bytes())
    }

    /// The rows with their scores and the differences to the baseline, if there is one.
    pub(super) fn table(&self) -> Table {
        let Rows { keys, rows, scores, .. } = self.rows;
        let (mut columns, baseline) = (vec![], self.rows.baseline());
        let has_seeds = self.rows.has_seeds();
        for score in scores {
            let column = column(score);
            let beside = |what: &str| Column {
                name: what.to_owned(),
                best: Best::Unmarked,
                ..column.clone()
            };
            let spread = has_seeds.then(|| beside("sd"));
            let gain = baseline.as_ref().map(|_| beside("gain"));
            columns.push(column);
            columns.extend(spread.into_iter().chain(gain));
        }
        let plain = |name: &str| Column { name: name.to_owned(), ..Column::default() };
        columns.push(plain("Gaussians"));
        columns.extend(has_seeds.then(|| plain("seeds")));
        let values = |row: &Row| {
            let mut values = vec![];
            for score in scores {
                let mean = row.score(score);
                values.push(mean);
                values.extend(has_seeds.then(|| row.deviation(&place(score))));
                let gain = |(base, _): &(&Row, String)| Some(mean? - base.score(score)?);
                values.extend(baseline.as_ref().map(gain));
            }
            values.push(row.mean("/gaussians"));
            values.extend(has_seeds.then_some(Some(row.metrics.len() as f64)));
            values
        };
        Table {
            title: "Means over the test views".to_owned(),
            label: keys.first().filter(|_| keys.len() == 1).map_or("point", |key| key).to_owned(),
            columns,
            rows: rows.iter().map(|row| (self.rows.label(row, None), values(row))).collect(),
        }
    }

    fn csv(&self) -> String {
        let Rows { keys, rows, scores, .. } = self.rows;
        let has_seeds = self.rows.has_seeds();
        let mut header = keys.clone();
        for score in scores {
            header.push(score.clone());
            header.extend(has_seeds.then(|| format!("{score}_sd")));
        }
        let is_marked = rows.iter().any(Row::knows_references);
        header.extend(["gaussians", "runs"].map(str::to_owned));
        let against = rows.iter().any(|row| row.against().is_some());
        header.extend(is_marked.then(|| WITH_REFERENCE.to_owned()));
        header.extend(against.then(|| AGAINST.to_owned()));
        let cells = |row: &Row| {
            let values = keys.iter().map(|key| csv_field(row.point.value(key).unwrap_or_default()));
            let mut cells: Vec<String> = values.collect();
            for score in scores {
                cells.push(number(row.score(score)));
                cells.extend(has_seeds.then(|| number(row.deviation(&place(score)))));
            }
            cells.extend([number(row.mean("/gaussians")), row.metrics.len().to_string()]);
            cells.extend(is_marked.then(|| row.knows_references().to_string()));
            cells.extend(against.then(|| csv_field(row.against().unwrap_or_default())));
            cells.join(",")
        };
        let lines = std::iter::once(header.join(",")).chain(rows.iter().map(cells));
        lines.map(|line| line + "\n").collect()
    }

    fn markdown(&self) -> String {
        let mut text = format!("# {}\n\n{}", self.title, self.table().markdown());
        for paragraph in self.notes() {
            text += &format!("\n{paragraph}\n");
        }
        text
    }

    /// The first test view with a reference image: photograph, reference, renders of the best rows.
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
            let own = reference.as_ref().and_then(|reference| Scores::of(dark, reference).ok());
            let scores = scored(own.map(|own| own.psnr), own.map(|own| own.ssim));
            pictures.push(picture("photograph", scores, dark));
        }
        // Second, so that it stays in the row of the best renders.
        pictures.extend(reference.map(|image| picture("reference", String::new(), &image)));
        for row in &self.rows.rows {
            let is_its = |run: &&Run| run.point.seedless() == row.point && run.metrics().is_some();
            let Some(run) = runs.iter().find(is_its) else { continue };
            let metrics = run.metrics().unwrap_or_default();
            let score = |name: &str| metrics["views"][&view.name][name].as_f64();
            let scores = scored(score("psnr"), score("ssim"));
            pictures.push(picture(&self.rows.label(row, None), scores, &run.render(gpu, view)?));
            if pictures.len() > 1 + MAX_PICTURES {
                break;
            }
        }
        Ok(Some(Comparison { title: format!("Test view {}", view.name), pictures }))
    }

    fn html(&self, pictures: Option<Comparison>) -> String {
        let report = Report {
            title: self.title.clone(),
            intro: self.notes(),
            links: self.links.clone(),
            tables: vec![self.table()],
            charts: self.charts(),
            comparisons: pictures.into_iter().collect(),
            ..Report::default()
        };
        report.html()
    }

    /// The paragraphs of the page.
    pub(super) fn notes(&self) -> Vec<String> {
        let mut notes = self.intro.clone();
        if let Some((_, name)) = self.rows.baseline() {
            notes.push(format!("Gains are differences to {name}."));
        }
        if self.rows.rows.iter().any(Row::knows_references) {
            notes.push("Rows marked \"with reference\" were trained on targets that depend on references; they do \
             not compare with the others.".to_owned());
        }
        let mut against: Vec<&str> = self.rows.rows.iter().filter_map(Row::against).collect();
        against.sort_unstable();
        against.dedup();
        notes.extend(against.iter().map(|against| format!("Test views are scored {against}.")));
        if let Some(offset) = self.adaptive_offset {
            notes.push(format!(
                "The adaptive black level is {offset:.4}, the mean of delta0 over the training views."
            ));
        }
        let failed =
            self.failures.iter().map(|Failure { name, reason }| format!("{name} failed: {reason}"));
        notes.extend(failed);
        notes
    }

    /// PSNR against every numeric setting; without one, a bar per row.
    fn charts(&self) -> Vec<Chart> {
        let psnr = column("psnr");
        // A line keeps its colour in every plot.
        let mut lines = vec![];
        let numeric =
            self.rows.keys.iter().filter_map(|key| self.against(key, &psnr.name, &mut lines));
        let charts: Vec<Chart> = numeric.collect();
        let has_scores = self.rows.rows.iter().any(|row| row.score("psnr").is_some());
        if !charts.is_empty() || !has_scores {
            return charts;
        }
        let bar = |(index, row): (usize, &Row)| {
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
        vec![Chart::new("", &psnr.name, self.rows.rows.iter().enumerate().map(bar).collect())]
    }

    /// A line for each combination of the other settings; `None` if `key` is not numeric, or there are too many lines.
    fn against(&self, key: &str, y_name: &str, known: &mut Vec<String>) -> Option<Chart> {
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
            let place = known.iter().position(|name| *name == line.name);
            line.color = Some(place.unwrap_or(known.len()));
            if place.is_none() {
                known.push(line.name.clone());
            }
        }
        let is_legible = (1..=MAX_LINES).contains(&lines.len());
        lines.extend(stars);
        is_legible.then(|| Chart::new(key, y_name, lines))
    }
}

/// Heading and digits of a score of `metrics.json`.
fn column(score: &str) -> Column {
    if let Some(measure) = Measure::all().find(|measure| measure.key() == score) {
        return Column { name: measure.title(), digits: 3, best: Best::Least };
    }
    if let Some(score) = score.strip_prefix("r0/") {
        let column = column(score);
        return Column { name: format!("{} of R_0", column.name), ..column };
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
