//! One validated device for all tests of a process.

use std::sync::OnceLock;

use super::{DeviceChoice, Gpu};

static GPU: OnceLock<Gpu> = OnceLock::new();

/// The device that tests share: validation and synchronization validation are on. `NIGHTSPLAT_DEVICE` picks another
/// device than the default.
///
/// # Panics
/// There is no device or no validation layer: a test without them proves nothing.
#[expect(clippy::panic, reason = "a test without a device must fail")]
pub fn gpu() -> Gpu {
    let open = || {
        let choice = std::env::var("NIGHTSPLAT_DEVICE").unwrap_or_default();
        let choice: DeviceChoice = choice.parse().unwrap_or_else(|error| panic!("{error}"));
        Gpu::with_validation(&choice).unwrap_or_else(|error| panic!("{error}"))
    };
    GPU.get_or_init(open).clone()
}

/// # Panics
/// The validation layer has said something since the process began.
pub fn assert_no_validation_messages() {
    let messages = gpu().validation_messages();
    assert!(messages.is_empty(), "validation: {messages:#?}");
}
