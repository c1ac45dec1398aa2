//! Warnings of libjpeg: coded data that ends early, invalid codes, missing restart markers.
//!
//! libjpeg fills missing data with grey and continues; its default error manager prints the warnings.

use std::cell::Cell;
use std::ffi::c_int;
use std::panic::resume_unwind;
use std::ptr::null;

use mozjpeg_sys::{jpeg_common_struct, jpeg_error_mgr};

thread_local! {
    static WARNINGS: Cell<usize> = const { Cell::new(0) };
}

/// An error manager that unwinds on errors and counts warnings on the decoding thread.
pub(super) fn counting() -> jpeg_error_mgr {
    jpeg_error_mgr {
        error_exit: Some(unwind),
        emit_message: Some(count),
        output_message: Some(ignore),
        format_message: None,
        reset_error_mgr: Some(ignore),
        msg_code: 0,
        msg_parm: Default::default(),
        trace_level: 0,
        num_warnings: 0,
        jpeg_message_table: null(),
        last_jpeg_message: 0,
        addon_message_table: null(),
        first_addon_message: 0,
        last_addon_message: 0,
    }
}

/// The number of warnings on this thread since the last call.
pub(super) fn take() -> usize {
    WARNINGS.take()
}

extern "C-unwind" fn unwind(_: &mut jpeg_common_struct) {
    // Not a panic, which would call the panic hook.
    resume_unwind(Box::new("libjpeg gives up"));
}

/// Levels from 0 on are traces.
extern "C-unwind" fn count(_: &mut jpeg_common_struct, level: c_int) {
    if level < 0 {
        WARNINGS.set(WARNINGS.get() + 1);
    }
}

extern "C-unwind" fn ignore(_: &mut jpeg_common_struct) {}
