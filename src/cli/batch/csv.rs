//! Fields of CSV files.

/// A field of a CSV file (RFC 4180).
pub(in crate::cli) fn field(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// A number of a CSV file, all of its digits; empty where there is none.
pub(in crate::cli) fn number(value: Option<f64>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}
