//! Signals to a run: SIGINT and SIGTERM save and stop, a second one ends the process at once, SIGUSR1 saves and
//! continues.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use crate::results::run::Requests;
use crate::{Error, Result, Stop};

/// Installs the handlers and returns the requests that they set.
pub(super) fn requests() -> Result<Requests> {
    let requests = Requests::default();
    let refused =
        |error: std::io::Error| Error::input("signals", format!("cannot be handled: {error}"));
    let is_second = Arc::new(AtomicBool::new(false));
    for (signal, cause) in [(SIGINT, Stop::Interrupted), (SIGTERM, Stop::Terminated)] {
        let code = i32::from(cause.exit_code());
        // In this order: the first signal finds the flag clear and sets it.
        flag::register_conditional_shutdown(signal, code, Arc::clone(&is_second))
            .map_err(refused)?;
        flag::register(signal, Arc::clone(&is_second)).map_err(refused)?;
        let stop = Arc::clone(requests.stop_flag());
        flag::register_usize(signal, stop, Requests::code(cause)).map_err(refused)?;
    }
    #[cfg(unix)]
    flag::register(signal_hook::consts::SIGUSR1, Arc::clone(requests.save_flag()))
        .map_err(refused)?;
    Ok(requests)
}
