//! Signals to a run: SIGINT, SIGTERM and SIGHUP save and stop, another a second later or more ends the process at once.
//! SIGXCPU saves and stops, too. SIGUSR1 saves and continues, SIGUSR2 lets the run cool down and finish.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use crate::results::run::Requests;
use crate::{Error, Result, Stop};

/// A process may get one signal twice, such as from a terminal and from a parent that forwards it; what comes within
/// this time of the first is no second one.
const SAME_WITHIN: Duration = Duration::from_secs(1);

/// Has a file beyond the limit of its size (`ulimit -f`) be an error of writing, with its path, instead of the end of
/// the process.
pub fn report_long_files() {
    // Without a handler it is as it was.
    #[cfg(unix)]
    let _ = flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
}

/// Installs the handlers and returns the requests that they set.
pub(super) fn requests() -> Result<Requests> {
    let refused =
        |error: std::io::Error| Error::input("signals", format!("cannot be handled: {error}"));
    let requests = Requests::default();
    let stops = stops();
    end_on_the_second(stops).map_err(refused)?;
    // SIGXCPU comes every second from the soft limit of processor time on (`ulimit -St`), so it is no second signal.
    #[cfg(unix)]
    let out_of_time = [(signal_hook::consts::SIGXCPU, Stop::TimeUp)];
    #[cfg(not(unix))]
    let out_of_time = [];
    for &(signal, cause) in stops.iter().chain(&out_of_time) {
        let stop = Arc::clone(requests.stop_flag());
        flag::register_usize(signal, stop, Requests::code(cause)).map_err(refused)?;
    }
    #[cfg(unix)]
    for (signal, wanted) in [
        (signal_hook::consts::SIGUSR1, requests.save_flag()),
        (signal_hook::consts::SIGUSR2, requests.finish_flag()),
    ] {
        flag::register(signal, Arc::clone(wanted)).map_err(refused)?;
    }
    Ok(requests)
}

/// The signals that save and stop.
fn stops() -> &'static [(i32, Stop)] {
    static STOPS: OnceLock<Vec<(i32, Stop)>> = OnceLock::new();
    STOPS.get_or_init(|| {
        let mut stops = vec![(SIGINT, Stop::Interrupted), (SIGTERM, Stop::Terminated)];
        #[cfg(unix)]
        if !ignores_hang_up() {
            stops.push((signal_hook::consts::SIGHUP, Stop::HungUp));
        }
        stops
    })
}

/// Whether this process was started to outlive its terminal, as by `nohup`. A process that it starts ignores the same
/// signals: one that sends itself SIGHUP lives on.
#[cfg(unix)]
fn ignores_hang_up() -> bool {
    let mut shell = std::process::Command::new("sh");
    shell.args(["-c", "kill -HUP $$"]).stdin(std::process::Stdio::null());
    shell.status().is_ok_and(|status| status.success())
}

/// Lets signals end the process from [`SAME_WITHIN`] after the first on.
fn end_on_the_second(stops: &[(i32, Stop)]) -> std::io::Result<()> {
    static IS_INSTALLED: AtomicBool = AtomicBool::new(false);
    if IS_INSTALLED.swap(true, Ordering::Relaxed) {
        return Ok(());
    }
    let has_come = Arc::new(AtomicBool::new(false));
    let ends = set_after(Arc::clone(&has_come), SAME_WITHIN)?;
    for &(signal, cause) in stops {
        let code = i32::from(cause.exit_code());
        flag::register_conditional_shutdown(signal, code, Arc::clone(&ends))?;
        flag::register(signal, Arc::clone(&has_come))?;
    }
    Ok(())
}

/// A flag that is set this time after the other, or up to a tenth of a second later.
fn set_after(first: Arc<AtomicBool>, time: Duration) -> std::io::Result<Arc<AtomicBool>> {
    const POLL: Duration = Duration::from_millis(100);
    let flag = Arc::new(AtomicBool::new(false));
    let second = Arc::clone(&flag);
    std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        while !first.load(Ordering::Relaxed) {
            std::thread::sleep(POLL);
        }
        std::thread::sleep(time);
        second.store(true, Ordering::Relaxed);
    })?;
    Ok(flag)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_signal_counts_from_a_second_after_the_first_on() {
        let first = Arc::new(AtomicBool::new(false));
        let ends = set_after(Arc::clone(&first), SAME_WITHIN).unwrap();
        let ends_after = |time| {
            std::thread::sleep(time);
            ends.load(Ordering::Relaxed)
        };
        assert!(!ends_after(SAME_WITHIN + Duration::from_millis(200)), "no signal has come");
        first.store(true, Ordering::Relaxed);
        assert!(!ends_after(Duration::from_millis(500)));
        let begin = std::time::Instant::now();
        while !ends_after(Duration::from_millis(50)) {
            assert!(begin.elapsed() < Duration::from_secs(30));
        }
    }
}
