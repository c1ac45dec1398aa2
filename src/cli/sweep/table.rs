//! The table of a sweep: a row per point, columns of the numbers of its runs. The leaderboard and the costs are tables
//! of different columns.

use std::borrow::Cow;

use super::rows::{Row, Rows, number};
use crate::base::output::csv_field;
use crate::networks::lpips::Measure;
use crate::results::report::{Best, Column, Table};

/// A number in `metrics.json` of a run.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Quantity {
    /// Its key in CSV and JSON.
    pub(super) key: Cow<'static, str>,
    /// Its JSON pointer in `metrics.json`.
    pub(super) pointer: Cow<'static, str>,
    /// Its heading, with the unit.
    pub(super) name: Cow<'static, str>,
    digits: usize,
    /// The displayed unit.
    unit: f64,
    best: Best,
}

const MIB: f64 = 1_048_576.0;

pub(super) const PSNR: Quantity = score(["psnr", "/mean/psnr", "PSNR, dB"], 2);
pub(super) const SSIM: Quantity = score(["ssim", "/mean/ssim", "SSIM"], 3);
pub(super) const SECONDS: Quantity = cost(["seconds", "/seconds", "time, s"], 1, 1.0);
pub(super) const PROCESSOR: Quantity =
    cost(["processor_seconds", "/spent/processor_seconds", "processor time, s"], 1, 1.0);
pub(super) const JOULES: Quantity = cost(["joules", "/spent/joules", "energy, J"], 0, 1.0);
pub(super) const GAUSSIANS: Quantity = cost(["gaussians", "/gaussians", "Gaussians"], 0, 1.0);
pub(super) const DEVICE: Quantity =
    cost(["device_bytes", "/spent/device_bytes", "device, MiB"], 1, MIB);
pub(super) const HOST: Quantity = cost(["host_bytes", "/spent/host_bytes", "host, MiB"], 0, MIB);

/// Key, pointer and heading of a score, of which the greatest is best.
const fn score(names: [&'static str; 3], digits: usize) -> Quantity {
    quantity(names, digits, 1.0, Best::Greatest)
}

/// Key, pointer and heading of a cost.
const fn cost(names: [&'static str; 3], digits: usize, unit: f64) -> Quantity {
    quantity(names, digits, unit, Best::Unmarked)
}

const fn quantity(
    [key, pointer, name]: [&'static str; 3],
    digits: usize,
    unit: f64,
    best: Best,
) -> Quantity {
    Quantity {
        key: Cow::Borrowed(key),
        pointer: Cow::Borrowed(pointer),
        name: Cow::Borrowed(name),
        digits,
        unit,
        best,
    }
}

impl Quantity {
    /// The scores and costs of every run.
    pub(super) fn all() -> [Self; 9] {
        let steps = cost(["steps", "/steps", "steps"], 0, 1.0);
        [PSNR, SSIM, SECONDS, PROCESSOR, JOULES, steps, GAUSSIANS, DEVICE, HOST]
    }

    /// A score by its name in `metrics.json`: `psnr`, or `r0/psnr` for R_0.
    pub(super) fn score(name: &str) -> Self {
        let (key, pointer) = (Cow::Owned(name.to_owned()), Cow::Owned(format!("/mean/{name}")));
        if let Some(measure) = Measure::all().find(|measure| measure.key() == name) {
            let name = Cow::Owned(measure.title());
            return Self { key, pointer, name, digits: 3, unit: 1.0, best: Best::Least };
        }
        if let Some(of_final) = name.strip_prefix("r0/") {
            let of_final = Self::score(of_final);
            let name = Cow::Owned(format!("{} of R_0", of_final.name));
            return Self { key, pointer, name, ..of_final };
        }
        match name {
            "psnr" => PSNR,
            "ssim" => SSIM,
            "psnr_channel_mean" => {
                score(["psnr_channel_mean", "/mean/psnr_channel_mean", "channel-mean PSNR, dB"], 2)
            }
            other => {
                let name = Cow::Owned(other.to_owned());
                Self { key, pointer, name, digits: 4, unit: 1.0, best: Best::Unmarked }
            }
        }
    }

    /// The mean over the runs of a row, in the displayed unit.
    pub(super) fn mean(&self, row: &Row) -> Option<f64> {
        Some(row.mean(&self.pointer)? / self.unit)
    }
}

/// What a column has of the runs of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Statistic {
    Mean,
    /// The sample standard deviation.
    Deviation,
    /// The difference of the mean to that of the baseline.
    Gain,
}

/// A column of CSV: its name, and a cell per row.
pub(super) struct CsvColumn {
    name: String,
    cells: Vec<String>,
}

impl Rows {
    /// A table of these columns.
    pub(super) fn table(&self, title: &str, columns: &[(Quantity, Statistic)]) -> Table {
        let baseline = self.baseline();
        let column = |(quantity, statistic): &(Quantity, Statistic)| {
            let Quantity { name, digits, best, .. } = quantity;
            let (name, best) = match statistic {
                Statistic::Mean => (name.as_ref(), *best),
                Statistic::Deviation => ("sd", Best::Unmarked),
                Statistic::Gain => ("gain", Best::Unmarked),
            };
            Column { name: name.to_owned(), digits: *digits, best }
        };
        let value = |row: &Row, quantity: &Quantity, statistic| match statistic {
            Statistic::Mean => quantity.mean(row),
            Statistic::Deviation => Some(row.deviation(&quantity.pointer)? / quantity.unit),
            Statistic::Gain => {
                let (base, _) = baseline.as_ref()?;
                Some(quantity.mean(row)? - quantity.mean(base)?)
            }
        };
        let row = |row: &Row| {
            let values =
                columns.iter().map(|(quantity, statistic)| value(row, quantity, *statistic));
            (self.label(row, None), values.collect())
        };
        Table {
            title: title.to_owned(),
            label: "point".to_owned(),
            columns: columns.iter().map(column).collect(),
            rows: self.rows.iter().map(row).collect(),
        }
    }

    /// A line per row: its settings, then these columns.
    pub(super) fn csv(&self, columns: Vec<CsvColumn>) -> String {
        let setting = |key: &String| {
            self.csv_column(key, |_, row| {
                csv_field(row.point.value(key).unwrap_or_default()).to_string()
            })
        };
        let columns: Vec<CsvColumn> = self.keys.iter().map(setting).chain(columns).collect();
        let joined = |cells: Vec<&str>| cells.join(",") + "\n";
        let header = joined(columns.iter().map(|column| column.name.as_str()).collect());
        let line = |row: usize| joined(columns.iter().map(|one| one.cells[row].as_str()).collect());
        std::iter::once(header).chain((0..self.rows.len()).map(line)).collect()
    }

    /// A column of CSV; `cell` takes the index of a row and the row.
    pub(super) fn csv_column(&self, name: &str, cell: impl Fn(usize, &Row) -> String) -> CsvColumn {
        let cells = self.rows.iter().enumerate().map(|(index, row)| cell(index, row));
        CsvColumn { name: name.to_owned(), cells: cells.collect() }
    }

    /// The columns of CSV of a quantity, with all digits and in the unit of `metrics.json`: the mean and, if requested,
    /// the standard deviation.
    pub(super) fn csv_numbers(&self, quantity: &Quantity, with_deviation: bool) -> Vec<CsvColumn> {
        let Quantity { key, pointer, .. } = quantity;
        let mut columns = vec![self.csv_column(key, |_, row| number(row.mean(pointer)))];
        if with_deviation {
            let cell = |_, row: &Row| number(row.deviation(pointer));
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
        for measure in Measure::all() {
            let Quantity { name, best, .. } = Quantity::score(&measure.key());
            assert!(matches!(best, Best::Least) && name == measure.title(), "{name}");
        }
    }
}
