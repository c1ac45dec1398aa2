//! Tables for the terminal.

use nightsplat_core::output::one_line;

use crate::results::report::{Column, NumberTable};

/// A table of the report as text.
pub(super) fn text(table: &NumberTable) -> String {
    let NumberTable { label, columns, rows, .. } = table;
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

/// The rows with aligned columns: the first to the left, the others to the right.
pub(super) fn aligned(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let cell_width = |row: &Vec<String>, column: usize| {
        row.get(column).map_or(0, |cell| one_line(cell).chars().count())
    };
    let widths: Vec<usize> = (0..columns)
        .map(|column| rows.iter().map(|row| cell_width(row, column)).max().unwrap_or(0))
        .collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| {
            let cell = one_line(cell);
            if column == 0 { format!("{cell:width$}") } else { format!("  {cell:>width$}") }
        });
        cells.collect::<String>().trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::aligned;

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let rows = [["view", "PSNR"], ["a", "24.50"], ["größer", "7.1"]];
        let rows = rows.map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(aligned(&rows), "view     PSNR\na       24.50\ngrößer    7.1\n");
        assert_eq!(aligned(&[]), "");
        let forged = [["a\nerror: lost", "1"].map(str::to_owned).to_vec()];
        assert_eq!(aligned(&forged), "a\\nerror: lost  1\n");
    }
}
