//! Tables of comma-separated values (RFC 4180), a line for each record.
//!
//! Line breaks in names are escaped, and a name that a spreadsheet would compute begins with an apostrophe.

use super::output::one_line;

/// The line of a record, with its line break.
pub fn line<Cell: AsRef<str>>(cells: impl IntoIterator<Item = Cell>) -> String {
    let fields: Vec<String> = cells.into_iter().map(|cell| field(cell.as_ref())).collect();
    fields.join(",") + "\n"
}

/// A cell as a field: quoted if it has a comma or a quote.
pub fn field(cell: &str) -> String {
    let mut text = one_line(cell).into_owned();
    if is_formula(text.trim_start_matches('\'')) {
        text.insert(0, '\'');
    }
    if text.contains([',', '"']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text }
}

/// The cells of a line. What lines of other programs have outside of quotes, blanks included, is kept.
pub fn cells(line: &str) -> Vec<String> {
    let (mut cells, mut rest) = (vec![], Some(line));
    while let Some(text) = rest {
        let (cell, after) = match text.trim_start().strip_prefix('"') {
            Some(quoted) => unquoted(quoted),
            None => text
                .split_once(',')
                .map_or((text.to_owned(), None), |(cell, after)| (cell.to_owned(), Some(after))),
        };
        let is_defused = cell.starts_with('\'') && is_formula(cell.trim_start_matches('\''));
        cells.push(if is_defused { cell[1..].to_owned() } else { cell });
        rest = after;
    }
    cells
}

/// The cells of a line of a table of `columns`. If the line has more, the first cell has commas and no quotes.
pub fn cells_of(line: &str, columns: usize) -> Vec<String> {
    let mut cells = cells(line);
    let of_first = (cells.len() + 1).saturating_sub(columns);
    if of_first > 1 {
        let first = cells.drain(..of_first).collect::<Vec<_>>().join(",");
        cells.insert(0, first);
    }
    cells
}

/// The cell after an opening quote, and what follows the next comma.
fn unquoted(text: &str) -> (String, Option<&str>) {
    let (mut cell, mut rest) = (String::new(), text);
    loop {
        let Some((part, after)) = rest.split_once('"') else {
            return (cell + rest, None);
        };
        cell += part;
        let Some(quoted) = after.strip_prefix('"') else {
            let (tail, next) = after.split_once(',').map_or((after, None), |(a, b)| (a, Some(b)));
            return (cell + tail.trim_end(), next);
        };
        cell.push('"');
        rest = quoted;
    }
}

/// Whether a spreadsheet computes a cell that is no number.
fn is_formula(cell: &str) -> bool {
    cell.starts_with(['=', '+', '-', '@']) && cell.parse::<f64>().is_err()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_one_field_on_one_line_and_is_read_back() {
        for (cell, written) in [
            ("IMG_1", "IMG_1"),
            ("", ""),
            (" a b ", " a b "),
            ("a,b", "\"a,b\""),
            ("say \"no\"", "\"say \"\"no\"\"\""),
            ("\",\"", "\"\"\",\"\"\""),
            ("=1+1", "'=1+1"),
            ("-x,y", "\"'-x,y\""),
            ("@a", "'@a"),
            ("'=a", "''=a"),
            ("'a", "'a"),
            ("-0.5", "-0.5"),
            ("+1e3", "+1e3"),
        ] {
            assert_eq!(field(cell), written);
            assert_eq!(cells(&format!("{written},{written}")), [cell, cell]);
        }
        assert_eq!(line(["a,b", "1"]), "\"a,b\",1\n");
        assert_eq!(field("two\nlines,\u{1b}\u{202e}"), r#""two\nlines,\u{1b}\u{202e}""#);
    }

    #[test]
    fn names_of_other_programs_may_have_commas_without_quotes() {
        assert_eq!(cells_of("a, b,c \"d\",1,2", 3), ["a, b,c \"d\"", "1", "2"]);
        assert_eq!(cells_of("\"a, b\",1,2", 3), ["a, b", "1", "2"]);
        assert_eq!(cells_of(" \"a\" , 1", 3), ["a", " 1"]);
        assert_eq!(cells("\"open"), ["open"]);
    }
}
