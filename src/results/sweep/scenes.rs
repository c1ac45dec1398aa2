//! The table of a sweep over several datasets, as papers print it.

use std::path::Path;

use nightsplat_core::csv;
use nightsplat_core::output::write_whole;

use super::rows::{SweepResults, SweepRow, number};
use crate::Result;
use crate::networks::lpips::LpipsVersion;

/// The tables, which a later sweep of the folder replaces.
const FILES: [&str; 3] = ["scenes.md", "scenes.csv", "scenes.tex"];

/// A dataset with the results of its sweep.
#[derive(Debug)]
pub struct SceneResults {
    pub name: String,
    pub rows: SweepResults,
}

/// The scores of every point on every dataset.
#[derive(Debug)]
pub struct SceneTable {
    scenes: Vec<String>,
    /// Names of the scores, as `metrics.json` has them below `mean`.
    scores: Vec<String>,
    /// A label, and the scores of each dataset.
    rows: Vec<(String, Vec<Vec<Option<f64>>>)>,
}

impl SceneTable {
    /// Writes [`FILES`] to a folder.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let texts = [self.markdown(), self.csv(), self.latex()];
        FILES
            .iter()
            .zip(texts)
            .try_for_each(|(file, text)| write_whole(&folder.join(file), text.as_bytes()))
    }

    /// Points in the order of the first dataset, best first; those that it lacks follow.
    pub fn new(scenes: &[SceneResults]) -> Self {
        let mut scores = vec!["psnr".to_owned(), "ssim".to_owned()];
        let measures = || LpipsVersion::all().map(LpipsVersion::key);
        let is_scored = |key: &String| scenes.iter().any(|scene| scene.rows.scores.contains(key));
        scores.extend(measures().filter(is_scored));
        let mut points: Vec<&SweepRow> = vec![];
        for row in scenes.iter().flat_map(|scene| &scene.rows.rows) {
            if !points.iter().any(|point| point.point == row.point) {
                points.push(row);
            }
        }
        let rows = points.into_iter().map(|point| {
            let of_scene = |scene: &SceneResults| {
                let row = scene.rows.rows.iter().find(|row| row.point == point.point);
                scores.iter().map(|score| row.and_then(|row| row.score(score))).collect()
            };
            (scenes[0].rows.label(point, None), scenes.iter().map(of_scene).collect())
        });
        Self {
            rows: rows.collect(),
            scenes: scenes.iter().map(|scene| scene.name.clone()).collect(),
            scores,
        }
    }

    /// The means over the datasets; `None` where one has no score.
    fn means(scenes: &[Vec<Option<f64>>]) -> Vec<Option<f64>> {
        let count = scenes.first().map_or(0, Vec::len);
        let mean = |score: usize| {
            let all: Option<Vec<f64>> = scenes.iter().map(|values| values[score]).collect();
            all.map(|all| all.iter().sum::<f64>() / all.len() as f64)
        };
        (0..count).map(mean).collect()
    }

    /// Scores as papers print them: two digits of PSNR, three of the others without the zero before the point.
    fn cell(values: &[Option<f64>]) -> String {
        let text = |(index, value): (usize, &Option<f64>)| match value {
            None => "-".to_owned(),
            Some(value) if index == 0 => format!("{value:.2}"),
            Some(value) => format!("{value:.3}").replacen("0.", ".", 1),
        };
        values.iter().enumerate().map(text).collect::<Vec<_>>().join(" / ")
    }

    /// The headings, and the cells of each row.
    fn cells(&self) -> (Vec<String>, Vec<Vec<String>>) {
        let mut heads = self.scenes.clone();
        heads.extend((self.scenes.len() > 1).then(|| "mean".to_owned()));
        let row = |(label, scenes): &(String, Vec<Vec<Option<f64>>>)| {
            let mut cells = vec![label.clone()];
            cells.extend(scenes.iter().map(|values| Self::cell(values)));
            cells.extend((scenes.len() > 1).then(|| Self::cell(&Self::means(scenes))));
            cells
        };
        (heads, self.rows.iter().map(row).collect())
    }

    fn title(&self) -> String {
        let titles: Vec<String> = self
            .scores
            .iter()
            .map(|score| match LpipsVersion::all().find(|measure| measure.key() == *score) {
                Some(measure) => measure.title(),
                None => score.to_uppercase(),
            })
            .collect();
        titles.join(" / ")
    }

    pub fn markdown(&self) -> String {
        let (heads, rows) = self.cells();
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let mut text = line(&[vec![self.title()], heads.clone()].concat());
        text += &format!("|---|{}\n", "---:|".repeat(heads.len()));
        rows.iter().for_each(|row| text += &line(row));
        text
    }

    fn latex(&self) -> String {
        let (heads, rows) = self.cells();
        let escaped = |cell: &String| {
            let acts = |c: char| "&%$#_{}".contains(c);
            cell.chars()
                .flat_map(|c| acts(c).then_some('\\').into_iter().chain([c]))
                .collect::<String>()
        };
        let line = |cells: &[String]| {
            format!("{} \\\\\n", cells.iter().map(escaped).collect::<Vec<_>>().join(" & "))
        };
        let mut text = line(&[vec![self.title()], heads].concat());
        rows.iter().for_each(|row| text += &line(row));
        text
    }

    fn csv(&self) -> String {
        let mut text = format!("point,scene,{}\n", self.scores.join(","));
        for (label, scenes) in &self.rows {
            let means = Self::means(scenes);
            let mean = (scenes.len() > 1).then_some(("mean", &means));
            let named = self.scenes.iter().map(String::as_str).zip(scenes).chain(mean);
            for (scene, values) in named {
                let rounded = |value: f64| (value * 1e6).round() / 1e6;
                let numbers = values.iter().map(|value| number(value.map(rounded)));
                text += &csv::line([label.clone(), scene.to_owned()].into_iter().chain(numbers));
            }
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_a_cell_per_scene_and_their_mean() {
        let table = SceneTable {
            scenes: vec!["buu".to_owned(), "chair_1".to_owned()],
            scores: vec!["psnr".to_owned(), "ssim".to_owned()],
            rows: vec![
                (
                    "ap3".to_owned(),
                    vec![vec![Some(27.154), Some(0.9)], vec![Some(26.0), Some(1.0)]],
                ),
                ("ase".to_owned(), vec![vec![Some(28.0), Some(0.5)], vec![None, None]]),
            ],
        };
        let expected = "| PSNR / SSIM | buu | chair_1 | mean |\n|---|---:|---:|---:|\n\
                        | ap3 | 27.15 / .900 | 26.00 / 1.000 | 26.58 / .950 |\n\
                        | ase | 28.00 / .500 | - / - | - / - |\n";
        assert_eq!(table.markdown(), expected);
        assert!(table.latex().starts_with("PSNR / SSIM & buu & chair\\_1 & mean \\\\\n"));
        let csv = table.csv();
        assert!(
            csv.contains("ap3,buu,27.154,0.9\n") && csv.contains("ap3,mean,26.577,0.95\n"),
            "{csv}"
        );
        assert!(csv.contains("ase,chair_1,,\n") && csv.contains("ase,mean,,\n"), "{csv}");
    }
}
