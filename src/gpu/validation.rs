//! The validation layer's messages, collected so that a test can fail on them.

use std::ffi::{CStr, c_void};
use std::sync::Mutex;

use ash::vk;

/// The Khronos layer that checks every call, and here every hazard.
pub(super) const LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// Messages of one instance; its address is the messenger's user data.
pub(super) type Messages = Mutex<Vec<String>>;

/// A messenger that pushes warnings and errors to `messages`, which must outlive the instance.
pub(super) fn messenger(messages: &Messages) -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(
            vk::DebugUtilsMessageSeverityFlagsEXT::ERROR
                | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
        )
        .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
        .pfn_user_callback(Some(on_message))
        .user_data(std::ptr::from_ref(messages).cast_mut().cast())
}

unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    messages: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the loader passes valid callback data with a NUL-terminated message, and our own user data.
    let (message, messages) = unsafe {
        (CStr::from_ptr((*data).p_message).to_string_lossy(), &*messages.cast::<Messages>())
    };
    tracing::error!(target: "vulkan", "{message}");
    super::lock(messages).push(message.into_owned());
    vk::FALSE
}
