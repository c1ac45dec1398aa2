//! Codes, the last error of each thread, and the log.

use std::any::Any;
use std::cell::RefCell;
use std::ffi::{c_char, c_void};
use std::fmt::{self, Write as _};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, Once, PoisonError};

use ash::vk;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use nightsplat::Error;
use nightsplat::gpu::HostMemoryError;

/// The version of this header, as `VK_MAKE_API_VERSION(0, major, minor, patch)`.
pub const NSP_HEADER_VERSION: u32 = 1 << 12;

/// 0 or more: success. Otherwise an error, whose message `nsp_last_error` returns.
pub type NspResult = i32;

/// Success.
pub const NSP_OK: NspResult = 0;
/// An argument is invalid; nothing was recorded.
pub const NSP_ERROR_USAGE: NspResult = -2;
/// A file is missing or invalid.
pub const NSP_ERROR_INPUT: NspResult = -3;
/// The device lacks a feature, or one of its limits is too low.
pub const NSP_ERROR_DEVICE: NspResult = -4;
/// Out of device or host memory; the object is unchanged.
pub const NSP_ERROR_MEMORY: NspResult = -5;
/// The device was lost; destroy everything.
pub const NSP_ERROR_LOST: NspResult = -6;
/// A file cannot be written.
pub const NSP_ERROR_OUTPUT: NspResult = -7;
/// A `struct_size` is below that of version 0.1, or members that this library does not know are not zero.
pub const NSP_ERROR_VERSION: NspResult = -8;
/// This build cannot train, or does not read the file format.
pub const NSP_ERROR_UNSUPPORTED: NspResult = -9;
/// A number is NaN or infinite.
pub const NSP_ERROR_NOT_FINITE: NspResult = -10;
/// The work was stopped on request.
pub const NSP_ERROR_STOPPED: NspResult = -11;
/// A bug in the library was caught; the object can only be destroyed.
pub const NSP_ERROR_INTERNAL: NspResult = -127;

/// Bytes of an error's text, with the NUL at its end.
const TEXT: usize = 1024;

thread_local!(static LAST: RefCell<[u8; TEXT]> = const { RefCell::new([0; TEXT]) });

/// An error on its way to C.
#[derive(Debug)]
pub(super) struct Failure {
    code: NspResult,
    text: String,
}

impl Failure {
    pub(super) fn usage(text: impl Into<String>) -> Self {
        Self { code: NSP_ERROR_USAGE, text: text.into() }
    }

    pub(super) fn new(code: NspResult, text: impl Into<String>) -> Self {
        Self { code, text: text.into() }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let cause = std::error::Error::source(&error).map(|cause| format!(" ({cause})"));
        let text = format!("{}{}", host_text(&error), cause.unwrap_or_default());
        Self { code: code(&error), text }
    }
}

/// The text of an error whose remedy is a host's, not the command's.
fn host_text(error: &Error) -> String {
    match error {
        Error::MissingFeature { device, feature } => {
            format!("{device} lacks {feature}; take another physical device")
        }
        Error::SelfTest { device, what, .. } => {
            format!(
                "{device} fails the self-test: {what}; update the driver or take another device"
            )
        }
        Error::Kernel { device, problem, kernel, .. } => format!(
            "{device} {problem} kernel `{kernel}`; update the driver or take another device"
        ),
        Error::OutOfMemory { buffer, bytes, .. } => format!(
            "out of memory: `{buffer}` needs {bytes} bytes; draw fewer Gaussians or a smaller view"
        ),
        Error::BufferTooLarge { buffer, bytes, device, limit } => format!(
            "`{buffer}` needs {bytes} bytes, {device} binds {limit} at most; draw fewer Gaussians or a smaller view"
        ),
        other => other.to_string(),
    }
}

fn code(error: &Error) -> NspResult {
    match error {
        Error::Usage(_) | Error::Setting { .. } => NSP_ERROR_USAGE,
        Error::Input { .. } => NSP_ERROR_INPUT,
        Error::Output { .. } => NSP_ERROR_OUTPUT,
        Error::OutOfMemory { source, .. } => match source.downcast_ref::<HostMemoryError>() {
            Some(cause) if cause.breaks_the_contract() => NSP_ERROR_INTERNAL,
            _ => NSP_ERROR_MEMORY,
        },
        Error::DeviceLost { .. } => NSP_ERROR_LOST,
        Error::NotFinite { .. } | Error::ParameterNotFinite { .. } => NSP_ERROR_NOT_FINITE,
        Error::Halted { .. } => NSP_ERROR_STOPPED,
        stopped if stopped.is_stop() => NSP_ERROR_STOPPED,
        Error::Vulkan { code, .. } => match vk::Result::from_raw(*code) {
            vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
                NSP_ERROR_MEMORY
            }
            _ => NSP_ERROR_DEVICE,
        },
        Error::NoDevice(_)
        | Error::MissingFeature { .. }
        | Error::SelfTest { .. }
        | Error::Kernel { .. }
        | Error::BufferTooLarge { .. }
        | Error::TileLimit { .. } => NSP_ERROR_DEVICE,
        // A kernel that disagrees with its reference, and what is added to the errors.
        _ => NSP_ERROR_INTERNAL,
    }
}

/// Keeps `text` as this thread's last error, in one line.
fn keep(text: &str) {
    LAST.with_borrow_mut(|last| {
        let text = text.replace('\n', " ");
        let mut len = text.len().min(TEXT - 1);
        while !text.is_char_boundary(len) {
            len -= 1;
        }
        last[..len].copy_from_slice(&text.as_bytes()[..len]);
        last[len] = 0;
    });
}

/// Runs the body of the function called `name`; a panic ends in an error as well.
pub(super) fn guard(name: &str, run: impl FnOnce() -> Result<(), Failure>) -> NspResult {
    let run = || {
        #[cfg(debug_assertions)]
        panics::panic_if_asked(name);
        run()
    };
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(Ok(())) => NSP_OK,
        Ok(Err(Failure { code, text })) => {
            keep(&format!("{name}: {text}"));
            code
        }
        Err(panic) => {
            keep(&format!("{name}: a bug of nightsplat: {}", text_of(&*panic)));
            NSP_ERROR_INTERNAL
        }
    }
}

fn text_of(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic")
}

/// An object that C holds, until a panic leaves it in an unknown state.
#[derive(Debug)]
pub(super) struct Object<T> {
    inner: T,
    is_broken: bool,
}

impl<T> Object<T> {
    pub(super) fn new(inner: T) -> Self {
        Self { inner, is_broken: false }
    }

    pub(super) fn get(&self, what: &str) -> Result<&T, Failure> {
        match self.is_broken {
            true => Err(broken(what)),
            false => Ok(&self.inner),
        }
    }

    /// Runs `body` on the object; one that is left by a panic is broken.
    pub(super) fn with<R>(
        &mut self,
        what: &str,
        body: impl FnOnce(&mut T) -> Result<R, Failure>,
    ) -> Result<R, Failure> {
        if self.is_broken {
            return Err(broken(what));
        }
        self.is_broken = true;
        #[cfg(debug_assertions)]
        panics::panic_if_asked(what);
        let done = body(&mut self.inner);
        self.is_broken = false;
        done
    }
}

fn broken(what: &str) -> Failure {
    let text = format!("{what} was left by a bug of nightsplat; destroy it");
    Failure::new(NSP_ERROR_INTERNAL, text)
}

/// The message of this thread's last error: one line, never NULL, valid until the thread's next error.
#[unsafe(no_mangle)]
pub extern "C" fn nsp_last_error() -> *const c_char {
    LAST.with_borrow(|last| last.as_ptr().cast())
}

/// The library's version, as `VK_MAKE_API_VERSION(0, major, minor, patch)`.
#[unsafe(no_mangle)]
pub extern "C" fn nsp_version() -> u32 {
    let part = |text: &str| text.parse().unwrap_or_default();
    vk::make_api_version(
        0,
        part(env!("CARGO_PKG_VERSION_MAJOR")),
        part(env!("CARGO_PKG_VERSION_MINOR")),
        part(env!("CARGO_PKG_VERSION_PATCH")),
    )
}

/// The host's function for lines of the log.
type Function = unsafe extern "C" fn(user: *mut c_void, level: i32, line: *const c_char);

struct Log {
    function: Option<Function>,
    user: *mut c_void,
}

// SAFETY: the host promises that its function may be called from any thread with its pointer.
unsafe impl Send for Log {}

static LOG: Mutex<Log> = Mutex::new(Log { function: None, user: std::ptr::null_mut() });

/// Sets the function that receives the lines of the log, from any thread; NULL: none. `level` is 1 for errors, 2 for
/// warnings, 3 for information. This is the only global state.
///
/// # Safety
/// `log` may be called from any thread with `user` until it is replaced.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_set_log(
    log: Option<unsafe extern "C" fn(user: *mut c_void, level: i32, line: *const c_char)>,
    user: *mut c_void,
) {
    static ONCE: Once = Once::new();
    // A Rust host with a subscriber of its own keeps it.
    ONCE.call_once(|| tracing::subscriber::set_global_default(Lines).unwrap_or_default());
    *LOG.lock().unwrap_or_else(PoisonError::into_inner) = Log { function: log, user };
}

/// Turns events into lines.
struct Lines;

struct Line(String);

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing into a string cannot fail.
        let _ = match field.name() {
            "message" => write!(self.0, "{value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

impl Subscriber for Lines {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        *metadata.level() <= Level::INFO && metadata.is_event()
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut line = Line(String::new());
        event.record(&mut line);
        let level = match *event.metadata().level() {
            Level::ERROR => 1,
            Level::WARN => 2,
            _ => 3,
        };
        let text = std::ffi::CString::new(line.0.replace('\n', " ")).unwrap_or_default();
        let log = LOG.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(function) = log.function {
            // SAFETY: as the host promised when it set the function.
            unsafe { function(log.user, level, text.as_ptr()) };
        }
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// Panics on purpose.
#[cfg(debug_assertions)]
pub mod panics {
    use std::cell::Cell;

    thread_local!(static ASKED: Cell<Option<&'static str>> = const { Cell::new(None) });

    /// Has the function of this name, or the next call on an object of this kind, panic once on this thread.
    pub fn panic_in(name: &'static str) {
        ASKED.set(Some(name));
    }

    #[expect(clippy::panic, reason = "what a test asks for")]
    pub(super) fn panic_if_asked(name: &str) {
        if ASKED.get() == Some(name) {
            ASKED.set(None);
            panic!("a test asked for a panic");
        }
    }
}
