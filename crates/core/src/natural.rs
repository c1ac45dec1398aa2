//! The order of names as people count: 2 before 10.

use std::cmp::Ordering;

/// Compares names, with the digits in them as numbers; names that are equal so are compared by their bytes.
pub fn compare(a: &str, b: &str) -> Ordering {
    runs(a).map(Run::new).cmp(runs(b).map(Run::new)).then(a.cmp(b))
}

/// The digits and the other parts of a name.
fn runs(name: &str) -> impl Iterator<Item = &[u8]> {
    name.as_bytes().chunk_by(|one, next| one.is_ascii_digit() == next.is_ascii_digit())
}

/// A part of a name.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Run<'a> {
    /// By the count of its digits, without leading zeros, then by these.
    Number(usize, &'a [u8]),
    Text(&'a [u8]),
}

impl<'a> Run<'a> {
    fn new(run: &'a [u8]) -> Self {
        let digits = &run[run.iter().take_while(|&&byte| byte == b'0').count()..];
        if run[0].is_ascii_digit() { Self::Number(digits.len(), digits) } else { Self::Text(run) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_are_counted() {
        let order = [
            "1", "2", "2.5", "10", "011", "IMG_2", "IMG_2b", "IMG_10", "IMG_10a", "a", "b1c2",
            "b1c10", "b01d", "ä9", "ä10",
        ];
        let mut names = order.to_vec();
        names.sort_unstable();
        names.sort_by(|a, b| compare(a, b));
        assert_eq!(names, order);
        assert_eq!(compare("7", "07"), Ordering::Greater);
        assert_eq!(compare("", "a"), Ordering::Less);
        // Longer than any integer.
        assert_eq!(compare(&"9".repeat(90), &"1".repeat(91)), Ordering::Less);
    }
}
