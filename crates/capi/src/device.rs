//! A device that a host lends, or one of our own.

use std::ffi::{CStr, c_char, c_void};

use ash::vk;
use ash::vk::Handle as _;
pub use ash::vk::{
    CommandBuffer as VkCommandBuffer, Device as VkDevice, DeviceMemory as VkDeviceMemory,
    DeviceSize as VkDeviceSize, Instance as VkInstance,
    MemoryPropertyFlags as VkMemoryPropertyFlags, MemoryRequirements as VkMemoryRequirements,
    PhysicalDevice as VkPhysicalDevice, PipelineCache as VkPipelineCache, Queue as VkQueue,
    Result as VkResult, Semaphore as VkSemaphore,
};

use super::error::{Failure, NSP_ERROR_VERSION, NspResult, Object, guard};
use super::structs::{Sized0, destroy, give, object, read, text};
use nightsplat::gpu::{
    DeviceChoice, FeatureStructs, Gpu, HostAllocation, HostDevice, HostFrame, HostRequirements,
    MemoryFunctions, QueueLock, check_physical_device, require_features,
};

/// Vulkan's.
pub type VkAllocationCallbacks = vk::AllocationCallbacks<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceFeatures2 = vk::PhysicalDeviceFeatures2<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceTimelineSemaphoreFeatures =
    vk::PhysicalDeviceTimelineSemaphoreFeatures<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceScalarBlockLayoutFeatures =
    vk::PhysicalDeviceScalarBlockLayoutFeatures<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceSynchronization2Features =
    vk::PhysicalDeviceSynchronization2Features<'static>;
/// Vulkan's.
pub type VkPhysicalDeviceSubgroupSizeControlFeatures =
    vk::PhysicalDeviceSubgroupSizeControlFeatures<'static>;
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

/// The host's allocator of device memory. It may be called from any thread, and must not throw.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspMemoryFunctions {
    /// `sizeof(NspMemoryFunctions)`.
    pub struct_size: usize,
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

// SAFETY: the size comes first; null functions are zeros.
unsafe impl Sized0 for NspMemoryFunctions {
    const NAME: &'static str = "NspMemoryFunctions";
    const FIRST_SIZE: usize = size_of::<Self>();
}

/// The library submits nothing: uploads are part of the next recording, and training is refused.
pub const NSP_DEVICE_RECORD_ONLY: u32 = 1;
/// The queue is internally synchronized (`VK_KHR_internally_synchronized_queues`): no lock is taken.
pub const NSP_DEVICE_QUEUE_SYNCHRONIZED: u32 = 2;
/// `VK_EXT_debug_utils` is enabled on the instance: objects are named, and passes are labelled.
pub const NSP_DEVICE_NAMES_OBJECTS: u32 = 4;

const FLAGS: u32 =
    NSP_DEVICE_RECORD_ONLY | NSP_DEVICE_QUEUE_SYNCHRONIZED | NSP_DEVICE_NAMES_OBJECTS;

/// A device that the host lends. It outlives everything that is made with it.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct NspHostDevice {
    /// `sizeof(NspHostDevice)`.
    pub struct_size: usize,
    /// The function of the host's Vulkan loader.
    pub get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
    /// An instance of Vulkan 1.1 or later. Below 1.3, the device has `VK_KHR_synchronization2` and
    /// `VK_EXT_subgroup_size_control`; at 1.1, also `VK_KHR_timeline_semaphore`, `VK_EXT_scalar_block_layout` and
    /// `VK_KHR_spirv_1_4`.
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
    /// The enabled features, with what is chained to it; NULL: those of `nsp_require_features`.
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

/// The structs that `nsp_require_features` chains where the host has none. They stay where they are until the device is
/// created.
#[repr(C)]
#[derive(Debug)]
pub struct NspFeatureStructs {
    /// `sizeof(NspFeatureStructs)`.
    pub struct_size: usize,
    /// Chained by the library, as all below.
    pub timeline_semaphore: VkPhysicalDeviceTimelineSemaphoreFeatures,
    /// Chained by the library.
    pub scalar_block_layout: VkPhysicalDeviceScalarBlockLayoutFeatures,
    /// Chained by the library.
    pub synchronization2: VkPhysicalDeviceSynchronization2Features,
    /// Chained by the library.
    pub subgroup_size_control: VkPhysicalDeviceSubgroupSizeControlFeatures,
}

/// Enables the features that the library needs in the chain with which the host creates its device. `chain` is the
/// host's `VkDeviceCreateInfo` or `VkPhysicalDeviceFeatures2`. Each feature is enabled in the struct of the chain that
/// has it, of a Vulkan version or of an extension; for the others, structs of `structs` are appended.
///
/// # Safety
/// `chain` is NULL or a valid chain; `structs` is NULL or valid, and outlives the chain.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_require_features(
    chain: *mut c_void,
    structs: *mut NspFeatureStructs,
) -> NspResult {
    guard("nsp_require_features", || {
        if chain.is_null() {
            return Err(Failure::usage("chain is NULL; pass the VkDeviceCreateInfo"));
        }
        // SAFETY: as the caller promises; the members after the size are those of `FeatureStructs`.
        unsafe {
            object(structs, "structs")?;
            if (*structs).struct_size < size_of::<NspFeatureStructs>() {
                let text = "NspFeatureStructs::struct_size is too small; set it to its sizeof";
                return Err(Failure::new(NSP_ERROR_VERSION, text));
            }
            let first = (&raw mut (*structs).timeline_semaphore).cast::<FeatureStructs>();
            first.write(FeatureStructs::default());
            require_features(chain, &mut *first, &[]);
        }
        Ok(())
    })
}

const _: () = {
    let members = std::mem::offset_of!(NspFeatureStructs, timeline_semaphore);
    assert!(size_of::<FeatureStructs>() == size_of::<NspFeatureStructs>() - members);
};

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
        let function = address(get_instance_proc_addr);
        let instance = not_null("instance", instance)?.as_raw();
        let physical_device = not_null("physical_device", physical_device)?.as_raw();
        // SAFETY: as the caller promises.
        Ok(unsafe { check_physical_device(function, instance, physical_device) }?)
    })
}

fn address(function: PFN_vkGetInstanceProcAddr) -> *const c_void {
    function.map_or(std::ptr::null(), |function| function as *const c_void)
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
                let host = read(host)?;
                let extensions = extensions(&host)?;
                let lent = lent(&host, &extensions)?;
                Ok(NspDevice(Object::new(Gpu::from_host(lent)?)))
            })
        }
    })
}

/// # Safety
/// `host` says the truth.
unsafe fn lent<'a>(
    host: &NspHostDevice,
    extensions: &'a [&'a CStr],
) -> Result<HostDevice<'a>, Failure> {
    let member = |name: &str| format!("NspHostDevice::{name}");
    if host.get_instance_proc_addr.is_none() {
        return Err(Failure::usage(format!("{} is NULL", member("get_instance_proc_addr"))));
    }
    not_null(&member("instance"), host.instance)?;
    not_null(&member("physical_device"), host.physical_device)?;
    not_null(&member("device"), host.device)?;
    if host.flags & !FLAGS != 0 {
        let flags = host.flags & !FLAGS;
        return Err(Failure::usage(format!(
            "NspHostDevice::flags has the unknown bits {flags:#x}"
        )));
    }
    let is_record_only = host.flags & NSP_DEVICE_RECORD_ONLY != 0;
    if !is_record_only {
        not_null(&member("queue"), host.queue)?;
    }
    let queue_lock = match (host.lock_queue, host.unlock_queue) {
        (Some(lock), Some(unlock)) => {
            // SAFETY: a queue is a pointer, under both of its names.
            let [lock, unlock] = [lock, unlock].map(|function| unsafe {
                std::mem::transmute::<
                    unsafe extern "C" fn(*mut c_void, VkQueue),
                    unsafe extern "C" fn(*mut c_void, *mut c_void),
                >(function)
            });
            Some(QueueLock { lock, unlock, user: host.user })
        }
        (None, None) => None,
        _ => {
            let text =
                "only one of NspHostDevice::lock_queue and unlock_queue is set; set both or none";
            return Err(Failure::usage(text));
        }
    };
    let is_synchronized = host.flags & NSP_DEVICE_QUEUE_SYNCHRONIZED != 0;
    Ok(HostDevice {
        get_instance_proc_addr: address(host.get_instance_proc_addr),
        instance: host.instance.as_raw(),
        physical_device: host.physical_device.as_raw(),
        device: host.device.as_raw(),
        queue: host.queue.as_raw(),
        queue_family: host.queue_family,
        is_record_only,
        extensions,
        features: host.features.cast(),
        names_objects: host.flags & NSP_DEVICE_NAMES_OBJECTS != 0,
        queue_lock: queue_lock.filter(|_| !is_synchronized),
        frames: host.frames.as_raw(),
        pipeline_cache: host.pipeline_cache.as_raw(),
        host_memory: host.host_memory.cast(),
        // SAFETY: as the caller promises.
        device_memory: unsafe { memory_functions(host.device_memory) }?,
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
    *const HostRequirements,
    u32,
    u32,
    *const c_char,
    *mut HostAllocation,
) -> i32;
type FreeOfC = unsafe extern "C" fn(*mut c_void, *const NspMemory);
type Free = unsafe extern "C" fn(*mut c_void, *const HostAllocation);

/// # Safety
/// NULL or valid.
unsafe fn memory_functions(
    functions: *const NspMemoryFunctions,
) -> Result<Option<MemoryFunctions>, Failure> {
    if functions.is_null() {
        return Ok(None);
    }
    // SAFETY: as the caller promises.
    let functions = unsafe { read(functions) }?;
    let (Some(allocate), Some(free)) = (functions.allocate, functions.free) else {
        let text = "NspHostDevice::device_memory needs both allocate and free";
        return Err(Failure::usage(text));
    };
    // SAFETY: `NspMemory` and `HostAllocation`, `VkMemoryRequirements` and `HostRequirements` have the same members in
    // the same order; flags and results are 32-bit numbers.
    let (allocate, free) = unsafe {
        (
            std::mem::transmute::<AllocateOfC, Allocate>(allocate),
            std::mem::transmute::<FreeOfC, Free>(free),
        )
    };
    Ok(Some(MemoryFunctions { allocate, free, user: functions.user }))
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

/// Records the uploads that wait, and nothing else, so that a loading screen or a transfer needs no picture. `commands`
/// and `frame` are as in `NspRender`.
///
/// # Safety
/// `device` is NULL or valid; `commands` is recording on the lent queue family, outside a render pass.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nsp_record_uploads(
    device: *mut NspDevice,
    commands: VkCommandBuffer,
    frame: u64,
) -> NspResult {
    guard("nsp_record_uploads", || {
        // SAFETY: as the caller promises.
        let gpu = unsafe { object(device, "device") }?.0.get("the device")?;
        let commands = not_null("commands", commands)?.as_raw();
        // SAFETY: as the caller promises.
        unsafe { gpu.record_into(&HostFrame { commands, number: frame, readers: 0 }, |_| Ok(())) }?;
        Ok(())
    })
}

/// Reports that all frames up to `frame` are done or were never submitted, and frees what they used. Uploads of a
/// recording that was never submitted are part of the next one. `UINT64_MAX`
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
