//! `exposures.csv`: the known or learned exposure of each view.
//!
//! ```text
//! name,ev,gain_r,gain_g,gain_b,bias_r,bias_g,bias_b
//! IMG_0001,-1.02,0.71,0.72,0.7,0.004,0.002,0.001
//! ```
//!
//! Only `name` is required; cells may be empty.

use std::collections::BTreeSet;
use std::path::Path;

use nightsplat_core::output::write_whole;
use nightsplat_core::{Error, Result, csv, input};

use super::Affine;
use crate::image::files::stem;
use crate::image::{MIDDLE_GREY, linear_from_srgb, srgb_from_linear};

/// The columns in the order in which they are written.
const COLUMNS: [&str; 8] =
    ["name", "ev", "gain_r", "gain_g", "gain_b", "bias_r", "bias_g", "bias_b"];

/// A view's row.
#[derive(Clone, Debug, PartialEq)]
pub struct KnownExposure {
    /// The view's name.
    pub name: String,
    /// The brightness of the photograph relative to EV 0, in stops of linear light.
    pub ev: Option<f64>,
    /// The exposure of encoded values of the target.
    pub affine: Option<Affine>,
}

impl Affine {
    /// The stops of the exposure at middle grey: the mean over the channels.
    pub fn stops(&self) -> f64 {
        let grey = f64::from(srgb_from_linear(MIDDLE_GREY));
        let stops = |c: usize| {
            let exposed = (self.gain[c] * grey + self.bias[c]).max(1e-4);
            f64::from(linear_from_srgb(exposed as f32) / MIDDLE_GREY).log2()
        };
        (stops(0) + stops(1) + stops(2)) / 3.0
    }
}

/// Writes the exposure of each view.
pub fn save(path: &Path, exposures: &[(String, Affine)]) -> Result<()> {
    let mut text = COLUMNS.join(",") + "\n";
    for (name, affine) in exposures {
        let Affine { gain: [r, g, b], bias } = affine;
        text += &format!("{},{:.3},{r},{g},{b},", csv::field(name), affine.stops());
        text += &format!("{},{},{}\n", bias[0], bias[1], bias[2]);
    }
    write_whole(path, text.as_bytes())
}

/// Reads the rows of a table; a name may have the extension of its photograph.
pub fn load(path: &Path) -> Result<Vec<KnownExposure>> {
    let text = input::text(path)?;
    let refused = |problem: String| Error::input(path, problem);
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let header = lines.next().map_or("", |(_, line)| line);
    let columns: Vec<&str> = header.split(',').map(str::trim).collect();
    let unknown = columns.iter().find(|column| !COLUMNS.contains(column));
    if columns.first() != Some(&"name") || unknown.is_some() {
        let all = COLUMNS.join(",");
        return Err(refused(format!("begins with `{header}`; its columns must be of {all}")));
    }
    let (mut rows, mut names) = (vec![], BTreeSet::new());
    for (number, line) in lines {
        let exposure = parsed(&columns, line)
            .map_err(|problem| refused(format!("line {}: {problem}", number + 1)))?;
        if !names.insert(exposure.name.clone()) {
            let problem = format!("line {}: `{}` occurs twice", number + 1, exposure.name);
            return Err(refused(problem));
        }
        rows.push(exposure);
    }
    Ok(rows)
}

/// Parses a line.
fn parsed(columns: &[&str], line: &str) -> Result<KnownExposure, String> {
    let cells = csv::cells_of(line, columns.len());
    let cells: Vec<&str> = cells.iter().map(|cell| cell.trim()).collect();
    if cells.len() != columns.len() {
        return Err(format!("`{line}` has {} cells, not {}", cells.len(), columns.len()));
    }
    let number = |column: &str| -> Result<Option<f64>, String> {
        let cell = columns.iter().position(|name| *name == column).map_or("", |at| cells[at]);
        if cell.is_empty() {
            return Ok(None);
        }
        let value = cell.parse::<f64>().ok().filter(|value| value.is_finite());
        value.map(Some).ok_or_else(|| format!("{column} is `{cell}`, which is not a number"))
    };
    let three = |of: &str| -> Result<Option<[f64; 3]>, String> {
        match [
            number(&format!("{of}_r"))?,
            number(&format!("{of}_g"))?,
            number(&format!("{of}_b"))?,
        ] {
            [Some(r), Some(g), Some(b)] => Ok(Some([r, g, b])),
            [None, None, None] => Ok(None),
            _ => Err(format!("{of} needs red, green and blue, or none of them")),
        }
    };
    let (gain, bias) = (three("gain")?, three("bias")?);
    if let Some(gain) = gain.filter(|gain| gain.iter().any(|&gain| gain <= 0.0)) {
        return Err(format!("gains are {gain:?}; they must be above 0"));
    }
    let affine = (gain.is_some() || bias.is_some())
        .then(|| Affine { gain: gain.unwrap_or([1.0; 3]), bias: bias.unwrap_or_default() });
    Ok(KnownExposure { name: stem(cells[0]).to_owned(), ev: number("ev")?, affine })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Vec<KnownExposure>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("exposures.csv");
        std::fs::write(&path, text).unwrap();
        load(&path)
    }

    #[test]
    fn a_table_is_read_back_from_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("exposures.csv");
        let affine = Affine { gain: [0.7, 1.0 / 3.0, 2.5], bias: [0.125, -1e-7, 0.0] };
        let exposures = [("a, \"b\"".to_owned(), affine), ("=c".to_owned(), Affine::IDENTITY)];
        save(&path, &exposures).unwrap();
        let read_rows = load(&path).unwrap();
        for ((name, affine), read_rows) in exposures.iter().zip(&read_rows) {
            assert_eq!((name, Some(*affine)), (&read_rows.name, read_rows.affine));
        }
        assert_eq!(read_rows[1].ev, Some(0.0));
    }

    #[test]
    fn cells_may_be_empty_and_columns_omitted() {
        let rows = read("name,ev\nb.JPG, -1.5\n\na,\n").unwrap();
        assert_eq!((rows[0].name.as_str(), rows[0].ev, rows[0].affine), ("b", Some(-1.5), None));
        assert_eq!((rows[1].name.as_str(), rows[1].ev), ("a", None));
        let rows = read("name,gain_r,gain_g,gain_b\na,1,2,3\n").unwrap();
        assert_eq!(rows[0].affine, Some(Affine { gain: [1.0, 2.0, 3.0], bias: [0.0; 3] }));
    }

    #[test]
    fn an_invalid_table_is_refused_with_its_line() {
        for (text, part) in [
            ("", "begins with ``"),
            ("view,ev\n", "name,ev,gain_r"),
            ("name,evs\n", "evs"),
            ("name,ev\na\n", "line 2"),
            ("name,ev\na,many\n", "`many`"),
            ("name,ev\na,nan\n", "not a number"),
            ("name,ev\na,1\na.png,1\n", "line 3: `a` occurs twice"),
            ("name,gain_r\na,1\n", "needs red, green and blue"),
            ("name,gain_r,gain_g,gain_b\na,1,0,1\n", "above 0"),
        ] {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("exposures.csv"), "{message}");
        }
    }

    #[test]
    fn an_encoded_gain_of_sqrt_2_is_about_a_stop() {
        let affine = |gain: f64| Affine { gain: [gain; 3], bias: [0.0; 3] };
        assert_eq!(Affine::IDENTITY.stops(), 0.0);
        let grey = |stops: f32| srgb_from_linear(MIDDLE_GREY * stops.exp2());
        for stops in [-2.0, 1.0] {
            let gain = f64::from(grey(stops) / grey(0.0));
            assert!((affine(gain).stops() - f64::from(stops)).abs() < 1e-5);
        }
    }
}
