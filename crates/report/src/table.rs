//! A table of numbers, as HTML, as Markdown and as text.

use std::fmt::Write as _;

use nightsplat_core::table::aligned;

use super::escape;

/// The value of a column that is highlighted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Best {
    /// None.
    #[default]
    Unmarked,
    /// The lowest.
    Least,
    /// The highest.
    Greatest,
}

/// A column of numbers.
#[derive(Clone, Debug, Default)]
pub struct Column {
    /// The heading.
    pub name: String,
    /// Digits after the decimal point.
    pub digits: usize,
    /// The highlighted value.
    pub best: Best,
}

/// A table: a label and a number per column in each row.
#[derive(Clone, Debug, Default)]
pub struct NumberTable {
    /// The caption; may be empty.
    pub title: String,
    /// The heading of the labels.
    pub label: String,
    /// The columns after the labels.
    pub columns: Vec<Column>,
    /// The label and values of each row; a missing value or NaN is shown as a dash.
    pub rows: Vec<(String, Vec<Option<f64>>)>,
    /// The row and the column of each value that is marked as bad.
    pub bad: Vec<[usize; 2]>,
}

impl NumberTable {
    /// The table without columns that have no value.
    #[must_use]
    pub fn without_empty_columns(mut self) -> Self {
        let has_value =
            |column: usize| (0..self.rows.len()).any(|row| self.value(row, column).is_some());
        let kept: Vec<usize> =
            (0..self.columns.len()).filter(|&column| has_value(column)).collect();
        self.columns = kept.iter().map(|&column| self.columns[column].clone()).collect();
        for (_, values) in &mut self.rows {
            *values = kept.iter().map(|&column| values.get(column).copied().flatten()).collect();
        }
        let moved = |&[row, column]: &[usize; 2]| Some([row, kept.binary_search(&column).ok()?]);
        self.bad = self.bad.iter().filter_map(moved).collect();
        self
    }

    /// The table as text with aligned columns.
    pub fn text(&self) -> String {
        let Self { label, columns, rows, .. } = self;
        let mut lines = vec![vec![label.clone()]];
        lines[0].extend(columns.iter().map(|column| column.name.clone()));
        for (name, values) in rows {
            let cell = |(column, value): (&Column, &Option<f64>)| {
                value.map_or_else(|| "-".to_owned(), |value| format!("{value:.*}", column.digits))
            };
            let cells = columns.iter().zip(values).map(cell);
            lines.push(std::iter::once(name.clone()).chain(cells).collect());
        }
        aligned(&lines)
    }

    /// The table as a section of an HTML page, with the best values highlighted.
    pub fn html(&self) -> String {
        let mut html = format!(
            "<div class=\"table\"><table>\n<caption>{}</caption>\n<thead><tr><th scope=\"col\">{}</th>",
            escape(&self.title),
            escape(&self.label)
        );
        // Writing to a string cannot fail, so the results below are ignored.
        for column in &self.columns {
            let _ = write!(html, "<th scope=\"col\">{}</th>", escape(&column.name));
        }
        html.push_str("</tr></thead>\n<tbody>\n");
        for (row, (label, _)) in self.rows.iter().enumerate() {
            let _ = write!(html, "<tr><td>{}</td>", escape(label));
            for column in 0..self.columns.len() {
                let class = match self.bad.contains(&[row, column]) {
                    true => " class=\"bad\"",
                    false if self.is_best(row, column) => " class=\"best\"",
                    false => "",
                };
                let _ = write!(html, "<td{class}>{}</td>", self.cell(row, column));
            }
            html.push_str("</tr>\n");
        }
        html.push_str("</tbody>\n</table></div>\n");
        html
    }

    /// The table as GitHub's Markdown, without its title, with the best values bold.
    pub fn markdown(&self) -> String {
        let plain = |text: &str| text.replace('|', "\\|").replace(['\n', '\r'], " ");
        let mut markdown = format!("| {} |", plain(&self.label));
        for column in &self.columns {
            let _ = write!(markdown, " {} |", plain(&column.name));
        }
        let _ = writeln!(markdown, "\n| --- |{}", " ---: |".repeat(self.columns.len()));
        for (row, (label, _)) in self.rows.iter().enumerate() {
            let _ = write!(markdown, "| {} |", plain(label));
            for column in 0..self.columns.len() {
                let mark = if self.is_best(row, column) { "**" } else { "" };
                let _ = write!(markdown, " {mark}{}{mark} |", self.cell(row, column));
            }
            markdown.push('\n');
        }
        markdown
    }

    fn value(&self, row: usize, column: usize) -> Option<f64> {
        self.rows[row].1.get(column).copied().flatten().filter(|value| !value.is_nan())
    }

    fn cell(&self, row: usize, column: usize) -> String {
        let digits = self.columns[column].digits;
        match self.value(row, column) {
            Some(value) if value == f64::INFINITY => "∞".to_owned(),
            Some(value) => format!("{value:.digits$}"),
            None => "–".to_owned(),
        }
    }

    /// Values that print the same are equally good; a single value is not highlighted.
    fn is_best(&self, row: usize, column: usize) -> bool {
        let values: Vec<f64> =
            (0..self.rows.len()).filter_map(|row| self.value(row, column)).collect();
        let best = match self.columns[column].best {
            Best::Unmarked => return false,
            Best::Least => values.iter().copied().min_by(f64::total_cmp),
            Best::Greatest => values.iter().copied().max_by(f64::total_cmp),
        };
        let digits = self.columns[column].digits;
        let is_equal =
            |best: f64, value: f64| format!("{best:.digits$}") == format!("{value:.digits$}");
        values.len() > 1
            && best.zip(self.value(row, column)).is_some_and(|(best, value)| is_equal(best, value))
    }
}
