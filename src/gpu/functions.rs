//! The Vulkan functions of a host, each tested for null, under the names of its Vulkan version.

use std::collections::BTreeSet;
use std::ffi::{CStr, CString, c_void};

use ash::vk;

use crate::{Error, Result};

/// The functions of an instance that the library calls.
const INSTANCE_FUNCTIONS: &[&CStr] = &[
    c"vkEnumerateDeviceExtensionProperties",
    c"vkGetDeviceProcAddr",
    c"vkGetPhysicalDeviceFeatures2",
    c"vkGetPhysicalDeviceMemoryProperties",
    c"vkGetPhysicalDeviceMemoryProperties2",
    c"vkGetPhysicalDeviceProperties",
    c"vkGetPhysicalDeviceProperties2",
    c"vkGetPhysicalDeviceQueueFamilyProperties",
];

/// The functions of a device that the library and its allocator call.
const DEVICE_FUNCTIONS: &[&CStr] = &[
    c"vkAllocateCommandBuffers",
    c"vkAllocateDescriptorSets",
    c"vkAllocateMemory",
    c"vkBeginCommandBuffer",
    c"vkBindBufferMemory",
    c"vkCmdBindDescriptorSets",
    c"vkCmdBindPipeline",
    c"vkCmdCopyBuffer",
    c"vkCmdCopyBufferToImage",
    c"vkCmdCopyImageToBuffer",
    c"vkCmdDispatch",
    c"vkCmdFillBuffer",
    c"vkCmdPipelineBarrier2",
    c"vkCmdPushConstants",
    c"vkCmdResetQueryPool",
    c"vkCmdUpdateBuffer",
    c"vkCmdWriteTimestamp2",
    c"vkCreateBuffer",
    c"vkCreateCommandPool",
    c"vkCreateComputePipelines",
    c"vkCreateDescriptorPool",
    c"vkCreateDescriptorSetLayout",
    c"vkCreatePipelineCache",
    c"vkCreatePipelineLayout",
    c"vkCreateQueryPool",
    c"vkCreateSemaphore",
    c"vkCreateShaderModule",
    c"vkDestroyBuffer",
    c"vkDestroyCommandPool",
    c"vkDestroyDescriptorPool",
    c"vkDestroyDescriptorSetLayout",
    c"vkDestroyPipeline",
    c"vkDestroyPipelineCache",
    c"vkDestroyPipelineLayout",
    c"vkDestroyQueryPool",
    c"vkDestroySemaphore",
    c"vkDestroyShaderModule",
    c"vkEndCommandBuffer",
    c"vkFreeMemory",
    c"vkGetBufferMemoryRequirements",
    c"vkGetPipelineCacheData",
    c"vkGetQueryPoolResults",
    c"vkGetSemaphoreCounterValue",
    c"vkMapMemory",
    c"vkQueueSubmit2",
    c"vkUnmapMemory",
    c"vkUpdateDescriptorSets",
    c"vkWaitSemaphores",
];

/// The Vulkan version whose functions a host's device has under their core names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum CoreVersion {
    V1_1,
    V1_2,
    V1_3,
}

/// The functions of a host's instance.
///
/// # Errors
/// One is missing.
///
/// # Safety
/// The function and the handle belong together.
pub(super) unsafe fn host_instance(
    get: vk::PFN_vkGetInstanceProcAddr,
    handle: vk::Instance,
) -> Result<ash::Instance> {
    let mut missing = BTreeSet::new();
    let find = |name: &CStr| {
        // SAFETY: as the caller promises; the name ends with NUL.
        let found = unsafe { get(handle, name.as_ptr()) };
        address(name, found, &mut missing)
    };
    // SAFETY: each address is null, in place of which a function that panics is loaded, or the function of this name.
    let instance = unsafe { ash::Instance::load_with(find, handle) };
    match first_of(INSTANCE_FUNCTIONS, &missing) {
        None => Ok(instance),
        Some(name) => Err(Error::NoDevice(format!(
            "get_instance_proc_addr does not know {name}; pass that of the loader which made the instance, whose \
             VkApplicationInfo::apiVersion is VK_API_VERSION_1_1 or later"
        ))),
    }
}

/// The functions of a host's device, under their names of an extension where the core ones are missing.
///
/// # Errors
/// One is missing under both names.
///
/// # Safety
/// The handle is a device of the instance.
pub(super) unsafe fn host_device(
    instance: &ash::Instance,
    handle: vk::Device,
) -> Result<(ash::Device, CoreVersion)> {
    let (mut missing, mut by_extension) = (BTreeSet::new(), BTreeSet::new());
    let get = instance.fp_v1_0().get_device_proc_addr;
    let find = |name: &CStr| {
        // SAFETY: as the caller promises; the names end with NUL.
        let found = unsafe { get(handle, name.as_ptr()) };
        if found.is_some() {
            return address(name, found, &mut missing);
        }
        by_extension.insert(name.to_owned());
        let alias = CString::new([name.to_bytes(), b"KHR"].concat()).unwrap_or_default();
        // SAFETY: as above.
        address(name, unsafe { get(handle, alias.as_ptr()) }, &mut missing)
    };
    // SAFETY: as in `host_instance`; functions of the same name but for the extension's letters are the same.
    let device = unsafe { ash::Device::load_with(find, handle) };
    if let Some(name) = first_of(DEVICE_FUNCTIONS, &missing) {
        return Err(Error::NoDevice(format!("the device has no {name}; {}", remedy(&name))));
    }
    let version = if by_extension.contains(c"vkGetSemaphoreCounterValue") {
        CoreVersion::V1_1
    } else if by_extension.contains(c"vkCmdPipelineBarrier2") {
        CoreVersion::V1_2
    } else {
        CoreVersion::V1_3
    };
    Ok((device, version))
}

fn address(
    name: &CStr,
    found: vk::PFN_vkVoidFunction,
    missing: &mut BTreeSet<CString>,
) -> *const c_void {
    if found.is_none() {
        missing.insert(name.to_owned());
    }
    found.map_or(std::ptr::null(), |function| function as *const c_void)
}

fn first_of(needed: &[&CStr], missing: &BTreeSet<CString>) -> Option<String> {
    let first = needed.iter().find(|name| missing.contains(**name));
    first.map(|name| name.to_string_lossy().into_owned())
}

fn remedy(function: &str) -> String {
    let (version, extension) = match function {
        "vkGetSemaphoreCounterValue" | "vkWaitSemaphores" => ("1_2", "VK_KHR_timeline_semaphore"),
        "vkCmdPipelineBarrier2" | "vkCmdWriteTimestamp2" | "vkQueueSubmit2" => {
            ("1_3", "VK_KHR_synchronization2")
        }
        _ => return "pass the device of the instance".to_owned(),
    };
    format!(
        "create the instance with VkApplicationInfo::apiVersion VK_API_VERSION_{version}, or enable {extension} on the \
         device"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    unsafe extern "system" fn knows_nothing(
        _: vk::Instance,
        _: *const std::ffi::c_char,
    ) -> vk::PFN_vkVoidFunction {
        None
    }

    #[test]
    fn a_loader_that_knows_nothing_is_refused() {
        // SAFETY: nothing is called.
        let instance = unsafe { host_instance(knows_nothing, vk::Instance::null()) };
        let message = instance.err().map(|error| error.to_string()).unwrap();
        assert!(message.contains("vkEnumerateDeviceExtensionProperties"), "{message}");
        assert!(message.contains("VK_API_VERSION_1_1"), "{message}");
    }

    /// The code of this folder, without spaces.
    fn source() -> String {
        let source = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
        let folder = std::fs::read_dir(source.join("gpu")).unwrap();
        let files = folder.map(|entry| entry.unwrap().path()).chain([source.join("gpu.rs")]);
        let code: String = files.map(|path| std::fs::read_to_string(path).unwrap()).collect();
        code.split_whitespace().collect()
    }

    fn listed() -> BTreeSet<String> {
        let all = DEVICE_FUNCTIONS.iter().chain(INSTANCE_FUNCTIONS);
        all.map(|name| snake(name.to_str().unwrap())).collect()
    }

    #[test]
    fn every_function_that_is_called_is_tested_for_null() {
        const VERBS: &str = "allocate begin bind cmd create destroy end enumerate free get map queue reset unmap \
                             update wait";
        // Of devices and instances of our own alone.
        const NEVER_LENT: &str = "create_device destroy_device destroy_instance enumerate_physical_devices \
                                  get_device_queue";
        let (code, listed) = (source(), listed());
        let called = ["device.", "instance."].iter().flat_map(|object| code.split(object).skip(1));
        let is_unlisted = |name: &&str| {
            let verb = name.split('_').next().unwrap_or_default();
            let is_exempt = NEVER_LENT.split_whitespace().any(|exempt| exempt == *name);
            VERBS.split_whitespace().any(|known| known == verb)
                && !listed.contains(*name)
                && !is_exempt
        };
        let names = called.filter_map(|rest| Some(rest.split_once('(')?.0));
        assert_eq!(names.filter(is_unlisted).collect::<BTreeSet<_>>(), BTreeSet::new());
    }

    #[test]
    fn every_function_that_is_tested_is_called() {
        let code = source();
        let of_the_allocator = ["allocate_memory", "free_memory", "map_memory", "unmap_memory"];
        let is_unused = |name: &String| {
            let is_called = [format!(".{name}("), format!(".{name})(")];
            !of_the_allocator.contains(&&**name)
                && !is_called.iter().any(|call| code.contains(call))
        };
        assert_eq!(
            listed().into_iter().filter(is_unused).collect::<Vec<_>>(),
            Vec::<String>::new()
        );
    }

    /// `vkCmdPipelineBarrier2` as `ash` spells it.
    fn snake(name: &str) -> String {
        let mut snake = String::new();
        for c in name.trim_start_matches("vk").chars() {
            if c.is_ascii_uppercase() && !snake.is_empty() {
                snake.push('_');
            }
            snake.push(c.to_ascii_lowercase());
        }
        snake
    }
}
