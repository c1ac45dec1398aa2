//! Fields of CSV files.

/// A number of a CSV file, all of its digits; empty where there is none.
pub(in crate::cli) fn number(value: Option<f64>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}
