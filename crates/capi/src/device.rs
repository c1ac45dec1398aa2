//! A device that a host lends, or one of our own.

use std::ffi::{CStr, c_char, c_void};

use ash::vk;
pub use ash::vk::{
    Device as VkDevice, DeviceMemory as VkDeviceMemory, DeviceSize as VkDeviceSize,
    Instance as VkInstance, MemoryPropertyFlags as VkMemoryPropertyFlags,
    MemoryRequirements as VkMemoryRequirements, PhysicalDevice as VkPhysicalDevice,
    PipelineCache as VkPipelineCache, Queue as VkQueue, Result as VkResult,
    Semaphore as VkSemaphore,
};
use ash::vk::{Handle as _, TaggedStructure as _};

use super::error::{Failure, NSP_ERROR_DEVICE, NspResult, Object, guard};
use super::structs::{Sized0, destroy, give, object, read, text};
use nightsplat::gpu::{
    DeviceChoice, Gpu, HostAllocation, HostDevice, MemoryFunctions, QueueLock,
    check_physical_device, required_device_features,
};

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

/// A device. Any thread may use it.
#[derive(Debug)]
pub struct NspDevice(pub(super) Object<Gpu>);

/// For tests, which make allocations fail.
#[cfg(debug_assertions)]
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

/// A range of device memory that the host allocated.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspMemory {
    /// The memory object.
    pub memory: VkDeviceMemory,
    /// Bytes from the start of the memory object; a multiple of the required alignment.
    pub offset: VkDeviceSize,
    /// The mapped address of the first byte if host-visible memory is required; ignored otherwise.
    pub mapped: *mut c_void,
    /// For the host's use.
    pub cookie: *mut c_void,
}

/// The host's allocator of device memory. It may be called from any thread.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspMemoryFunctions {
    /// Writes to `out` memory that has all `required` properties and, if there is such memory, all `preferred` ones.
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
    /// Frees memory of `allocate`.
    pub free: Option<unsafe extern "C" fn(user: *mut c_void, memory: *const NspMemory)>,
    /// Passed to both functions.
    pub user: *mut c_void,
}

/// The library submits nothing: uploads are part of the next recording, and training is refused.
pub const NSP_DEVICE_RECORD_ONLY: u32 = 1;
/// The queue is internally synchronized (`VK_KHR_internally_synchronized_queues`): no lock is taken.
pub const NSP_DEVICE_QUEUE_SYNCHRONIZED: u32 = 2;
/// `VK_EXT_debug_utils` is enabled on the instance: objects are named, and passes are labelled.
pub const NSP_DEVICE_NAMES_OBJECTS: u32 = 4;

/// A device that the host lends. It outlives everything that is made with it.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspHostDevice {
    /// `sizeof(NspHostDevice)`.
    pub struct_size: usize,
    /// The function of the host's Vulkan loader.
    pub get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    /// An instance of Vulkan 1.3 or later.
    pub instance: VkInstance,
    /// A physical device of the instance.
    pub physical_device: VkPhysicalDevice,
    /// A device that was created with the features of `nsp_require_features`.
    pub device: VkDevice,
    /// A queue of the family below; NULL with `NSP_DEVICE_RECORD_ONLY`.
    pub queue: VkQueue,
    /// The index of a queue family with compute.
    pub queue_family: u32,
    /// `NSP_DEVICE_*`.
    pub flags: u32,
    /// The names of the enabled device extensions; others are not used.
    pub extensions: *const *const c_char,
    /// The number of extensions.
    pub extension_count: u32,
    /// The enabled features; NULL: those of `nsp_require_features`.
    pub features: *const VkPhysicalDeviceFeatures2,
    /// Locks the queue around each `vkQueueSubmit2`; set both functions, or none.
    pub lock_queue: Option<unsafe extern "C" fn(user: *mut c_void, queue: VkQueue)>,
    /// Unlocks the queue.
    pub unlock_queue: Option<unsafe extern "C" fn(user: *mut c_void, queue: VkQueue)>,
    /// Passed to both functions.
    pub user: *mut c_void,
    /// The host's pipeline cache; `VK_NULL_HANDLE`: one of the library's, which is not saved.
    pub pipeline_cache: VkPipelineCache,
    /// Allocates host memory for the objects that the library creates; NULL: the driver's. It outlives the device.
    pub host_memory: *const VkAllocationCallbacks,
    /// Allocates device memory; NULL: the library allocates blocks of 8 to 256 MiB.
    pub device_memory: *const NspMemoryFunctions,
    /// A timeline semaphore that reaches the number of each frame; `VK_NULL_HANDLE`: the host calls `nsp_frames_done`.
    pub frames: VkSemaphore,
}

// SAFETY: the size comes first; null handles and pointers are zeros.
unsafe impl Sized0 for NspHostDevice {
    const NAME: &'static str = "NspHostDevice";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// Enables the features that the library needs in the structs with which the host creates its device; clears none.
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
    if let Some(features) = vulkan12 {
        features.timeline_semaphore |= needed12.timeline_semaphore;
        features.scalar_block_layout |= needed12.scalar_block_layout;
        features.host_query_reset |= needed12.host_query_reset;
    }
    if let Some(features) = vulkan13 {
        features.synchronization2 |= needed13.synchronization2;
        features.subgroup_size_control |= needed13.subgroup_size_control;
        features.compute_full_subgroups |= needed13.compute_full_subgroups;
    }
}

struct Names([*const c_char; 1]);
// SAFETY: the pointers are to static text.
unsafe impl Sync for Names {}
static OPTIONAL: Names = Names([ash::khr::push_descriptor::NAME.as_ptr()]);

/// The optional device extensions with which recording is faster, and their number.
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

/// Creates a device from one that the host lends. Nothing is submitted.
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
    let Some(functions) = (unsafe { functions.as_ref() }) else { return Ok(None) };
    let (Some(allocate), Some(free)) = (functions.allocate, functions.free) else {
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
    Ok(Some(MemoryFunctions { allocate, free, user: functions.user }))
}

/// Refuses a chain of enabled features without one that is needed.
///
/// # Safety
/// NULL, or a valid chain.
unsafe fn check_features(features: *const VkPhysicalDeviceFeatures2) -> Result<(), Failure> {
    if features.is_null() {
        return Ok(());
    }
    let mut enabled12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut enabled13 = vk::PhysicalDeviceVulkan13Features::default();
    let mut next = features.cast::<vk::BaseInStructure<'_>>();
    // SAFETY: each struct begins with its type, which says what it is, and the next of the chain.
    while let Some(base) = unsafe { next.as_ref() } {
        macro_rules! add {
            ($enabled:ident, $of:ident: $($feature:ident),+) => {
                if base.s_type == vk::$of::STRUCTURE_TYPE {
                    // SAFETY: it is of this type.
                    let features = unsafe { &*next.cast::<vk::$of<'_>>() };
                    $($enabled.$feature |= features.$feature;)+
                }
            };
        }
        add!(enabled12, PhysicalDeviceVulkan12Features:
            timeline_semaphore, scalar_block_layout, host_query_reset);
        add!(enabled12, PhysicalDeviceTimelineSemaphoreFeatures: timeline_semaphore);
        add!(enabled12, PhysicalDeviceScalarBlockLayoutFeatures: scalar_block_layout);
        add!(enabled12, PhysicalDeviceHostQueryResetFeatures: host_query_reset);
        add!(enabled13, PhysicalDeviceVulkan13Features:
            synchronization2, subgroup_size_control, compute_full_subgroups);
        add!(enabled13, PhysicalDeviceSynchronization2Features: synchronization2);
        add!(enabled13, PhysicalDeviceSubgroupSizeControlFeatures:
            subgroup_size_control, compute_full_subgroups);
        next = base.p_next;
    }
    let required = [
        ("timelineSemaphore", enabled12.timeline_semaphore),
        ("scalarBlockLayout", enabled12.scalar_block_layout),
        ("hostQueryReset", enabled12.host_query_reset),
        ("synchronization2", enabled13.synchronization2),
        ("subgroupSizeControl", enabled13.subgroup_size_control),
        ("computeFullSubgroups", enabled13.compute_full_subgroups),
    ];
    match required.iter().find(|(_, enabled)| *enabled == vk::FALSE) {
        Some((name, _)) => Err(Failure::new(
            NSP_ERROR_DEVICE,
            format!(
                "NspHostDevice::features lacks {name}; create the device with nsp_require_features"
            ),
        )),
        None => Ok(()),
    }
}

/// Opens a device of the library's own, for training without a host's. `choice` is a value of `nightsplat --device`;
/// NULL or empty: the best device.
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

/// Reports that all frames up to `frame` are done or were never submitted, and frees what they used. `UINT64_MAX`
/// stands for all frames, also after the device was lost.
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

/// Destroys a device. All frames must be done; nothing is waited for.
///
/// # Safety
/// `device` is NULL or valid, and not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_device_destroy(device: *mut NspDevice) {
    // SAFETY: as the caller promises.
    unsafe { destroy("nsp_device_destroy", device) }
}
