//! Costs of the points: time, energy and memory against scores, with Pareto fronts.

use std::path::Path;

use nightsplat_core::output::write_whole;
use nightsplat_report::{Chart, Mark, NumberTable, Report, Series};
use serde_json::{Map, Value, json};

use super::rows::{SweepResults, SweepRow};
use super::run::FailedPoint;
use super::table::{ColumnStatistic, KEYS, Quantity};
use crate::Result;
use crate::results::run::{RunProgress, energy_counters};

/// The files of the costs.
pub const FILES: [&str; 2] = ["costs.csv", "costs.html"];

/// Range of intermediate scores that is plotted, dB.
const SHOWN_DECIBELS: f64 = 3.0;

/// More rows than this are numbered in plots, where their names would not fit.
const MAX_NAMES: usize = 8;

/// The charts: the keys of cost and score.
const FRONTS: [[&str; 2]; 8] = [
    ["seconds", "psnr"],
    ["seconds", "ssim"],
    ["processor_seconds", "psnr"],
    ["processor_seconds", "ssim"],
    ["joules", "psnr"],
    ["joules", "ssim"],
    ["device_bytes", "psnr"],
    ["host_bytes", "psnr"],
];

/// The fronts of PSNR in CSV and JSON, with the keys of their costs.
const NAMED_FRONTS: [[&str; 2]; 2] =
    [["on_front", "seconds"], ["on_processor_front", "processor_seconds"]];

/// Indices of the Pareto-optimal points (cost, gain), cheapest first. Of equal points, the first is taken.
fn front(points: &[(f64, f64)]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len())
        .filter(|&index| points[index].0.is_finite() && points[index].1.is_finite())
        .collect();
    // Stable, so that of equal points the first stays first.
    order.sort_by(|&a, &b| {
        points[a].0.total_cmp(&points[b].0).then(points[b].1.total_cmp(&points[a].1))
    });
    let mut best = f64::NEG_INFINITY;
    order.retain(|&index| {
        let gains = points[index].1 > best;
        best = best.max(points[index].1);
        gains
    });
    order
}

impl SweepResults {
    /// Writes [`FILES`] to `folder`; `notes` are paragraphs of the page.
    pub fn save_costs(&self, folder: &Path, title: &str, notes: &[String]) -> Result<()> {
        let counters = energy_counters();
        let energy = if counters.is_empty() {
            "No energy counter is readable on this machine.".to_owned()
        } else {
            format!("Energy is that of {}, including idle power.", counters.join(", "))
        };
        let time = "Time is that of the steps, without loading and scoring. The dotted line is the Pareto \
         front: the best score for each cost. Discs are points on it, rings are not.";
        let mut intro = vec![format!("{time} {energy}")];
        let on_front = self.front_of(["seconds", "psnr"]);
        let names = on_front.into_iter().map(|index| self.label(&self.rows[index], None));
        let names = names.collect::<Vec<_>>().join("; ");
        if !names.is_empty() {
            intro.push(format!("On the front of PSNR against time: {names}."));
        }
        intro.extend_from_slice(notes);
        let report = Report {
            title: format!("{title}: time and quality"),
            intro,
            tables: std::iter::once(self.costs()).chain(self.differences()).collect(),
            charts: self.cost_charts(),
            ..Report::default()
        };
        let [csv, html] = FILES.map(|file| folder.join(file));
        write_whole(&csv, self.costs_csv().as_bytes())?;
        write_whole(&html, report.html_charts_first().as_bytes())
    }

    /// The Pareto front of the keys of a cost and a score.
    fn front_of(&self, keys: [&str; 2]) -> Vec<usize> {
        let [cost, gain] = keys.map(Quantity::new);
        let value = |row: &SweepRow, of: &Quantity| of.mean(row).unwrap_or(f64::NAN);
        let points = self.rows.iter().map(|row| (value(row, &cost), value(row, &gain)));
        front(&points.collect::<Vec<_>>())
    }

    /// The quantities that any row has.
    fn quantities(&self, statistic: ColumnStatistic) -> Vec<(Quantity, ColumnStatistic)> {
        let has = |of: &Quantity| self.rows.iter().any(|row| of.mean(row).is_some());
        KEYS.map(Quantity::new).into_iter().filter(has).map(|of| (of, statistic)).collect()
    }

    /// All rows with all quantities.
    pub fn costs(&self) -> NumberTable {
        let mut table = self.table("All points", &self.quantities(ColumnStatistic::Mean));
        for (number, (label, _)) in (1..).zip(&mut table.rows) {
            *label = format!("{number}  {label}");
        }
        table
    }

    /// Differences to the baseline; `None` without a finished baseline.
    fn differences(&self) -> Option<NumberTable> {
        let (base, name) = self.baseline().filter(|(row, _)| !row.metrics.is_empty())?;
        let quantities = self.quantities(ColumnStatistic::Gain);
        let mut table = self.table(&format!("The difference to {name}"), &quantities);
        for (column, (quantity, _)) in table.columns.iter_mut().zip(&quantities) {
            column.name.clone_from(&quantity.name);
        }
        let mut rows = self.rows.iter();
        table.rows.retain(|_| rows.next().is_some_and(|row| row.point != base.point));
        (!table.rows.is_empty()).then_some(table)
    }

    fn cost_charts(&self) -> Vec<Chart> {
        let fronts = FRONTS.into_iter().filter_map(|keys| self.front_chart(keys));
        fronts.chain(self.on_the_way()).collect()
    }

    /// Final score against cost; `None` unless two rows have both.
    fn front_chart(&self, keys: [&str; 2]) -> Option<Chart> {
        let [cost, gain] = keys.map(Quantity::new);
        let point = |row: &SweepRow| Some((cost.mean(row)?, gain.mean(row)?));
        let front = self.front_of(keys);
        let series = |(index, row): (usize, &SweepRow)| Series {
            points: point(row).into_iter().collect(),
            mark: if front.contains(&index) { Mark::Disc } else { Mark::Ring },
            ..self.series(index)
        };
        let mut drawn: Vec<Series> = self.rows.iter().enumerate().map(series).collect();
        // A chart of a single point shows nothing.
        let count = drawn.iter().filter(|series| !series.points.is_empty()).count();
        let points = front.iter().filter_map(|&index| point(&self.rows[index])).collect();
        let name = "Pareto front".to_owned();
        drawn.insert(0, Series { name, mark: Mark::Steps, points, ..Series::default() });
        let chart = Chart::new(&cost.name, &gain.name, drawn);
        (count > 1).then_some(Chart { is_logarithmic: true, ..chart })
    }

    /// Score against time during training; `None` without intermediate scores.
    fn on_the_way(&self) -> Option<Chart> {
        let all = || self.rows.iter().flat_map(|row| &row.progress);
        let least = all().map(|one| one.psnr).fold(f64::NEG_INFINITY, f64::max) - SHOWN_DECIBELS;
        let series = |(index, row): (usize, &SweepRow)| {
            let shown = row.progress.iter().filter(|one| one.psnr >= least);
            let points = shown.map(|one: &RunProgress| (one.seconds, one.psnr)).collect();
            Series { points, mark: Mark::Disc, ..self.series(index) }
        };
        let drawn: Vec<Series> = self.rows.iter().enumerate().take(MAX_NAMES).map(series).collect();
        let has_lines = drawn.iter().any(|series| series.points.len() > 1);
        let chart = Chart::new("time, s", "PSNR, dB during training", drawn);
        has_lines.then_some(Chart { is_logarithmic: true, ..chart })
    }

    /// Name and colour of a row in every chart.
    fn series(&self, index: usize) -> Series {
        let (number, label) = (index + 1, self.label(&self.rows[index], None));
        let title = format!("{number}  {label}");
        let name = if self.rows.len() > MAX_NAMES { number.to_string() } else { label };
        Series { name, title, color: Some(index), ..Series::default() }
    }

    /// A line per row: settings, mean and standard deviation of every quantity, and whether it is on the fronts of PSNR
    /// against wall time and processor time.
    fn costs_csv(&self) -> String {
        let mut columns = vec![self.csv_column("runs", |_, row| row.metrics.len().to_string())];
        columns.extend(KEYS.iter().flat_map(|key| self.csv_numbers(key, true)));
        for [name, cost] in NAMED_FRONTS {
            let front = self.front_of([cost, "psnr"]);
            columns.push(self.csv_column(name, |index, _| front.contains(&index).to_string()));
        }
        self.csv(columns)
    }

    /// All quantities as JSON, with the differences to the baseline.
    pub fn json(&self, dataset: &Path, failures: &[FailedPoint]) -> Value {
        let keys = KEYS.into_iter().chain(self.scores.iter().map(String::as_str));
        let quantities: Vec<Quantity> = keys.map(Quantity::new).collect();
        let of = |value: &dyn Fn(&str) -> Option<f64>| {
            let entry = |of: &Quantity| (of.key.clone(), json!(value(&of.pointer)));
            quantities.iter().map(entry).collect::<Map<_, _>>()
        };
        let fronts = NAMED_FRONTS.map(|[name, cost]| (name, self.front_of([cost, "psnr"])));
        let baseline = self.baseline();
        let point = |(index, row): (usize, &SweepRow)| {
            let mut entry = json!({
                "point": row.point.name(),
                "settings": row.point.values.iter().cloned().collect::<std::collections::BTreeMap<_, _>>(),
                "runs": row.metrics.len(),
                "scored": row.against().unwrap_or("against reference images"),
                "mean": of(&|pointer| row.mean(pointer)),
            });
            if let Some((base, _)) = baseline.as_ref().filter(|(base, _)| base.point != row.point) {
                entry["difference"] =
                    of(&|pointer| Some(row.mean(pointer)? - base.mean(pointer)?)).into();
            }
            for (name, front) in &fronts {
                entry[*name] = front.contains(&index).into();
            }
            entry
        };
        let failed =
            |FailedPoint { name, reason }: &FailedPoint| json!({"point": name, "reason": reason});
        json!({
            "dataset": dataset.display().to_string(),
            "energy_counters": energy_counters(),
            "points": self.rows.iter().enumerate().map(point).collect::<Vec<_>>(),
            "failed": failures.iter().map(failed).collect::<Vec<_>>(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::sweep::SweepPoint;

    const MIB: f64 = 1_048_576.0;

    #[test]
    fn the_front_has_what_nothing_beats_the_cheapest_first() {
        let points =
            [(10.0, 24.0), (5.0, 22.0), (20.0, 23.9), (5.0, 21.0), (40.0, 26.0), (f64::NAN, 99.0)];
        assert_eq!(front(&points), [1, 0, 4]);
        assert_eq!(front(&[(1.0, 2.0), (1.0, 2.0)]), [0]);
        assert_eq!(front(&[(2.0, 2.0), (1.0, 2.0)]), [1]);
        assert!(front(&[]).is_empty());
    }

    fn row(values: &[(&str, &str)], figures: &[(f64, f64, f64)]) -> SweepRow {
        let metrics = |&(psnr, seconds, bytes): &(f64, f64, f64)| {
            json!({"mean": {"psnr": psnr, "ssim": 0.5}, "seconds": seconds, "steps": 10, "gaussians": 7,
                "spent": {"processor_seconds": 2.0 * seconds, "joules": null, "device_bytes": bytes}})
        };
        let values = values.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        SweepRow {
            point: SweepPoint { values: values.collect() },
            metrics: figures.iter().map(metrics).collect(),
            progress: vec![],
        }
    }

    fn rows() -> SweepResults {
        let balanced = ("preset", "balanced");
        let rows = vec![
            row(&[balanced], &[(25.0, 20.0, 3.0 * MIB), (26.0, 40.0, 3.0 * MIB)]),
            row(&[("preset", "fast")], &[(24.0, 10.0, MIB)]),
            row(&[balanced, ("steps", "5")], &[(23.5, 15.0, 2.0 * MIB)]),
            row(&[balanced, ("steps", "9")], &[]),
        ];
        SweepResults::from_rows(rows, vec!["psnr".to_owned()], vec![], Some(balanced))
    }

    #[test]
    fn a_point_costs_and_gains_its_difference_to_the_baseline() {
        let table = rows().differences().unwrap();
        let names: Vec<&str> = table.columns.iter().map(|column| column.name.as_str()).collect();
        let expected = [
            "PSNR, dB",
            "SSIM",
            "time, s",
            "processor time, s",
            "steps",
            "Gaussians",
            "device, MiB",
        ];
        assert_eq!(names, expected, "a quantity that no row has is no column");
        let values = [-2.0, 0.0, -15.0, -30.0, 0.0, 0.0, -1.0].map(Some).to_vec();
        assert_eq!(table.rows[1], ("balanced, steps 5".to_owned(), values));
        assert_eq!(table.rows[2], ("balanced, steps 9".to_owned(), vec![None; 7]));
        let mut lost = rows();
        lost.rows[0].metrics.clear();
        assert!(lost.differences().is_none(), "the baseline is not finished");
    }

    #[test]
    fn the_files_have_a_line_per_point_with_means_spreads_and_fronts() {
        let rows = rows();
        let csv = rows.costs_csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(
            lines[0],
            "preset,steps,runs,psnr,psnr_sd,ssim,ssim_sd,seconds,seconds_sd,processor_seconds,processor_seconds_sd,\
             joules,joules_sd,steps,steps_sd,gaussians,gaussians_sd,device_bytes,\
             device_bytes_sd,host_bytes,host_bytes_sd,\
             on_front,on_processor_front"
        );
        assert!(
            lines[1].starts_with("balanced,,2,25.5,0.7071") && lines[1].ends_with("true,true"),
            "{csv}"
        );
        assert!(lines[2].starts_with("fast,,1,24,,0.5,,10,,20,,"), "{csv}");
        assert!(
            lines[3].starts_with("balanced,5,1,23.5") && lines[3].ends_with("false,false"),
            "{csv}"
        );
        let json = rows.json(Path::new("photos"), &[]);
        let point = |index: usize, key: &str| &json["points"][index][key];
        assert_eq!(point(2, "difference")["psnr"], -2.0);
        assert_eq!((point(0, "on_front"), point(0, "difference")), (&json!(true), &Value::Null));
        assert_eq!(rows.costs().rows[2].0, "3  balanced, steps 5");
    }
}
