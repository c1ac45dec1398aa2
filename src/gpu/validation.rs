//! The messages of the validation layer: logged as they come and, in tests, a failure of the process.

use std::ffi::{CStr, c_int, c_void};
use std::io::Write;
use std::sync::{Mutex, Once};

use ash::vk;

/// The Khronos layer that checks every call, and here every hazard.
pub(super) const LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// Older layers have a race between the labels of command buffers that two threads record, and crash
/// (KhronosGroup/Vulkan-ValidationLayers#5172).
pub(super) const FIRST_SAFE_WITH_LABELS: u32 = vk::make_api_version(0, 1, 3, 243);

/// Set in the environment of the processes that tests start, so that they [`fail_at_exit`].
const FAIL_VARIABLE: &str = "NIGHTSPLAT_FAIL_ON_VALIDATION";

/// The exit code of a process that validation fails: that of a test binary with a failed test.
const FAILED: c_int = 101;

/// All messages so far, each with the name of the thread, which in a test is the test's.
static MESSAGES: Mutex<Vec<String>> = Mutex::new(vec![]);

/// A messenger for the layer's warnings and errors.
pub(super) fn messenger() -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    if std::env::var_os(FAIL_VARIABLE).is_some() {
        fail_at_exit();
    }
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(
            vk::DebugUtilsMessageSeverityFlagsEXT::ERROR
                | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
        )
        .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
        .pfn_user_callback(Some(on_message))
}

unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    _: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the loader passes valid callback data with a NUL-terminated message.
    let message = unsafe { CStr::from_ptr((*data).p_message) }.to_string_lossy();
    if is_of_an_old_layer(&message) {
        tracing::debug!(target: "vulkan", "{message}");
        return vk::FALSE;
    }
    tracing::error!(target: "vulkan", "{message}");
    // The layer calls from the thread that made the offending call.
    let thread = std::thread::current();
    super::lock(&MESSAGES).push(format!("{}: {message}", thread.name().unwrap_or("a thread")));
    vk::FALSE
}

/// Whether a layer reports an extension that is newer than itself, such as cooperative matrices in Debian 12's: a
/// structure, or the capability of a shader (6022, `CooperativeMatrixKHR`). It checks nothing of such an extension; one
/// of the driver's age does.
fn is_of_an_old_layer(message: &str) -> bool {
    ["structure with unknown VkStructureType", "Invalid capability operand: 6022"]
        .iter()
        .any(|unknown| message.contains(unknown))
}

unsafe extern "C" {
    fn atexit(function: extern "C" fn()) -> c_int;
    fn _exit(code: c_int) -> !;
}

/// Makes a process with any message of the layer fail at its exit, whatever its tests found, and print the messages.
pub(super) fn fail_at_exit() {
    static ONCE: Once = Once::new();
    // SAFETY: the function lives as long as the process, and does not unwind.
    ONCE.call_once(|| assert_eq!(unsafe { atexit(fail_with_messages) }, 0));
}

extern "C" fn fail_with_messages() {
    let messages = super::lock(&MESSAGES);
    if !messages.is_empty() {
        // With a closed stderr, the exit code alone tells.
        let _ = writeln!(std::io::stderr(), "validation failed in\n{}", messages.join("\n"));
        // SAFETY: always sound; `exit` must not be called again while it runs.
        unsafe { _exit(FAILED) };
    }
}

#[cfg(test)]
mod tests {
    use super::is_of_an_old_layer;

    #[test]
    fn a_structure_that_a_layer_is_too_old_to_know_is_no_mistake_but_a_misplaced_one_is() {
        let chain = "vkCreateDevice: pCreateInfo->pNext chain includes a structure with";
        assert!(is_of_an_old_layer(&format!("{chain} unknown VkStructureType (1000506000)")));
        assert!(is_of_an_old_layer("SPIR-V module not valid: Invalid capability operand: 6022"));
        assert!(!is_of_an_old_layer("SPIR-V module not valid: Invalid capability operand: 1"));
        assert!(!is_of_an_old_layer(&format!(
            "{chain} unexpected VkStructureType VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO"
        )));
    }
}
