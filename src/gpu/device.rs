//! Opens a device of our own, or takes one that a host application lends.

use std::ffi::{CStr, c_void};
use std::path::PathBuf;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, OnceLock};

use ash::vk::Handle as _;
use ash::{ext, khr, vk};
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};

use super::allocated::MemorySource;
use super::checked::Checks;
use super::choice::SelectedDevice;
use super::cooperative;
use super::descriptors::Descriptors;
use super::device_report::{device_memory, driver_name, report};
#[cfg(debug_assertions)]
use super::faults::Faults;
use super::features::{FeatureStructs, FullSubgroups, check_enabled, require_features};
use super::functions::{CoreVersion, host_device, host_instance};
use super::host::Host;
use super::instance::{
    OwnedInstance, instance, loader_error, physical_devices, validation_is_installed,
    validation_version,
};
use super::limits::max_workgroups;
use super::memory::{BudgetQuery, MemoryUsage};
use super::supported::{OPTIONAL_EXTENSIONS, Supported};
use super::validation::FIRST_SAFE_WITH_LABELS;
use super::vulkan_error;
use super::{
    DeviceChoice, DeviceReport, Gpu, GpuShared, HostDevice, Properties, Queue, SchedulerVariables,
    address_space, reconvergence, statistics, tuning,
};
use crate::{Error, Result};

impl Gpu {
    /// Opens a device that is still to be tested; see [`Gpu::new`].
    pub(crate) fn open(choice: &DeviceChoice) -> Result<Self> {
        Self::open_checked(choice, |_, _| Ok(()))
    }

    /// [`Gpu::open`], if `check` passes the chosen device, which it gets with its index.
    pub(crate) fn open_checked(
        choice: &DeviceChoice,
        check: impl FnOnce(&DeviceReport, usize) -> Result<()>,
    ) -> Result<Self> {
        let validate = cfg!(debug_assertions) && validation_is_installed();
        Self::open_with(choice, validate, true, check)
    }

    /// Opens a device that is still to be tested; see [`Gpu::with_validation`].
    pub(crate) fn open_validated(choice: &DeviceChoice) -> Result<Self> {
        if validation_is_installed() {
            return Self::open_with(choice, true, false, |_, _| Ok(()));
        }
        let package = "on Debian `apt install vulkan-validationlayers`";
        Err(Error::NoDevice(format!("the Vulkan validation layer is not installed: {package}")))
    }

    fn open_with(
        choice: &DeviceChoice,
        validate: bool,
        takes_tuning: bool,
        check: impl FnOnce(&DeviceReport, usize) -> Result<()>,
    ) -> Result<Self> {
        address_space::check()?;
        let mut owned = instance(validate)?;
        let opened = choose(&owned, choice, check).and_then(|(physical, supported)| {
            owned.cache_path = cache_path(&supported);
            if takes_tuning {
                let vk::PhysicalDeviceProperties { vendor_id, device_id, .. } =
                    supported.properties;
                owned.tuning_path = tuning::path(cache_folder(), vendor_id, device_id);
            }
            let OwnedInstance { entry, instance, .. } = &owned;
            let properties = Properties {
                cooperative_matrix: cooperative::supported(entry, instance, physical, &supported),
                has_uniform_subgroup_control_flow: reconvergence::supported(
                    instance, physical, &supported,
                ),
                has_pipeline_statistics: has_pipeline_statistics(&supported),
                ..properties(instance, physical, &supported)?
            };
            create_device(instance, physical, &supported, &properties).map(
                |(device, queue, family)| DeviceParts {
                    physical,
                    properties,
                    modules: ModuleForm::OWN,
                    device,
                    queue,
                    family,
                },
            )
        });
        match opened {
            Ok(parts) => {
                let instance = owned.instance.clone();
                Self::assemble(&instance, parts, Owner::Ours(Box::new(owned)))
            }
            Err(error) => {
                // SAFETY: no device was created from the instance.
                unsafe { owned.destroy() };
                Err(error)
            }
        }
    }

    /// Takes a device that the host application lends. Nothing of the host's is destroyed or changed.
    ///
    /// # Errors
    /// The device lacks a requirement, or a function that is used; `get_instance_proc_addr` is null.
    ///
    /// # Safety
    /// The handles are valid and stay so for as long as the `Gpu` and everything made with it; the required features
    /// and the stated extensions are enabled; without [`HostDevice::queue_lock`] no other thread uses the queue while a
    /// `Gpu` method submits to it; every frame of the host's is done when the `Gpu` and everything made with it is
    /// dropped.
    pub unsafe fn from_host(host: HostDevice<'_>) -> Result<Self> {
        let physical = vk::PhysicalDevice::from_raw(host.physical_device);
        // SAFETY: the host's handles are valid.
        let (instance, device, version) = unsafe {
            let get = loader_function(host.get_instance_proc_addr)?;
            let instance = host_instance(get, vk::Instance::from_raw(host.instance))?;
            let (device, version) = host_device(&instance, vk::Device::from_raw(host.device))?;
            (instance, device, version)
        };
        let supported = Supported::gather(&instance, physical).map_err(loader_error)?;
        supported.check()?;
        let (queue, family) = (vk::Queue::from_raw(host.queue), host.queue_family);
        check_family(&instance, physical, family)?;
        // SAFETY: the host says what it enabled.
        let full_subgroups = unsafe { check_enabled(host.features, version) }?;
        let modules = ModuleForm::of_host(version, full_subgroups, host.extensions)?;
        let mut properties = properties(&instance, physical, &supported)?;
        properties.has_push_descriptors &= host.extensions.contains(&khr::push_descriptor::NAME);
        let parts = DeviceParts { physical, properties, modules, device, queue, family };
        Self::assemble(&instance, parts, Owner::Host(&host))
    }

    /// Whether the device only records, so that nothing can be submitted or read back.
    #[doc(hidden)]
    pub fn is_record_only(&self) -> bool {
        self.shared.host.as_ref().is_some_and(|host| host.is_record_only)
    }

    fn assemble(instance: &ash::Instance, parts: DeviceParts, owner: Owner<'_>) -> Result<Self> {
        #[cfg(debug_assertions)]
        let faults = Faults::from_environment()?;
        let memory = memory_source(instance, &parts, &owner)?;
        let DeviceParts { physical, properties, modules, device, queue, family } = parts;
        // SAFETY: the host says that its callbacks outlive the device.
        let callbacks = unsafe { owner.callbacks() };
        let (timeline, pipeline_cache) =
            timeline_and_cache(&device, &properties.name, &owner, callbacks.as_ref())?;
        let debug = owner.names_objects().then(|| ext::debug_utils::Device::new(instance, &device));
        let has_labels = owner.takes_labels();
        let (owned, host) = match owner {
            Owner::Ours(owned) => (Some(*owned), None),
            Owner::Host(lent) => (None, Some(Host::new(lent))),
        };
        let executables = properties
            .has_pipeline_statistics
            .then(|| khr::pipeline_executable_properties::Device::new(instance, &device));
        Ok(Self {
            shared: Arc::new(GpuShared {
                descriptors: Descriptors::new(instance, &device, properties.has_push_descriptors),
                properties,
                modules,
                labels: debug.clone().filter(|_| has_labels),
                debug,
                executables,
                tuning: OnceLock::new(),
                device,
                memory: Mutex::new(Some(memory)),
                callbacks,
                host,
                family,
                queue: Mutex::new(Queue { raw: queue }),
                progress: Mutex::default(),
                timeline,
                last_submission: AtomicU64::new(0),
                usage: MemoryUsage::default(),
                budget: BudgetQuery::new(instance, physical),
                #[cfg(debug_assertions)]
                faults,
                retired: Mutex::new(vec![]),
                recorded: super::Recorded::default(),
                checks: Checks::default(),
                pipeline_cache,
                pipelines: Mutex::default(),
                owned,
            }),
        })
    }
}

fn check_family(instance: &ash::Instance, physical: vk::PhysicalDevice, family: u32) -> Result<()> {
    // SAFETY: the handle was enumerated from the instance.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    let properties = families.get(family as usize);
    if properties.is_some_and(|family| family.queue_flags.contains(vk::QueueFlags::COMPUTE)) {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "queue_family {family} has no compute; lend a queue of a family that does"
    )))
}

/// Whether a physical device of a host's can be used: the address of `vkGetInstanceProcAddr`, a `VkInstance` and a
/// `VkPhysicalDevice`.
///
/// # Errors
/// A requirement is missing, or a function of the instance.
///
/// # Safety
/// The handles are valid.
pub unsafe fn check_physical_device(
    get_instance_proc_addr: *const c_void,
    instance: u64,
    physical_device: u64,
) -> Result<()> {
    // SAFETY: as the caller promises.
    let instance = unsafe {
        let get = loader_function(get_instance_proc_addr)?;
        host_instance(get, vk::Instance::from_raw(instance))?
    };
    let physical = vk::PhysicalDevice::from_raw(physical_device);
    Supported::gather(&instance, physical).map_err(loader_error)?.check()
}

/// # Safety
/// The address is null or that of `vkGetInstanceProcAddr`.
unsafe fn loader_function(address: *const c_void) -> Result<vk::PFN_vkGetInstanceProcAddr> {
    // SAFETY: as the caller promises; null becomes `None`.
    let function = unsafe {
        std::mem::transmute::<*const c_void, Option<vk::PFN_vkGetInstanceProcAddr>>(address)
    };
    let problem = "get_instance_proc_addr is NULL; pass the host's vkGetInstanceProcAddr";
    function.ok_or_else(|| Error::Usage(problem.to_owned()))
}

/// How kernels are handed to the driver.
#[derive(Clone, Copy, Debug)]
pub(super) struct ModuleForm {
    /// The SPIR-V version that modules declare; `None`: that of the compiler, 1.5.
    pub(super) spirv_version: Option<u32>,
    /// Pipelines have the flag for full subgroups.
    pub(super) has_subgroup_flag: bool,
}

impl ModuleForm {
    const OWN: Self = Self { spirv_version: None, has_subgroup_flag: true };

    fn of_host(
        version: CoreVersion,
        full_subgroups: FullSubgroups,
        extensions: &[&CStr],
    ) -> Result<Self> {
        const SPIRV_1_4: u32 = 0x1_0400;
        const SPIRV_1_6: u32 = 0x1_0600;
        let has_subgroup_flag = full_subgroups == FullSubgroups::ByFlag;
        let spirv_version = match version {
            CoreVersion::V1_1 if extensions.contains(&khr::spirv_1_4::NAME) => Some(SPIRV_1_4),
            CoreVersion::V1_1 => {
                let problem = "an instance of Vulkan 1.1 needs VK_KHR_spirv_1_4 on the device, among the extensions \
                               that are passed; or create the instance with VkApplicationInfo::apiVersion 1.2";
                return Err(Error::NoDevice(problem.to_owned()));
            }
            _ if has_subgroup_flag => None,
            _ => Some(SPIRV_1_6),
        };
        Ok(Self { spirv_version, has_subgroup_flag })
    }
}

/// A device before it is a [`Gpu`].
struct DeviceParts {
    physical: vk::PhysicalDevice,
    properties: Properties,
    modules: ModuleForm,
    device: ash::Device,
    queue: vk::Queue,
    family: u32,
}

/// Who created the device.
enum Owner<'a> {
    Ours(Box<OwnedInstance>),
    Host(&'a HostDevice<'a>),
}

impl Owner<'_> {
    fn names_objects(&self) -> bool {
        match self {
            Self::Ours(owned) => owned.messenger.is_some(),
            Self::Host(lent) => lent.names_objects,
        }
    }

    /// Whether passes are labelled; a host answers for its own layers.
    fn takes_labels(&self) -> bool {
        match self {
            Self::Ours(owned) => validation_version(&owned.entry)
                .is_some_and(|version| version >= FIRST_SAFE_WITH_LABELS),
            Self::Host(lent) => lent.names_objects,
        }
    }

    /// # Safety
    /// The host's callbacks are null, or valid for as long as what is created with them.
    unsafe fn callbacks(&self) -> Option<vk::AllocationCallbacks<'static>> {
        match self {
            Self::Ours(_) => None,
            Self::Host(lent) => {
                let callbacks = lent.host_memory.cast::<vk::AllocationCallbacks<'_>>();
                // SAFETY: as the caller promises.
                unsafe { callbacks.as_ref() }.copied()
            }
        }
    }
}

fn memory_source(
    instance: &ash::Instance,
    parts: &DeviceParts,
    owner: &Owner<'_>,
) -> Result<MemorySource> {
    if let Owner::Host(HostDevice { device_memory: Some(functions), .. }) = owner {
        return Ok(MemorySource::Hosts(*functions));
    }
    let allocator = Allocator::new(&AllocatorCreateDesc {
        instance: instance.clone(),
        device: parts.device.clone(),
        physical_device: parts.physical,
        debug_settings: Default::default(),
        buffer_device_address: false,
        allocation_sizes: super::memory::block_sizes(),
    });
    match allocator {
        Ok(allocator) => Ok(MemorySource::Ours(Box::new(allocator))),
        Err(error) => Err(Error::NoDevice(format!("{}: {error}", parts.properties.name))),
    }
}

/// Our timeline semaphore, and the pipeline cache: the host's, or one of ours that begins with what was saved.
fn timeline_and_cache(
    device: &ash::Device,
    name: &str,
    owner: &Owner<'_>,
    callbacks: Option<&vk::AllocationCallbacks<'_>>,
) -> Result<(vk::Semaphore, vk::PipelineCache)> {
    let fail = |call| move |result| vulkan_error(call, name.to_owned(), result);
    let mut kind =
        vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
    let semaphore = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
    // SAFETY: the device is live.
    let timeline = unsafe { device.create_semaphore(&semaphore, callbacks) }
        .map_err(fail("vkCreateSemaphore"))?;
    let path = match owner {
        Owner::Host(lent) if lent.pipeline_cache != 0 => {
            return Ok((timeline, vk::PipelineCache::from_raw(lent.pipeline_cache)));
        }
        Owner::Host(_) => None,
        Owner::Ours(owned) => owned.cache_path.as_ref(),
    };
    let cached = path.and_then(|path| std::fs::read(path).ok()).unwrap_or_default();
    let cache = vk::PipelineCacheCreateInfo::default().initial_data(&cached);
    // SAFETY: the device is live; a driver ignores cached data that is not its own.
    let cache = unsafe { device.create_pipeline_cache(&cache, callbacks) }.map_err(|result| {
        // SAFETY: just created, and used by nothing.
        unsafe { device.destroy_semaphore(timeline, callbacks) };
        fail("vkCreatePipelineCache")(result)
    })?;
    Ok((timeline, cache))
}

// ---------------------------------------------------------------------------
// Physical device

/// The physical device of a choice, with the variables of schedulers, if `check` passes it.
fn choose(
    owned: &OwnedInstance,
    choice: &DeviceChoice,
    check: impl FnOnce(&DeviceReport, usize) -> Result<()>,
) -> Result<(vk::PhysicalDevice, Supported)> {
    let all = physical_devices(&owned.instance)?;
    let reports =
        all.iter().map(|&physical| report(owned, physical)).collect::<Result<Vec<_>>>()?;
    let SelectedDevice { index, reason, is_doubtful } =
        SchedulerVariables::of_this_process().pick(choice, &reports)?;
    if let Some(reason) = reason {
        let DeviceReport { name, uuid, .. } = &reports[index];
        match is_doubtful {
            true => tracing::warn!("{name}, {uuid}: {reason}"),
            false => tracing::info!("{name}, {uuid}: {reason}"),
        }
    }
    let supported = Supported::gather(&owned.instance, all[index]).map_err(loader_error)?;
    supported.check()?;
    check(&reports[index], index)?;
    Ok((all[index], supported))
}

fn properties(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    supported: &Supported,
) -> Result<Properties> {
    let (driver, driver_id) = driver_name(instance, physical);
    let limits = supported.properties.limits;
    Ok(Properties {
        name: supported.device_name(),
        driver,
        vendor: supported.properties.vendor_id,
        memory: device_memory(instance, physical),
        subgroup_size: supported.lanes()?,
        subgroup_size_is_selectable: supported.subgroups.are_selectable,
        max_storage_buffer_range: u64::from(limits.max_storage_buffer_range)
            .min(supported.max_buffer_size()),
        max_buffer_size: supported.max_buffer_size(),
        max_workgroups: max_workgroups(&limits),
        max_shared_memory: limits.max_compute_shared_memory_size,
        max_loop_iterations: match driver_id {
            vk::DriverId::MESA_LLVMPIPE => LLVMPIPE_LOOP_ITERATIONS,
            _ => u32::MAX,
        },
        timestamp_bits: supported.timestamp_bits,
        timestamp_period: limits.timestamp_period,
        is_cpu: supported.properties.device_type == vk::PhysicalDeviceType::CPU,
        cooperative_matrix: None,
        has_uniform_subgroup_control_flow: false,
        has_push_descriptors: supported.has_push_descriptors(),
        // Its optimiser takes hours for loops over arrays whose sizes are plain constants.
        driver_specializes: driver_id == vk::DriverId::GOOGLE_SWIFTSHADER,
        has_pipeline_statistics: false,
    })
}

/// Mesa's software device ends all loops of an invocation after this number of iterations in total
/// (`LP_MAX_TGSI_LOOP_ITERATIONS`).
const LLVMPIPE_LOOP_ITERATIONS: u32 = 65_535;

fn create_device(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    supported: &Supported,
    properties: &Properties,
) -> Result<(ash::Device, vk::Queue, u32)> {
    let family = supported.compute_family.unwrap_or_default();
    let priorities = [1.0];
    let queues = [vk::DeviceQueueCreateInfo::default()
        .queue_family_index(family)
        .queue_priorities(&priorities)];
    let is_wanted = |name: &&CStr| {
        supported.has(name)
            && (*name != khr::push_descriptor::NAME || supported.has_push_descriptors())
    };
    let optional = OPTIONAL_EXTENSIONS.iter().copied().filter(is_wanted);
    let mut extensions: Vec<_> = optional.map(CStr::as_ptr).collect();
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
    let mut matrices =
        vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
    let mut halves =
        vk::PhysicalDevice16BitStorageFeatures::default().storage_buffer16_bit_access(true);
    let mut info = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
    if properties.cooperative_matrix.is_some() {
        extensions.push(cooperative::EXTENSION.as_ptr());
        // Under the memory model, the atomics of other kernels need its device scope.
        vulkan12 = vulkan12
            .shader_float16(true)
            .vulkan_memory_model(true)
            .vulkan_memory_model_device_scope(true);
        info = info.push_next(&mut matrices).push_next(&mut halves);
    }
    let mut uniform = vk::PhysicalDeviceShaderSubgroupUniformControlFlowFeaturesKHR::default()
        .shader_subgroup_uniform_control_flow(true);
    if properties.has_uniform_subgroup_control_flow {
        extensions.push(reconvergence::EXTENSION.as_ptr());
        info = info.push_next(&mut uniform);
    }
    let mut executables = vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default()
        .pipeline_executable_info(true);
    if properties.has_pipeline_statistics {
        extensions.push(statistics::EXTENSION.as_ptr());
        info = info.push_next(&mut executables);
    }
    let mut info =
        info.enabled_extension_names(&extensions).push_next(&mut vulkan12).push_next(&mut vulkan13);
    let mut structs = FeatureStructs::default();
    let device = supported.device_name();
    // SAFETY: `info` points at live locals; the requirements were checked.
    unsafe {
        require_features((&raw mut info).cast(), &mut structs, &[]);
        let device = instance
            .create_device(physical, &info, None)
            .map_err(|result| vulkan_error("vkCreateDevice", device, result))?;
        let queue = device.get_device_queue(family, 0);
        Ok((device, queue, family))
    }
}

/// The pipeline cache: one file per device and driver, in the user's cache folder.
fn cache_path(supported: &Supported) -> Option<PathBuf> {
    let p = &supported.properties;
    let name = format!("{:x}-{:x}-{:x}.pipelines", p.vendor_id, p.device_id, p.driver_version);
    Some(cache_folder()?.join(name))
}

/// Our folder in the user's cache folder.
pub(crate) fn cache_folder() -> Option<PathBuf> {
    let folder = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")))?;
    Some(folder.join("nightsplat"))
}

/// A device that has the extension has its one feature.
fn has_pipeline_statistics(supported: &Supported) -> bool {
    supported.has(statistics::EXTENSION)
}
