//! What a host application lends: handles, functions, and the command buffer of a frame.

use std::ffi::{CStr, c_char, c_void};

/// A device that a host application lends, as raw handles, so that C++ hosts and other Vulkan bindings work.
///
/// The host must have enabled what [`super::require_features`] enables. The instance is of Vulkan 1.1 or later. Where
/// it is not of Vulkan 1.3, the device has the extensions `VK_KHR_synchronization2` and `VK_EXT_subgroup_size_control`;
/// where it is of Vulkan 1.1, also `VK_KHR_timeline_semaphore`, `VK_EXT_scalar_block_layout` and `VK_KHR_spirv_1_4`.
/// The host keeps device, instance and queue alive for as long as the [`Gpu`](super::Gpu) and everything made with it.
/// What is left at its default is not used:
///
/// ```
/// use nightsplat::HostDevice;
///
/// let host = HostDevice { queue_family: 0, is_record_only: true, ..HostDevice::default() };
/// ```
#[derive(Clone, Copy, Debug)]
pub struct HostDevice<'a> {
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
    /// The names of the device extensions that the host enabled; others are not used. With `VK_KHR_push_descriptor`
    /// recording is faster.
    pub extensions: &'a [&'a CStr],
    /// The features that the host enabled: its `VkPhysicalDeviceFeatures2`, or another chain of feature structs; null:
    /// those of [`super::require_features`].
    pub features: *const c_void,
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

impl Default for HostDevice<'_> {
    fn default() -> Self {
        Self {
            get_instance_proc_addr: std::ptr::null(),
            instance: 0,
            physical_device: 0,
            device: 0,
            queue: 0,
            queue_family: 0,
            is_record_only: false,
            extensions: &[],
            features: std::ptr::null(),
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
    /// Takes the lock of a `VkQueue`.
    pub lock: unsafe extern "C" fn(user: *mut c_void, queue: *mut c_void),
    /// Releases it.
    pub unlock: unsafe extern "C" fn(user: *mut c_void, queue: *mut c_void),
    /// Passed to both.
    pub user: *mut c_void,
}

/// A piece of device memory that the host allocated.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct HostAllocation {
    /// The `VkDeviceMemory`.
    pub memory: u64,
    /// Bytes from its start; a multiple of the alignment that was required.
    pub offset: u64,
    /// The address of the first byte where host-visible memory was required; otherwise ignored.
    pub mapped: *mut c_void,
    /// For the host's use.
    pub cookie: *mut c_void,
}

/// What memory has to be: `VkMemoryRequirements`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct HostRequirements {
    /// Bytes.
    pub size: u64,
    /// Bytes that the offset is a multiple of.
    pub alignment: u64,
    /// A bit for each memory type that it may be of.
    pub memory_types: u32,
}

/// The host's allocator of device memory. Any thread may call it.
#[derive(Clone, Copy, Debug)]
pub struct MemoryFunctions {
    /// Fills `out` with memory that has every `required` property (`VkMemoryPropertyFlags`) and, where there is such
    /// memory, every `preferred` one. `name` says what it is for. Returns a `VkResult`.
    pub allocate: unsafe extern "C" fn(
        user: *mut c_void,
        requirements: *const HostRequirements,
        required: u32,
        preferred: u32,
        name: *const c_char,
        out: *mut HostAllocation,
    ) -> i32,
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
