//! PCI addresses of devices.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Result};

/// A PCI address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct PciAddress {
    /// The domain, 0 on most machines.
    pub domain: u32,
    /// The bus in the domain.
    pub bus: u32,
    /// The device on the bus.
    pub device: u32,
    /// The function of the device.
    pub function: u32,
}

impl fmt::Display for PciAddress {
    /// In the form of `lspci -D`: `0000:65:00.0`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { domain, bus, device, function } = self;
        write!(f, "{domain:04x}:{bus:02x}:{device:02x}.{function:x}")
    }
}

impl FromStr for PciAddress {
    type Err = Error;

    /// `domain:bus:device.function`, hexadecimal; domain and function may be left out.
    fn from_str(text: &str) -> Result<Self> {
        let number = |part: &str| u32::from_str_radix(part, 16).ok();
        let parse = || {
            let (address, function) = text.split_once('.').unwrap_or((text, "0"));
            let parts: Vec<u32> = address.split(':').map(number).collect::<Option<_>>()?;
            let (domain, bus, device) = match parts[..] {
                [bus, device] => (0, bus, device),
                [domain, bus, device] => (domain, bus, device),
                _ => return None,
            };
            Some(Self { domain, bus, device, function: number(function)? })
        };
        parse().ok_or_else(|| {
            Error::Usage(format!(
                "`{text}` is no PCI address: domain:bus:device.function, as in 0000:65:00.0"
            ))
        })
    }
}

impl serde::Serialize for PciAddress {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}
