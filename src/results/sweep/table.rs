//! The table of a sweep: a row per point, columns of the numbers of its runs. The leaderboard and the costs are tables
//! of different columns.

use nightsplat_core::csv;
use nightsplat_report::{Best, Column, NumberTable};

use super::rows::{SweepResults, SweepRow, number};
use crate::networks::lpips::LpipsVersion;

/// A number in `metrics.json` of a run.
#[derive(Clone, Debug)]
pub struct Quantity {
    /// Its key in CSV and JSON.
    pub key: String,
    /// Its JSON pointer in `metrics.json`.
    pub pointer: String,
    /// Its heading, with the unit.
    pub name: String,
    digits: usize,
    /// The displayed unit.
    unit: f64,
    best: Best,
}

/// The keys of the scores and costs of every run.
pub(super) const KEYS: [&str; 9] = [
    "psnr",
    "ssim",
    "seconds",
    "processor_seconds",
    "joules",
    "steps",
    "gaussians",
    "device_bytes",
    "host_bytes",
];

impl Quantity {
    /// By its key: one of [`KEYS`], or the name of a score in `metrics.json`, such as `r0/psnr` for R_0.
    pub fn new(key: &str) -> Self {
        const MIB: f64 = 1_048_576.0;
        let cost = |pointer: &str, name: &str, digits, unit| {
            let [key, pointer, name] = [key, pointer, name].map(str::to_owned);
            Self { key, pointer, name, digits, unit, best: Best::Unmarked }
        };
        let score = |name: &str, digits, best| Self {
            best,
            ..cost(&format!("/mean/{key}"), name, digits, 1.0)
        };
        if let Some(measure) = LpipsVersion::all().find(|measure| measure.key() == key) {
            return score(&measure.title(), 3, Best::Least);
        }
        if let Some(of_final) = key.strip_prefix("r0/").map(Self::new) {
            return score(&format!("{} of R_0", of_final.name), of_final.digits, of_final.best);
        }
        match key {
            "psnr" => score("PSNR, dB", 2, Best::Greatest),
            "psnr_channel_mean" => score("channel-mean PSNR, dB", 2, Best::Greatest),
            "ssim" => score("SSIM", 3, Best::Greatest),
            "seconds" => cost("/seconds", "time, s", 1, 1.0),
            "processor_seconds" => cost("/spent/processor_seconds", "processor time, s", 1, 1.0),
            "joules" => cost("/spent/joules", "energy, J", 0, 1.0),
            "steps" => cost("/steps", "steps", 0, 1.0),
            "gaussians" => cost("/gaussians", "Gaussians", 0, 1.0),
            "device_bytes" => cost("/spent/device_bytes", "device, MiB", 1, MIB),
            "host_bytes" => cost("/spent/host_bytes", "host, MiB", 0, MIB),
            other => score(other, 4, Best::Unmarked),
        }
    }

    /// Which of its values is best.
    pub(super) fn best(&self) -> Best {
        self.best
    }

    /// The mean over the runs of a row, in the displayed unit.
    pub fn mean(&self, row: &SweepRow) -> Option<f64> {
        Some(row.mean(&self.pointer)? / self.unit)
    }
}

/// What a column has of the runs of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColumnStatistic {
    Mean,
    /// The sample standard deviation.
    Deviation,
    /// The difference of the mean to that of the baseline.
    Gain,
}

/// A column of CSV: its name, and a cell per row.
#[derive(Debug)]
pub struct CsvColumn {
    name: String,
    cells: Vec<String>,
}

impl SweepResults {
    /// A table of these columns.
    pub fn table(&self, title: &str, columns: &[(Quantity, ColumnStatistic)]) -> NumberTable {
        let baseline = self.baseline();
        let column = |(quantity, statistic): &(Quantity, ColumnStatistic)| {
            let Quantity { name, digits, best, .. } = quantity;
            let (name, best) = match statistic {
                ColumnStatistic::Mean => (name.as_str(), *best),
                ColumnStatistic::Deviation => ("sd", Best::Unmarked),
                ColumnStatistic::Gain => ("gain", Best::Unmarked),
            };
            Column { name: name.to_owned(), digits: *digits, best }
        };
        let value = |row: &SweepRow, quantity: &Quantity, statistic| match statistic {
            ColumnStatistic::Mean => quantity.mean(row),
            ColumnStatistic::Deviation => Some(row.deviation(&quantity.pointer)? / quantity.unit),
            ColumnStatistic::Gain => {
                let (base, _) = baseline.as_ref()?;
                Some(quantity.mean(row)? - quantity.mean(base)?)
            }
        };
        let row = |row: &SweepRow| {
            let values =
                columns.iter().map(|(quantity, statistic)| value(row, quantity, *statistic));
            (self.label(row, None), values.collect())
        };
        NumberTable {
            title: title.to_owned(),
            label: "point".to_owned(),
            columns: columns.iter().map(column).collect(),
            rows: self.rows.iter().map(row).collect(),
            ..NumberTable::default()
        }
    }

    /// A line per row: its settings, then these columns.
    pub fn csv(&self, columns: Vec<CsvColumn>) -> String {
        let setting = |key: &String| {
            self.csv_column(key, |_, row| row.point.value(key).unwrap_or_default().to_string())
        };
        let columns: Vec<CsvColumn> = self.keys.iter().map(setting).chain(columns).collect();
        let header = csv::line(columns.iter().map(|column| column.name.as_str()));
        let line = |row: usize| csv::line(columns.iter().map(|one| one.cells[row].as_str()));
        std::iter::once(header).chain((0..self.rows.len()).map(line)).collect()
    }

    /// A column of CSV; `cell` takes the index of a row and the row.
    pub fn csv_column(&self, name: &str, cell: impl Fn(usize, &SweepRow) -> String) -> CsvColumn {
        let cells = self.rows.iter().enumerate().map(|(index, row)| cell(index, row));
        CsvColumn { name: name.to_owned(), cells: cells.collect() }
    }

    /// The columns of CSV of a quantity, with all digits and in the unit of `metrics.json`: the mean and, if requested,
    /// the standard deviation.
    pub fn csv_numbers(&self, key: &str, with_deviation: bool) -> Vec<CsvColumn> {
        let pointer = Quantity::new(key).pointer;
        let mut columns = vec![self.csv_column(key, |_, row| number(row.mean(&pointer)))];
        if with_deviation {
            let cell = |_, row: &SweepRow| number(row.deviation(&pointer));
            columns.push(self.csv_column(&format!("{key}_sd"), cell));
        }
        columns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_every_lpips_the_least_is_best() {
        for measure in LpipsVersion::all() {
            let Quantity { name, best, .. } = Quantity::new(&measure.key());
            assert!(matches!(best, Best::Least) && name == measure.title(), "{name}");
        }
    }
}
