//! The table of a sweep over several datasets, as papers print it, and the page over all of them.

use std::fmt::Write as _;
use std::path::Path;

use nightsplat_core::csv;
use nightsplat_core::output::write_whole;
use nightsplat_report::{Best, Chart, Mark, Report, Series, escape};

use super::rows::{SweepResults, SweepRow, number};
use super::table::Quantity;
use crate::Result;
use crate::networks::lpips::LpipsVersion;

/// The tables and the page, which a later sweep of the folder replaces.
const FILES: [&str; 4] = ["scenes.md", "scenes.csv", "scenes.tex", "index.html"];

/// A dataset with the results of its sweep.
#[derive(Debug)]
pub struct SceneResults {
    pub name: String,
    pub rows: SweepResults,
}

/// A score of a point on a dataset: the mean over its seeds and, of several, their standard deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct SceneScore {
    mean: Option<f64>,
    deviation: Option<f64>,
}

/// The scores of every point on every dataset.
#[derive(Debug)]
pub struct SceneTable {
    scenes: Vec<String>,
    /// Names of the scores, as `metrics.json` has them below `mean`.
    scores: Vec<String>,
    /// A label, and the scores of each dataset; the best mean PSNR first.
    rows: Vec<(String, Vec<Vec<SceneScore>>)>,
}

/// How a table marks its parts.
struct Markup {
    best: [&'static str; 2],
    plus_minus: &'static str,
}

impl SceneTable {
    /// Writes [`FILES`] to a folder, in which every dataset has a folder of its own with a page.
    pub fn save(&self, folder: &Path) -> Result<()> {
        let texts = [self.markdown(), self.csv(), self.latex(), self.html(folder)];
        FILES
            .iter()
            .zip(texts)
            .try_for_each(|(file, text)| write_whole(&folder.join(file), text.as_bytes()))
    }

    /// The points by their mean PSNR over the datasets, best first; those that lack one follow.
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
                let score = |name: &String| SceneScore {
                    mean: row.and_then(|row| row.score(name)),
                    deviation: row.and_then(|row| row.deviation(&Quantity::new(name).pointer)),
                };
                scores.iter().map(score).collect()
            };
            (scenes[0].rows.label(point, None), scenes.iter().map(of_scene).collect())
        });
        let rows = rows.collect();
        let scenes = scenes.iter().map(|scene| scene.name.clone()).collect();
        Self { scenes, scores, rows }.sorted()
    }

    fn sorted(mut self) -> Self {
        let psnr =
            |scenes: &[Vec<SceneScore>]| Self::means(scenes)[0].mean.unwrap_or(f64::NEG_INFINITY);
        // Stable: equal points keep the order of the first dataset.
        self.rows.sort_by(|a, b| psnr(&b.1).total_cmp(&psnr(&a.1)));
        self
    }

    /// The means over the datasets, with no deviation; none where a dataset has no score.
    fn means(scenes: &[Vec<SceneScore>]) -> Vec<SceneScore> {
        let count = scenes.first().map_or(0, Vec::len);
        let mean = |score: usize| {
            let all: Option<Vec<f64>> = scenes.iter().map(|values| values[score].mean).collect();
            let mean = all.map(|all| all.iter().sum::<f64>() / all.len() as f64);
            SceneScore { mean, deviation: None }
        };
        (0..count).map(mean).collect()
    }

    /// The columns of a row: the datasets and, of several, their mean.
    fn columns(scenes: &[Vec<SceneScore>]) -> Vec<Vec<SceneScore>> {
        let mut columns = scenes.to_vec();
        columns.extend((scenes.len() > 1).then(|| Self::means(scenes)));
        columns
    }

    /// A number as papers print it: two digits of PSNR, three of the others without the zero before the point.
    fn digits(score: usize, value: f64) -> String {
        if score == 0 {
            return format!("{value:.2}");
        }
        let text = format!("{value:.3}");
        text.strip_prefix('0').map_or(text.clone(), str::to_owned)
    }

    /// Whether a printed value is the best of its column.
    fn is_best(&self, column: usize, score: usize, value: f64) -> bool {
        let of_row = |(_, scenes): &(String, Vec<Vec<SceneScore>>)| {
            Self::columns(scenes)[column][score].mean
        };
        let all: Vec<f64> = self.rows.iter().filter_map(of_row).collect();
        let best = match Quantity::new(&self.scores[score]).best() {
            Best::Least => all.iter().copied().min_by(f64::total_cmp),
            _ => all.iter().copied().max_by(f64::total_cmp),
        };
        let is_equal = |best: f64| Self::digits(score, best) == Self::digits(score, value);
        all.len() > 1 && best.is_some_and(is_equal)
    }

    /// The cells of each row after its label.
    fn cells(&self, markup: &Markup) -> Vec<(String, Vec<String>)> {
        let Markup { best: [open, close], plus_minus } = markup;
        let text = |column: usize, (score, found): (usize, &SceneScore)| {
            let Some(mean) = found.mean else { return "-".to_owned() };
            let mut text = Self::digits(score, mean);
            if let Some(deviation) = found.deviation {
                text += &format!(" {plus_minus} {}", Self::digits(score, deviation));
            }
            if self.is_best(column, score, mean) { format!("{open}{text}{close}") } else { text }
        };
        let cell = |(column, scores): (usize, &Vec<SceneScore>)| {
            let texts = scores.iter().enumerate().map(|score| text(column, score));
            texts.collect::<Vec<_>>().join(" / ")
        };
        let row = |(label, scenes): &(String, Vec<Vec<SceneScore>>)| {
            let columns = Self::columns(scenes);
            (label.clone(), columns.iter().enumerate().map(cell).collect())
        };
        self.rows.iter().map(row).collect()
    }

    fn heads(&self) -> Vec<String> {
        let mut heads = self.scenes.clone();
        heads.extend((self.scenes.len() > 1).then(|| "mean".to_owned()));
        heads
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
        let heads = self.heads();
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let mut text = line(&[vec![self.title()], heads.clone()].concat());
        text += &format!("|---|{}\n", "---:|".repeat(heads.len()));
        for (label, cells) in self.cells(&Markup { best: ["**", "**"], plus_minus: "±" }) {
            text += &line(&[vec![label.replace('|', "\\|")], cells].concat());
        }
        text
    }

    fn latex(&self) -> String {
        let escaped = |cell: &String| {
            let acts = |c: char| "&%$#_{}".contains(c);
            cell.chars()
                .flat_map(|c| acts(c).then_some('\\').into_iter().chain([c]))
                .collect::<String>()
        };
        let line = |cells: &[String]| format!("{} \\\\\n", cells.join(" & "));
        let heads: Vec<String> =
            [vec![self.title()], self.heads()].concat().iter().map(escaped).collect();
        let mut text = line(&heads);
        for (label, cells) in self.cells(&Markup { best: ["\\textbf{", "}"], plus_minus: "$\\pm$" })
        {
            text += &line(&[vec![escaped(&label)], cells].concat());
        }
        text
    }

    fn csv(&self) -> String {
        let has_deviations = self.deviates();
        let head = |score: &String| match has_deviations {
            true => format!("{score},{score}_sd"),
            false => score.clone(),
        };
        let heads: Vec<String> = self.scores.iter().map(head).collect();
        let mut text = format!("point,scene,{}\n", heads.join(","));
        for (label, scenes) in &self.rows {
            for (scene, scores) in self.heads().iter().zip(Self::columns(scenes)) {
                let rounded = |value: f64| (value * 1e6).round() / 1e6;
                let numbers = scores.iter().flat_map(|SceneScore { mean, deviation }| {
                    let deviation = has_deviations.then(|| number(deviation.map(rounded)));
                    std::iter::once(number(mean.map(rounded))).chain(deviation)
                });
                text += &csv::line([label.clone(), scene.clone()].into_iter().chain(numbers));
            }
        }
        text
    }

    fn deviates(&self) -> bool {
        self.rows
            .iter()
            .flat_map(|(_, scenes)| scenes.iter().flatten())
            .any(|one| one.deviation.is_some())
    }

    /// The page: a line with a link for each dataset, the table, and a bar for each point.
    fn html(&self, folder: &Path) -> String {
        let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let link = |(column, scene): (usize, &String)| {
            let psnr = |(label, scenes): &(String, Vec<Vec<SceneScore>>)| {
                Some((label.clone(), scenes[column][0].mean?))
            };
            let best = self.rows.iter().filter_map(psnr).max_by(|a, b| a.1.total_cmp(&b.1));
            let best = best.map(|(label, psnr)| format!(": {label} is best, {psnr:.2} dB"));
            [format!("{scene}/index.html"), scene.clone() + &best.unwrap_or_default()]
        };
        let spread = if self.deviates() { " ± the standard deviation over seeds" } else { "" };
        let intro = vec![format!(
            "{} points on {} datasets, the best mean PSNR first; each value is the mean over the test views{spread}.",
            self.rows.len(),
            self.scenes.len()
        )];
        let bar = |(index, (label, scenes)): (usize, &(String, Vec<Vec<SceneScore>>))| Series {
            name: label.clone(),
            mark: Mark::Bar,
            color: Some(1),
            points: vec![(index as f64, Self::means(scenes)[0].mean.unwrap_or(f64::NAN))],
            ..Series::default()
        };
        let bars = self.rows.iter().enumerate().map(bar).collect();
        let report = Report {
            title: format!("Sweep {name}"),
            intro,
            links: self.scenes.iter().enumerate().map(link).collect(),
            charts: vec![Chart::new("", "mean PSNR, dB", bars)],
            ..Report::default()
        };
        report.page(&(self.html_table() + &report.charts_html()))
    }

    fn html_table(&self) -> String {
        let mut html = format!(
            "<div class=\"table\"><table>\n<thead><tr><th scope=\"col\">{}</th>",
            escape(&self.title())
        );
        // Writing to a string cannot fail, so the results below are ignored.
        for head in self.heads() {
            let _ = write!(html, "<th scope=\"col\">{}</th>", escape(&head));
        }
        html.push_str("</tr></thead>\n<tbody>\n");
        let markup = Markup { best: ["<b class=\"best\">", "</b>"], plus_minus: "±" };
        for (label, cells) in self.cells(&markup) {
            let cells: String = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
            let _ = writeln!(html, "<tr><td>{}</td>{cells}</tr>", escape(&label));
        }
        html + "</tbody>\n</table></div>\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn score(mean: f64) -> SceneScore {
        SceneScore { mean: Some(mean), deviation: None }
    }

    fn table() -> SceneTable {
        SceneTable {
            scenes: vec!["buu".to_owned(), "chair_1".to_owned()],
            scores: vec!["psnr".to_owned(), "ssim".to_owned()],
            rows: vec![
                (
                    "ase".to_owned(),
                    vec![vec![score(28.0), score(0.5)], vec![SceneScore::default(); 2]],
                ),
                (
                    "mine_1".to_owned(),
                    vec![vec![score(27.0), score(0.95)], vec![score(25.0), score(0.9)]],
                ),
                (
                    "ap3".to_owned(),
                    vec![
                        vec![SceneScore { mean: Some(27.154), deviation: Some(0.123) }, score(0.9)],
                        vec![score(26.0), score(1.0)],
                    ],
                ),
            ],
        }
        .sorted()
    }

    #[test]
    fn the_table_is_sorted_by_the_mean_and_marks_the_best_of_every_column() {
        let expected = "| PSNR / SSIM | buu | chair_1 | mean |\n|---|---:|---:|---:|\n\
                        | ap3 | 27.15 ± 0.12 / .900 | **26.00** / **1.000** | **26.58** / **.950** |\n\
                        | mine_1 | 27.00 / **.950** | 25.00 / .900 | 26.00 / .925 |\n\
                        | ase | **28.00** / .500 | - / - | - / - |\n";
        assert_eq!(table().markdown(), expected);
        let latex = table().latex();
        assert!(latex.starts_with("PSNR / SSIM & buu & chair\\_1 & mean \\\\\n"), "{latex}");
        assert!(latex.contains("ap3 & 27.15 $\\pm$ 0.12 / .900 & \\textbf{26.00} / "), "{latex}");
        assert!(latex.contains("mine\\_1 & "), "{latex}");
        let csv = table().csv();
        assert!(csv.starts_with("point,scene,psnr,psnr_sd,ssim,ssim_sd\n"), "{csv}");
        assert!(csv.contains("ap3,buu,27.154,0.123,0.9,\n"), "{csv}");
        assert!(csv.contains("ap3,mean,26.577,,0.95,\n"), "{csv}");
        assert!(csv.contains("ase,chair_1,,,,\n") && csv.contains("ase,mean,,,,\n"), "{csv}");
    }

    #[test]
    fn the_page_links_every_dataset_and_marks_the_best() {
        let html = table().html(Path::new("/somewhere/lom"));
        assert!(html.contains("<h1>Sweep lom</h1>") && !html.contains("somewhere"), "{html}");
        assert!(
            html.contains("<a href=\"chair_1/index.html\">chair_1: ap3 is best, 26.00 dB</a>"),
            "{html}"
        );
        assert!(html.contains("<b class=\"best\">26.58</b>") && html.contains("<rect"), "{html}");
    }
}
