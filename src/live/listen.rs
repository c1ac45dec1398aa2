//! The address of a server, as an option states it.

use std::net::{SocketAddr, ToSocketAddrs};
use std::str::FromStr;

/// The address that a server listens on: a port of this machine, or a host and a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Listen(pub(super) SocketAddr);

/// The default: reachable from this machine only.
pub const DEFAULT_ADDRESS: &str = "127.0.0.1:7007";

impl FromStr for Listen {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let whole = match text.parse::<u16>() {
            Ok(port) => format!("127.0.0.1:{port}"),
            Err(_) => text.to_owned(),
        };
        let address = whole.to_socket_addrs().ok().and_then(|mut found| found.next());
        address
            .map(Self)
            .ok_or_else(|| format!("name a port, or a host and a port, such as {DEFAULT_ADDRESS}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_alone_is_one_of_this_machine() {
        for (text, expected) in [
            ("7008", Some("127.0.0.1:7008")),
            ("0.0.0.0:80", Some("0.0.0.0:80")),
            ("[::1]:0", Some("[::1]:0")),
            ("70080", None),
            ("127.0.0.1", None),
            ("", None),
        ] {
            let parsed = text.parse::<Listen>().map(|listen| listen.0.to_string());
            assert_eq!(parsed.clone().ok().as_deref(), expected, "{text}: {parsed:?}");
        }
    }
}
