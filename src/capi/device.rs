//! A device that a host lends, or one of our own.

use std::ffi::{CStr, c_char, c_void};

use ash::vk;
use ash::vk::Handle as _;

use super::error::{Failure, NSP_ERROR_DEVICE, NspResult, Object, guard};
use super::structs::{Sized0, destroy, give, object, read, text};
use crate::gpu::{
    DeviceChoice, Gpu, HostAllocation, HostDevice, MemoryFunctions, QueueLock,
    check_physical_device, required_device_features,
};

/// Vulkan's.
pub type VkInstance = vk::Instance;
/// Vulkan's.
pub type VkPhysicalDevice = vk::PhysicalDevice;
/// Vulkan's.
pub type VkDevice = vk::Device;
/// Vulkan's.
pub type VkQueue = vk::Queue;
/// Vulkan's.
pub type VkPipelineCache = vk::PipelineCache;
/// Vulkan's.
pub type VkSemaphore = vk::Semaphore;
/// Vulkan's.
pub type VkDeviceMemory = vk::DeviceMemory;
/// Vulkan's.
pub type VkDeviceSize = vk::DeviceSize;
/// Vulkan's.
pub type VkMemoryRequirements = vk::MemoryRequirements;
/// Vulkan's.
pub type VkMemoryPropertyFlags = vk::MemoryPropertyFlags;
/// Vulkan's.
pub type VkAllocationCallbacks = vk::AllocationCallbacks<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceFeatures2 = vk::PhysicalDeviceFeatures2<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceVulkan12Features = vk::PhysicalDeviceVulkan12Features<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceVulkan13Features = vk::PhysicalDeviceVulkan13Features<'static>;
#[allow(non_camel_case_types, reason = "Vulkan's own name")]
/// Vulkan's.
pub type PFN_vkGetInstanceProcAddr = Option<vk::PFN_vkGetInstanceProcAddr>;
/// Vulkan's.
pub type VkResult = vk::Result;

/// A device and what belongs to it. Any thread may use it.
#[derive(Debug)]
pub struct NspDevice(pub(super) Object<Gpu>);

/// For tests, which make allocations fail.
#[cfg(feature = "testing")]
impl NspDevice {
    /// The device.
    ///
    /// # Panics
    /// It was left by a panic.
    pub fn gpu(&self) -> Gpu {
        match self.0.get("the device") {
            Ok(gpu) => gpu.clone(),
            Err(failure) => unreachable!("{failure:?}"),
        }
    }
}

/// A piece of device memory of the host's.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspMemory {
    /// The block that it is part of.
    pub memory: VkDeviceMemory,
    /// From the start of the block; a multiple of the required alignment.
    pub offset: VkDeviceSize,
    /// The address of its first byte where host-visible memory is required; ignored otherwise.
    pub mapped: *mut c_void,
    /// The host's own.
    pub cookie: *mut c_void,
}

/// The host's allocator of device memory. It may be called from any thread.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspMemoryFunctions {
    /// Fills `out` with memory that has every `required` property and, where there is such, every `preferred` one.
    pub allocate: Option<
        unsafe extern "C" fn(
            user: *mut c_void,
            requirements: *const VkMemoryRequirements,
            required: VkMemoryPropertyFlags,
            preferred: VkMemoryPropertyFlags,
            name: *const c_char,
            out: *mut NspMemory,
        ) -> VkResult,
    >,
    /// Frees what `allocate` gave.
    pub free: Option<unsafe extern "C" fn(user: *mut c_void, memory: *const NspMemory)>,
    /// Passed to both.
    pub user: *mut c_void,
}

/// The queue is never touched: uploads are part of the next recording, and training is refused.
pub const NSP_DEVICE_RECORD_ONLY: u32 = 1;
/// The queue is internally synchronized (`VK_KHR_internally_synchronized_queues`): no lock is taken.
pub const NSP_DEVICE_QUEUE_SYNCHRONIZED: u32 = 2;
/// `VK_EXT_debug_utils` is enabled on the instance: objects are named, passes are labelled.
pub const NSP_DEVICE_NAMES_OBJECTS: u32 = 4;

/// A device that the host lends. It outlives everything that is made with it.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspHostDevice {
    /// `sizeof(NspHostDevice)`.
    pub struct_size: usize,
    /// Of the host's loader.
    pub get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    /// Of Vulkan 1.3 or later.
    pub instance: VkInstance,
    /// One of the instance's.
    pub physical_device: VkPhysicalDevice,
    /// Created with the features of `nsp_require_features`.
    pub device: VkDevice,
    /// Of the family below; NULL where the device only records.
    pub queue: VkQueue,
    /// A family with compute.
    pub queue_family: u32,
    /// `NSP_DEVICE_*`.
    pub flags: u32,
    /// Enabled device extensions; what is not listed is not used.
    pub extensions: *const *const c_char,
    /// Their number.
    pub extension_count: u32,
    /// Enabled features; NULL: those of `nsp_require_features`.
    pub features: *const VkPhysicalDeviceFeatures2,
    /// Held around `vkQueueSubmit2` alone. Both or none.
    pub lock_queue: Option<unsafe extern "C" fn(user: *mut c_void, queue: VkQueue)>,
    /// Releases the lock.
    pub unlock_queue: Option<unsafe extern "C" fn(user: *mut c_void, queue: VkQueue)>,
    /// Passed to both.
    pub user: *mut c_void,
    /// The host's; `VK_NULL_HANDLE`: one of ours that is not saved.
    pub pipeline_cache: VkPipelineCache,
    /// For the objects that we create; NULL: the driver's. It outlives the device.
    pub host_memory: *const VkAllocationCallbacks,
    /// NULL: blocks of 8 to 256 MiB of our own.
    pub device_memory: *const NspMemoryFunctions,
    /// A timeline that reaches the number of each frame; `VK_NULL_HANDLE`: the host calls `nsp_frames_done`.
    pub frames: VkSemaphore,
}

// SAFETY: the size comes first; null handles and pointers are zeros.
unsafe impl Sized0 for NspHostDevice {
    const NAME: &'static str = "NspHostDevice";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// Sets the features that the library needs in the structs with which the host creates its device; clears none.
///
/// # Safety
/// Each is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_require_features(
    vulkan12: *mut VkPhysicalDeviceVulkan12Features,
    vulkan13: *mut VkPhysicalDeviceVulkan13Features,
) {
    let (needed12, needed13) = required_device_features();
    // SAFETY: as the caller promises.
    let (vulkan12, vulkan13) = unsafe { (vulkan12.as_mut(), vulkan13.as_mut()) };
    if let Some(own) = vulkan12 {
        own.timeline_semaphore |= needed12.timeline_semaphore;
        own.scalar_block_layout |= needed12.scalar_block_layout;
        own.host_query_reset |= needed12.host_query_reset;
    }
    if let Some(own) = vulkan13 {
        own.synchronization2 |= needed13.synchronization2;
        own.subgroup_size_control |= needed13.subgroup_size_control;
        own.compute_full_subgroups |= needed13.compute_full_subgroups;
    }
}

struct Names([*const c_char; 1]);
// SAFETY: the pointers are to static text.
unsafe impl Sync for Names {}
static OPTIONAL: Names = Names([ash::khr::push_descriptor::NAME.as_ptr()]);

/// The device extensions that make recording faster where the host enables them, and their number.
///
/// # Safety
/// `count` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_device_extensions(count: *mut u32) -> *const *const c_char {
    // SAFETY: as the caller promises.
    if let Some(count) = unsafe { count.as_mut() } {
        *count = OPTIONAL.0.len() as u32;
    }
    OPTIONAL.0.as_ptr()
}

/// Whether the library can use a physical device; the error names what is missing.
///
/// # Safety
/// The handles are valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_check_device(
    get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    instance: VkInstance,
    physical_device: VkPhysicalDevice,
) -> NspResult {
    guard("nsp_check_device", || {
        let function = get_instance_proc_addr
            .ok_or_else(|| Failure::usage("get_instance_proc_addr is NULL"))?;
        not_null("instance", instance)?;
        not_null("physical_device", physical_device)?;
        // SAFETY: as the caller promises.
        Ok(unsafe { check_physical_device(function, instance, physical_device) }?)
    })
}

fn not_null<H: vk::Handle + Copy>(name: &str, handle: H) -> Result<H, Failure> {
    match handle.as_raw() {
        0 => Err(Failure::usage(format!("{name} is NULL"))),
        _ => Ok(handle),
    }
}

/// Takes a device that the host lends. It submits nothing.
///
/// # Safety
/// `host` says the truth, and everything it names outlives what is made with the device.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_device_from_host(
    host: *const NspHostDevice,
    device: *mut *mut NspDevice,
) -> NspResult {
    guard("nsp_device_from_host", || {
        // SAFETY: as the caller promises.
        unsafe {
            give(device, "device", || {
                let lent = lent(&read(host)?)?;
                Ok(NspDevice(Object::new(Gpu::from_host(lent)?)))
            })
        }
    })
}

/// # Safety
/// `host` says the truth.
unsafe fn lent(host: &NspHostDevice) -> Result<HostDevice, Failure> {
    let member = |name: &str| format!("NspHostDevice::{name}");
    let get_instance_proc_addr = host
        .get_instance_proc_addr
        .ok_or_else(|| Failure::usage(format!("{} is NULL", member("get_instance_proc_addr"))))?;
    not_null(&member("instance"), host.instance)?;
    not_null(&member("physical_device"), host.physical_device)?;
    not_null(&member("device"), host.device)?;
    let is_record_only = host.flags & NSP_DEVICE_RECORD_ONLY != 0;
    if !is_record_only {
        not_null(&member("queue"), host.queue)?;
    }
    let queue_lock = match (host.lock_queue, host.unlock_queue) {
        (Some(lock), Some(unlock)) => Some(QueueLock { lock, unlock, user: host.user }),
        (None, None) => None,
        _ => {
            let text =
                "only one of NspHostDevice::lock_queue and unlock_queue is set; set both or none";
            return Err(Failure::usage(text));
        }
    };
    let is_synchronized = host.flags & NSP_DEVICE_QUEUE_SYNCHRONIZED != 0;
    // SAFETY: as the caller promises.
    let (extensions, device_memory) = unsafe {
        check_features(host.features)?;
        (extensions(host)?, memory_functions(host.device_memory)?)
    };
    Ok(HostDevice {
        get_instance_proc_addr: get_instance_proc_addr as *const c_void,
        instance: host.instance.as_raw(),
        physical_device: host.physical_device.as_raw(),
        device: host.device.as_raw(),
        queue: host.queue.as_raw(),
        queue_family: host.queue_family,
        is_record_only,
        has_push_descriptors: extensions.contains(&ash::khr::push_descriptor::NAME),
        names_objects: host.flags & NSP_DEVICE_NAMES_OBJECTS != 0,
        queue_lock: queue_lock.filter(|_| !is_synchronized),
        frames: host.frames.as_raw(),
        pipeline_cache: host.pipeline_cache.as_raw(),
        host_memory: host.host_memory.cast(),
        device_memory,
    })
}

/// # Safety
/// The array is as long as its count says.
unsafe fn extensions<'a>(host: &NspHostDevice) -> Result<Vec<&'a CStr>, Failure> {
    let count = host.extension_count as usize;
    if count == 0 {
        return Ok(vec![]);
    }
    if host.extensions.is_null() {
        return Err(Failure::usage("NspHostDevice::extensions is NULL, its count is not 0"));
    }
    // SAFETY: as the caller promises.
    unsafe {
        let names = std::slice::from_raw_parts(host.extensions, count);
        if names.iter().any(|name| name.is_null()) {
            return Err(Failure::usage("NspHostDevice::extensions has a NULL"));
        }
        Ok(names.iter().map(|name| CStr::from_ptr(*name)).collect())
    }
}

type AllocateOfC = unsafe extern "C" fn(
    *mut c_void,
    *const VkMemoryRequirements,
    VkMemoryPropertyFlags,
    VkMemoryPropertyFlags,
    *const c_char,
    *mut NspMemory,
) -> VkResult;
type Allocate = unsafe extern "C" fn(
    *mut c_void,
    *const vk::MemoryRequirements,
    vk::MemoryPropertyFlags,
    vk::MemoryPropertyFlags,
    *const c_char,
    *mut HostAllocation,
) -> vk::Result;
type FreeOfC = unsafe extern "C" fn(*mut c_void, *const NspMemory);
type Free = unsafe extern "C" fn(*mut c_void, *const HostAllocation);

/// # Safety
/// NULL or valid.
unsafe fn memory_functions(
    functions: *const NspMemoryFunctions,
) -> Result<Option<MemoryFunctions>, Failure> {
    // SAFETY: as the caller promises.
    let Some(own) = (unsafe { functions.as_ref() }) else { return Ok(None) };
    let (Some(allocate), Some(free)) = (own.allocate, own.free) else {
        let text = "NspHostDevice::device_memory needs both allocate and free";
        return Err(Failure::usage(text));
    };
    // SAFETY: `NspMemory` and `HostAllocation` have the same members in the same order.
    let (allocate, free) = unsafe {
        (
            std::mem::transmute::<AllocateOfC, Allocate>(allocate),
            std::mem::transmute::<FreeOfC, Free>(free),
        )
    };
    Ok(Some(MemoryFunctions { allocate, free, user: own.user }))
}

/// Refuses a chain of enabled features without one that is needed.
///
/// # Safety
/// NULL, or a valid chain.
unsafe fn check_features(features: *const VkPhysicalDeviceFeatures2) -> Result<(), Failure> {
    if features.is_null() {
        return Ok(());
    }
    let mut enabled = [false; 6];
    const NAMES: [&str; 6] = [
        "timelineSemaphore",
        "scalarBlockLayout",
        "hostQueryReset",
        "synchronization2",
        "subgroupSizeControl",
        "computeFullSubgroups",
    ];
    let mut add = |at: usize, value: vk::Bool32| enabled[at] |= value != vk::FALSE;
    let mut next = features.cast::<vk::BaseInStructure<'_>>();
    // SAFETY: each struct begins with its type, which says what it is, and the next of the chain.
    while let Some(base) = unsafe { next.as_ref() } {
        // SAFETY: as above.
        unsafe {
            match base.s_type {
                vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_2_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceVulkan12Features<'_>>();
                    add(0, own.timeline_semaphore);
                    add(1, own.scalar_block_layout);
                    add(2, own.host_query_reset);
                }
                vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_3_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceVulkan13Features<'_>>();
                    add(3, own.synchronization2);
                    add(4, own.subgroup_size_control);
                    add(5, own.compute_full_subgroups);
                }
                vk::StructureType::PHYSICAL_DEVICE_TIMELINE_SEMAPHORE_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceTimelineSemaphoreFeatures<'_>>();
                    add(0, own.timeline_semaphore);
                }
                vk::StructureType::PHYSICAL_DEVICE_SCALAR_BLOCK_LAYOUT_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceScalarBlockLayoutFeatures<'_>>();
                    add(1, own.scalar_block_layout);
                }
                vk::StructureType::PHYSICAL_DEVICE_HOST_QUERY_RESET_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceHostQueryResetFeatures<'_>>();
                    add(2, own.host_query_reset);
                }
                vk::StructureType::PHYSICAL_DEVICE_SYNCHRONIZATION_2_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceSynchronization2Features<'_>>();
                    add(3, own.synchronization2);
                }
                vk::StructureType::PHYSICAL_DEVICE_SUBGROUP_SIZE_CONTROL_FEATURES => {
                    let own = &*next.cast::<vk::PhysicalDeviceSubgroupSizeControlFeatures<'_>>();
                    add(4, own.subgroup_size_control);
                    add(5, own.compute_full_subgroups);
                }
                _ => (),
            }
        }
        next = base.p_next;
    }
    match NAMES.iter().zip(enabled).find(|(_, is_enabled)| !is_enabled) {
        Some((name, _)) => Err(Failure::new(
            NSP_ERROR_DEVICE,
            format!(
                "NspHostDevice::features lacks {name}; create the device with nsp_require_features"
            ),
        )),
        None => Ok(()),
    }
}

/// Opens a device of our own, for training without a host's: `choice` is what `nightsplat --device` takes, NULL or
/// empty for the best.
///
/// # Safety
/// `choice` is NULL or ends with NUL; `device` is valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_device_open(
    choice: *const c_char,
    device: *mut *mut NspDevice,
) -> NspResult {
    guard("nsp_device_open", || {
        // SAFETY: as the caller promises.
        unsafe {
            give(device, "device", || {
                let choice = if choice.is_null() { "" } else { text(choice, "choice")? };
                let choice: DeviceChoice = choice.parse().map_err(Failure::from)?;
                Ok(NspDevice(Object::new(Gpu::new(&choice)?)))
            })
        }
    })
}

/// Tells that the host's device is done with all frames up to `frame`, or that those left were never submitted, and
/// frees what they used. `UINT64_MAX`: all there ever were, also after the host lost its device.
///
/// # Safety
/// `device` is NULL or valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_frames_done(device: *mut NspDevice, frame: u64) -> NspResult {
    guard("nsp_frames_done", || {
        // SAFETY: as the caller promises.
        let device = unsafe { object(device, "device")? };
        device.0.get("the device")?.frames_done(frame);
        Ok(())
    })
}

/// Destroys a device. Every frame is done by then; it waits for none.
///
/// # Safety
/// `device` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_device_destroy(device: *mut NspDevice) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_device_destroy", device) }
}
