//! The address space of the process (`ulimit -v`, `RLIMIT_AS`).
//!
//! Software devices compile kernels on first use, and their compilers crash without a message if memory is refused. A
//! limit that is certainly too low is therefore an error before the driver is loaded.

use crate::{Error, Result};

/// Measured on lavapipe: a tiny run with two threads takes this much; with a tenth less its kernels crash.
const LEAST: u64 = 1 << 30;

pub(super) fn check() -> Result<()> {
    match std::fs::read_to_string("/proc/self/limits").ok().and_then(|text| limit(&text)) {
        Some(bytes) if bytes < LEAST => {
            let (has, needs) = (bytes >> 20, LEAST >> 20);
            let problem = format!(
                "this process may address {has} MiB alone, a Vulkan driver needs {needs} MiB \
             beside the data; raise `ulimit -v`"
            );
            Err(Error::NoDevice(problem))
        }
        // Without a limit, or if the system does not report it.
        _ => Ok(()),
    }
}

/// The soft limit in bytes, from the table of `/proc`.
fn limit(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_read_where_there_is_one() {
        let table = |value: &str| {
            format!(
                "Limit  Soft Limit  Hard Limit  Units\nMax address space  {value}  unlimited  bytes\n"
            )
        };
        assert_eq!(limit(&table("307200000")), Some(307_200_000));
        assert_eq!(limit(&table("unlimited")), None);
        assert_eq!(limit(""), None);
    }
}
