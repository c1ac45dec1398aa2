//! A curve as a table of values, from a CSV or a .cube file.

use glam::Vec3;
use nightsplat_core::curves::{Real, mirrored};
use serde::{Deserialize, Serialize};

/// Values of a curve, interpolated by monotone cubics (Fritsch and Carlson 1980); beyond its ends the curve is
/// constant.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// Whether `x` is the stored value itself; else it is t = x / p90, as for the families.
    #[serde(default)]
    pub is_of_stored: bool,
    /// Ascending, at least two.
    pub x: Vec<f64>,
    /// The curve's values at `x`, in [0, 1] unless they clip: one row for all channels, or one per channel.
    pub y: Vec<Vec<f64>>,
}

impl Table {
    /// Reads lines of `t,y` or `t,red,green,blue`. A first line of names may have `x` instead of `t`: the table then
    /// acts on stored values. Blank lines and lines that begin with `#` are ignored.
    #[doc(hidden)]
    pub fn from_csv(text: &str) -> Result<Self, String> {
        let mut rows = TableRows::default();
        let mut is_of_stored = false;
        for (line, text) in content(text) {
            let cells: Vec<&str> = text.split([',', ';', '\t']).map(str::trim).collect();
            if rows.x.is_empty() && cells[0].parse::<f64>().is_err() {
                is_of_stored = match cells[0].to_ascii_lowercase().as_str() {
                    "t" => false,
                    "x" => true,
                    other => {
                        return Err(format!(
                            "line {line}: the first column is `{other}`; it must be t (x / p90) or x"
                        ));
                    }
                };
                continue;
            }
            rows.push(line, &cells, None)?;
        }
        rows.table(is_of_stored)
    }

    /// Reads a one-dimensional .cube file; it acts on stored values.
    #[doc(hidden)]
    pub fn from_cube(text: &str) -> Result<Self, String> {
        let mut rows = TableRows::default();
        let (mut size, mut low, mut high) = (0, 0.0, 1.0);
        for (line, text) in content(text) {
            let cells: Vec<&str> = text.split_whitespace().collect();
            let number = |index: usize| {
                let cell = cells.get(index).copied().unwrap_or_default();
                cell.parse::<f64>().map_err(|_| format!("line {line}: `{cell}` is not a number"))
            };
            match cells[0] {
                "TITLE" => {}
                "LUT_1D_SIZE" => size = number(1)? as usize,
                "LUT_3D_SIZE" => {
                    return Err(format!(
                        "line {line}: a 3D table is not a tone curve; save a 1D one"
                    ));
                }
                "DOMAIN_MIN" | "DOMAIN_MAX" => {
                    let bound = number(1)?;
                    if number(2)? != bound || number(3)? != bound {
                        return Err(format!("line {line}: the channels must share one domain"));
                    }
                    *(if cells[0] == "DOMAIN_MIN" { &mut low } else { &mut high }) = bound;
                }
                "LUT_1D_INPUT_RANGE" => (low, high) = (number(1)?, number(2)?),
                _ => {
                    let step = (high - low) / (size.max(2) - 1) as f64;
                    rows.push(line, &cells, Some(low + step * rows.x.len() as f64))?;
                }
            }
        }
        if rows.x.len() != size {
            return Err(format!("LUT_1D_SIZE is {size} but there are {} values", rows.x.len()));
        }
        rows.table(true)
    }

    pub(super) fn check(&self) -> Result<(), String> {
        if self.x.len() < 2 {
            return Err(format!(
                "a table of {} values is not a curve; give at least two",
                self.x.len()
            ));
        }
        if !matches!(self.y.len(), 1 | 3) || self.y.iter().any(|y| y.len() != self.x.len()) {
            return Err("a table needs one value, or red, green and blue, for every x".to_owned());
        }
        let mut values = self.x.iter().chain(self.y.iter().flatten());
        if let Some(value) = values.find(|value| value.is_nan() || value.abs() > 1e30) {
            return Err(format!("a table contains {value}; every value must be finite"));
        }
        // Also in f32, as on the device.
        match self.x.windows(2).find(|pair| pair[0] as f32 >= pair[1] as f32) {
            Some(pair) => Err(format!(
                "the first column of a table must ascend, but {} follows {}; sort it",
                pair[1], pair[0]
            )),
            None => Ok(()),
        }
    }

    /// (3, K) knots (x, y, slope) for the kernel.
    #[doc(hidden)]
    pub fn knots(&self) -> Vec<Vec3> {
        let channels = (0..3).map(|channel| self.channel(channel));
        channels
            .flatten()
            .map(|[x, y, slope]| Vec3::new(x as f32, y as f32, slope as f32))
            .collect()
    }

    /// The table at `x`, in [0, 1], for a channel from 0 to 2; mirrored below 0 if it does not begin there.
    #[doc(hidden)]
    pub fn value(&self, x: f64, channel: usize) -> f64 {
        table_at(&self.channel(channel), x)
    }

    fn channel(&self, channel: usize) -> Vec<[f64; 3]> {
        let y = &self.y[channel.min(self.y.len() - 1)];
        let slopes = slopes(&self.x, y);
        (0..y.len()).map(|i| [self.x[i], y[i], slopes[i]]).collect()
    }
}

/// The table with these knots of a channel at x, in [0, 1]; below 0 it is mirrored, unless it has knots there.
pub fn table_at<T: Real>(knots: &[[T; 3]], x: T) -> T {
    let value = |x| interpolate(knots, x).at_least(T::from_f64(0.0)).at_most(T::from_f64(1.0));
    if knots[0][0] < T::from_f64(0.0) { value(x) } else { mirrored(x, value) }
}

/// The cubic Hermite curve through knots (x, y, slope); beyond the ends it is constant.
fn interpolate<T: Real>(knots: &[[T; 3]], x: T) -> T {
    let [first, last] = [knots[0], knots[knots.len() - 1]];
    // Written so that a NaN counts as the lower end.
    let x = if x > first[0] { x.at_most(last[0]) } else { first[0] };
    let upper = knots.partition_point(|knot| knot[0] <= x).min(knots.len() - 1);
    let ([x0, y0, d0], [x1, y1, d1]) = (knots[upper - 1], knots[upper]);
    let width = x1 - x0;
    let s = (x - x0) / width;
    let rise = y1 - y0;
    let (a, b) = (width * d0 - rise, rise - width * d1);
    let left = T::from_f64(1.0) - s;
    y0 + rise * s + s * left * (a * left + b * s)
}

/// The lines with content, with their numbers from 1.
fn content(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = text.trim_start_matches('\u{feff}').lines().map(str::trim);
    (1..).zip(lines).filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

#[derive(Default)]
struct TableRows {
    x: Vec<f64>,
    y: Vec<Vec<f64>>,
}

impl TableRows {
    /// Reads a line of numbers; the first is the input unless `x` is given.
    fn push(&mut self, line: usize, cells: &[&str], x: Option<f64>) -> Result<(), String> {
        let number = |cell: &&str| {
            let value = cell.parse::<f64>().ok().filter(|value| value.is_finite());
            value.ok_or_else(|| format!("line {line}: `{cell}` is not a number"))
        };
        let mut numbers = cells.iter().map(number).collect::<Result<Vec<f64>, _>>()?;
        let x = x.unwrap_or_else(|| numbers.remove(0));
        if !matches!(numbers.len(), 1 | 3) || (!self.y.is_empty() && self.y.len() != numbers.len())
        {
            return Err(format!(
                "line {line}: {} values; every line needs one, or red, green and blue",
                numbers.len()
            ));
        }
        if let Some(last) = self.x.last().filter(|&&last| x <= last) {
            return Err(format!(
                "line {line}: the first column must ascend, but {x} follows {last}; sort it"
            ));
        }
        self.x.push(x);
        self.y.resize(numbers.len(), vec![]);
        for (channel, value) in self.y.iter_mut().zip(numbers) {
            channel.push(value);
        }
        Ok(())
    }

    fn table(self, is_of_stored: bool) -> Result<Table, String> {
        let table = Table { is_of_stored, x: self.x, y: self.y };
        table.check()?;
        Ok(table)
    }
}

/// The slopes at the knots: 0 at extrema, elsewhere the weighted harmonic mean of the neighbouring secants.
fn slopes(x: &[f64], y: &[f64]) -> Vec<f64> {
    let width: Vec<f64> = x.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let secant: Vec<f64> = y.windows(2).zip(&width).map(|(y, h)| (y[1] - y[0]) / h).collect();
    let last = secant.len();
    let inner = |i: usize| {
        let (before, after) = (secant[i - 1], secant[i]);
        if before * after <= 0.0 {
            return 0.0;
        }
        let (w1, w2) = (2.0 * width[i] + width[i - 1], width[i] + 2.0 * width[i - 1]);
        (w1 + w2) / (w1 / before + w2 / after)
    };
    let slope = |i: usize| match i {
        0 => secant[0],
        i if i == last => secant[last - 1],
        i => inner(i),
    };
    (0..x.len()).map(slope).collect()
}
