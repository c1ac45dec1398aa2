//! Tables of text.

use crate::output::one_line;

/// The rows with aligned columns: the first to the left, the others to the right.
pub fn aligned(rows: &[Vec<String>]) -> String {
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
