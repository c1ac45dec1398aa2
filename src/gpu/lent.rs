//! What a host application lends: handles, functions, and the command buffer of a frame.

use std::ffi::{c_char, c_void};

use ash::vk;

/// A device that a host application lends, as raw handles, so that C++ hosts and other Vulkan bindings work.
///
/// The host must have enabled [`super::required_device_features`] on the device. It should enable
/// `VK_KHR_push_descriptor` where that is supported, which makes recording faster. It keeps device, instance and queue
/// alive for as long as the [`Gpu`](super::Gpu) and everything made with it. What is left at its default is not used:
///
/// ```
/// use nightsplat::HostDevice;
///
/// let host = HostDevice { queue_family: 0, is_record_only: true, ..HostDevice::default() };
/// ```
#[derive(Clone, Copy, Debug)]
pub struct HostDevice {
    /// The address of `vkGetInstanceProcAddr` of the host's loader.
    pub get_instance_proc_addr: *const c_void,
    /// `VkInstance`.
    pub instance: u64,
    /// `VkPhysicalDevice`.
    pub physical_device: u64,
    /// `VkDevice`.
    pub device: u64,
    /// `VkQueue` of the family below, with compute; null where the device only records.
    pub queue: u64,
    /// Its family's index.
    pub queue_family: u32,
    /// Nothing is submitted: uploads are part of the next recording, and a call that would submit is an error.
    pub is_record_only: bool,
    /// The host enabled `VK_KHR_push_descriptor`; without it descriptors are bound in sets.
    pub has_push_descriptors: bool,
    /// The host enabled `VK_EXT_debug_utils` on the instance: objects are named, passes are labelled.
    pub names_objects: bool,
    /// Held around each of our submissions. `None`: no other thread uses the queue meanwhile.
    pub queue_lock: Option<QueueLock>,
    /// A timeline `VkSemaphore` that reaches the number of each frame; null: the host calls
    /// [`Gpu::frames_done`](super::Gpu::frames_done).
    pub frames: u64,
    /// The host's `VkPipelineCache`; null: one of ours that is not saved.
    pub pipeline_cache: u64,
    /// `VkAllocationCallbacks` for the objects that we create; null: the driver's. Outlives the device.
    pub host_memory: *const c_void,
    /// Allocates device memory. `None`: we allocate blocks of 8 to 256 MiB ourselves.
    pub device_memory: Option<MemoryFunctions>,
}

impl Default for HostDevice {
    fn default() -> Self {
        Self {
            get_instance_proc_addr: std::ptr::null(),
            instance: 0,
            physical_device: 0,
            device: 0,
            queue: 0,
            queue_family: 0,
            is_record_only: false,
            has_push_descriptors: true,
            names_objects: false,
            queue_lock: None,
            frames: 0,
            pipeline_cache: 0,
            host_memory: std::ptr::null(),
            device_memory: None,
        }
    }
}

/// The host's lock on its queue. Any thread may call it; it is held for `vkQueueSubmit2` alone, never while we wait,
/// allocate, record or call back.
#[derive(Clone, Copy, Debug)]
pub struct QueueLock {
    /// Takes the lock.
    pub lock: unsafe extern "C" fn(user: *mut c_void, queue: vk::Queue),
    /// Releases it.
    pub unlock: unsafe extern "C" fn(user: *mut c_void, queue: vk::Queue),
    /// Passed to both.
    pub user: *mut c_void,
}

/// A piece of device memory that the host allocated.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct HostAllocation {
    /// The `VkDeviceMemory`.
    pub memory: vk::DeviceMemory,
    /// Bytes from its start; a multiple of the alignment that was required.
    pub offset: vk::DeviceSize,
    /// The address of the first byte where host-visible memory was required; otherwise ignored.
    pub mapped: *mut c_void,
    /// For the host's use.
    pub cookie: *mut c_void,
}

/// The host's allocator of device memory. Any thread may call it.
#[derive(Clone, Copy, Debug)]
pub struct MemoryFunctions {
    /// Fills `out` with memory that has every `required` property and, where there is such memory, every `preferred`
    /// one. `name` says what it is for.
    pub allocate: unsafe extern "C" fn(
        user: *mut c_void,
        requirements: *const vk::MemoryRequirements,
        required: vk::MemoryPropertyFlags,
        preferred: vk::MemoryPropertyFlags,
        name: *const c_char,
        out: *mut HostAllocation,
    ) -> vk::Result,
    /// Frees memory of `allocate`.
    pub free: unsafe extern "C" fn(user: *mut c_void, allocation: *const HostAllocation),
    /// Passed to both.
    pub user: *mut c_void,
}

/// A command buffer of the host's that we record into.
#[derive(Clone, Copy, Debug)]
pub struct HostFrame {
    /// The primary `VkCommandBuffer`, recording on the lent family, outside a render pass.
    pub commands: u64,
    /// The number that the host's timeline reaches once this command buffer is done; it never falls.
    pub number: u64,
    /// `VkPipelineStageFlags2` of the host's own commands that read our buffers, before in the queue or later; 0 where
    /// it reads images alone.
    pub readers: u64,
}
