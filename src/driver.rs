//! Opens devices. A GPU's driver that is new on this machine compiles every kernel once in a child process, so that a
//! crash of the driver is an error with one line.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};

use nightsplat_core::output::write_whole;

use crate::gpu::{DeviceChoice, DeviceReport, Gpu, cache_folder};
use crate::self_test::TEST_VARIABLE;
use crate::{Error, Result};

/// What the file of a driver holds that compiles every kernel; otherwise the kernel at which it crashed.
const COMPILES: &str = "compiles";

/// [`Gpu::new`], after a driver that is new on this machine was seen to compile every kernel.
pub(crate) fn open(choice: &DeviceChoice) -> Result<Gpu> {
    let _phase = tracing::info_span!("device").entered();
    Gpu::open_checked(choice, check_new)?.tested()
}

/// Refuses a device whose driver is new on this machine and crashes when it compiles a kernel.
fn check_new(device: &DeviceReport, index: usize) -> Result<()> {
    let wanted = std::env::var(TEST_VARIABLE).unwrap_or_default();
    let is_known = device.kind == "software" && wanted != "always";
    if wanted == "off" || is_known { Ok(()) } else { check(device, index) }
}

fn check(device: &DeviceReport, index: usize) -> Result<()> {
    let Some(path) = verdict_path(device) else { return Ok(()) };
    let verdict = match std::fs::read_to_string(&path) {
        Ok(verdict) => verdict,
        Err(error) if error.kind() == ErrorKind::NotFound => {
            let Some(verdict) = compiled(device, index) else { return Ok(()) };
            keep(&path, &verdict);
            verdict
        }
        // What cannot be read cannot be written either: the check would be repeated by each command.
        Err(_) => return Ok(()),
    };
    if verdict == COMPILES {
        return Ok(());
    }
    Err(Error::Kernel {
        device: format!("{}, {},", device.name, device.driver),
        problem: "crashed when it compiled".to_owned(),
        kernel: verdict,
        remedy: format!("; without {} it is tried again", path.display()),
    })
}

/// The file of this device, driver and version of ours.
fn verdict_path(device: &DeviceReport) -> Option<PathBuf> {
    let DeviceReport { vendor, device, driver_version, .. } = device;
    let version = env!("CARGO_PKG_VERSION");
    Some(cache_folder()?.join(format!("{vendor:x}-{device:x}-{driver_version:x}-{version}.driver")))
}

fn keep(path: &Path, verdict: &str) {
    let folder = path.parent().map_or(Ok(()), std::fs::create_dir_all);
    let kept = folder.map_err(|error| Error::output(path, error.to_string()));
    // A verdict that cannot be kept costs time, never correctness.
    if let Err(error) = kept.and_then(|()| write_whole(path, verdict.as_bytes())) {
        tracing::debug!("{error}");
    }
}

/// The verdict of a process that compiles every kernel; `None` if it ended otherwise than by a crash: this process then
/// meets the same error.
fn compiled(device: &DeviceReport, index: usize) -> Option<String> {
    tracing::info!("{}, {}: compiles every kernel once", device.name, device.driver);
    let mut command = Command::new(std::env::current_exe().ok()?);
    command.args(["doctor", "--compile", &index.to_string()]);
    command.stdin(Stdio::null()).stderr(Stdio::null());
    let output = command.output().ok()?;
    if output.status.success() {
        return Some(COMPILES.to_owned());
    }
    let printed = String::from_utf8_lossy(&output.stdout);
    let kernel = printed.lines().next_back().unwrap_or("self_test");
    has_crashed(output.status).then(|| kernel.to_owned())
}

/// Whether a process ended by a signal, or on Windows by an exception.
fn has_crashed(status: ExitStatus) -> bool {
    status.code().is_none_or(|code| code < 0)
}
