//! Opens a device of our own, or takes one that a host application lends.

use std::ffi::{CStr, c_void};
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, OnceLock};

use ash::vk::Handle as _;
use ash::{ext, khr, vk};
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};

use super::checked::Checks;
use super::cooperative::{self, CooperativeMatrix};
use super::faults::Faults;
use super::memory::{BudgetQuery, MemoryUsage};
use super::requirements::{EXTENSIONS, Offered, required_device_features};
use super::{
    Gpu, Properties, Queue, REQUIREMENTS, Shared, address_space, statistics, tuning, validation,
};
use crate::{Error, Result};

/// What to install where there is no Vulkan; the same words for a missing loader and a missing driver.
const INSTALL: &str = "install a Vulkan driver, or the software device: on Debian \
     `apt install libvulkan1 mesa-vulkan-drivers`";

/// Which device to use.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The first that meets all requirements: discrete before integrated, virtual, and software devices.
    #[default]
    Best,
    /// By position in [`devices`].
    Index(usize),
    /// By a part of the name, in any case of letters.
    Name(String),
}

impl FromStr for DeviceChoice {
    type Err = Error;

    /// A number is an index, an empty text the best device, anything else a part of the name.
    fn from_str(text: &str) -> Result<Self> {
        Ok(match text.parse() {
            Ok(index) => Self::Index(index),
            Err(_) if text.is_empty() => Self::Best,
            Err(_) => Self::Name(text.to_owned()),
        })
    }
}

/// One device and how it meets the requirements, for `doctor`.
#[derive(Clone, Debug, serde::Serialize)]
pub struct DeviceReport {
    /// The device's name.
    pub name: String,
    /// discrete, integrated, virtual, software or other.
    pub kind: &'static str,
    /// Vulkan version.
    pub api_version: String,
    /// Lanes of a subgroup.
    pub subgroup_size: u32,
    /// Bytes of device-local memory.
    pub memory: u64,
    /// The matrices that `--denoiser-precision half` builds on, where the device offers any.
    pub cooperative_matrix: Option<CooperativeMatrix>,
    /// Every requirement, in the order of [`REQUIREMENTS`].
    pub requirements: Vec<RequirementReport>,
}

/// One requirement and whether a device meets it.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct RequirementReport {
    /// The Vulkan name of the feature, extension or limit.
    pub name: &'static str,
    /// What it is needed for.
    pub why: &'static str,
    /// Whether the device meets it.
    pub met: bool,
}

impl DeviceReport {
    /// The first requirement that the device does not meet, by its name.
    pub fn missing(&self) -> Option<&'static str> {
        self.requirements.iter().find(|requirement| !requirement.met).map(|missing| missing.name)
    }
}

/// A device that a host application lends, as raw handles, so that C++ hosts and other Vulkan bindings work.
///
/// The host must have enabled [`required_device_features`] and `VK_KHR_push_descriptor` on the device, and keeps device,
/// instance and queue alive for as long as the [`Gpu`] and everything made with it.
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
    /// `VkQueue` of the family below, with compute.
    pub queue: u64,
    /// Its family's index.
    pub queue_family: u32,
}

/// What we created around a device of our own.
pub(super) struct Owned {
    instance: ash::Instance,
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    cache_path: Option<PathBuf>,
    /// Where the fastest tiles are kept.
    pub(super) tuning_path: Option<PathBuf>,
    /// Last, because the instance's functions live in the library.
    entry: ash::Entry,
}

impl Owned {
    pub(super) fn save_pipeline_cache(&self, device: &ash::Device, cache: vk::PipelineCache) {
        let Some(path) = &self.cache_path else { return };
        // SAFETY: the cache is live. A cache that cannot be kept costs time, never correctness.
        if let Ok(data) = unsafe { device.get_pipeline_cache_data(cache) } {
            let saved = path.parent().map_or(Ok(()), std::fs::create_dir_all).and_then(|()| {
                let partial = path.with_extension(format!("{}.partial", std::process::id()));
                std::fs::write(&partial, data)?;
                std::fs::rename(partial, path)
            });
            if let Err(error) = saved {
                tracing::debug!("{}: {error}", path.display());
            }
        }
    }

    /// # Safety
    /// The device is gone; called once.
    pub(super) unsafe fn destroy(&self) {
        // SAFETY: as the caller promises.
        unsafe {
            if let Some((functions, messenger)) = &self.messenger {
                functions.destroy_debug_utils_messenger(*messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}

/// Every Vulkan device of this machine, the best first, whether it meets the requirements or not.
///
/// # Errors
/// There is no Vulkan loader, or no device at all.
pub fn devices() -> Result<Vec<DeviceReport>> {
    let owned = instance(false)?;
    let reports = physical_devices(&owned.instance)
        .and_then(|all| all.into_iter().map(|physical| report(&owned, physical)).collect());
    // SAFETY: no device was created from the instance.
    unsafe { owned.destroy() };
    reports
}

impl Gpu {
    /// Opens a device. Debug builds turn on validation where the layer is installed.
    ///
    /// # Errors
    /// No loader, no such device, or one that lacks a requirement.
    ///
    /// ```no_run
    /// use nightsplat::gpu::{DeviceChoice, Gpu};
    ///
    /// let gpu = Gpu::new(&DeviceChoice::Best)?;
    /// let squares = gpu.buffer("squares", &[0u32, 1, 4, 9])?;
    /// assert_eq!(gpu.read(&squares)?, [0, 1, 4, 9]);
    /// # Ok::<(), nightsplat::Error>(())
    /// ```
    pub fn new(choice: &DeviceChoice) -> Result<Self> {
        let validate = cfg!(debug_assertions) && validation_is_installed();
        Self::open(choice, validate, true)
    }

    /// Opens a device with validation and synchronization validation; its tiles are the built-in ones.
    ///
    /// # Errors
    /// As [`Gpu::new`], or the validation layer is not installed.
    pub fn with_validation(choice: &DeviceChoice) -> Result<Self> {
        if validation_is_installed() {
            return Self::open(choice, true, false);
        }
        let package = "on Debian `apt install vulkan-validationlayers`";
        Err(Error::NoDevice(format!("the Vulkan validation layer is not installed: {package}")))
    }

    fn open(choice: &DeviceChoice, validate: bool, takes_tuning: bool) -> Result<Self> {
        address_space::check()?;
        let mut owned = instance(validate)?;
        let opened = choose(&owned.instance, choice).and_then(|(physical, offered)| {
            owned.cache_path = cache_path(&offered);
            if takes_tuning {
                let vk::PhysicalDeviceProperties { vendor_id, device_id, .. } = offered.properties;
                owned.tuning_path = tuning::path(cache_folder(), vendor_id, device_id);
            }
            let matrix = cooperative::offered(&owned.entry, &owned.instance, physical, &offered);
            create_device(&owned.instance, physical, &offered, matrix.is_some()).map(
                |(device, queue)| {
                    let mut properties = properties(&owned.instance, physical, &offered);
                    properties.cooperative_matrix = matrix;
                    properties.tells_statistics = tells_statistics(&offered);
                    (physical, properties, device, queue)
                },
            )
        });
        match opened {
            Ok((physical, properties, device, queue)) => {
                let instance = owned.instance.clone();
                Self::assemble(&instance, physical, properties, device, queue, Some(owned))
            }
            Err(error) => {
                // SAFETY: no device was created from the instance.
                unsafe { owned.destroy() };
                Err(error)
            }
        }
    }

    /// Takes a device that the host application lends. Nothing of the host's is destroyed, changed or printed to.
    ///
    /// # Errors
    /// The device lacks a requirement, or `get_instance_proc_addr` is null.
    ///
    /// # Safety
    /// The handles are valid and stay so for as long as the `Gpu` and everything made with it; the required features
    /// and extensions are enabled; no other thread uses the queue while a `Gpu` method submits to it.
    pub unsafe fn from_host(host: HostDevice) -> Result<Self> {
        // SAFETY: the caller says that the address is this function's; null becomes `None`.
        let get_instance_proc_addr = unsafe {
            std::mem::transmute::<*const c_void, Option<vk::PFN_vkGetInstanceProcAddr>>(
                host.get_instance_proc_addr,
            )
        };
        let Some(get_instance_proc_addr) = get_instance_proc_addr else {
            let problem = "HostDevice::get_instance_proc_addr is null: pass the host's";
            return Err(Error::Usage(problem.to_owned()));
        };
        let static_fn = ash::StaticFn { get_instance_proc_addr };
        let physical = vk::PhysicalDevice::from_raw(host.physical_device);
        // SAFETY: the host's handles are valid.
        let (instance, device) = unsafe {
            let instance = ash::Instance::load(&static_fn, vk::Instance::from_raw(host.instance));
            let device = ash::Device::load(instance.fp_v1_0(), vk::Device::from_raw(host.device));
            (instance, device)
        };
        let offered = Offered::gather(&instance, physical).map_err(loader_error)?;
        offered.check()?;
        let queue = Queue { raw: vk::Queue::from_raw(host.queue), family: host.queue_family };
        let properties = properties(&instance, physical, &offered);
        Self::assemble(&instance, physical, properties, device, queue, None)
    }

    fn assemble(
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        properties: Properties,
        device: ash::Device,
        queue: Queue,
        owned: Option<Owned>,
    ) -> Result<Self> {
        let faults = Faults::from_environment()?;
        let name = properties.name.clone();
        let fail = |call| move |result| Error::Vulkan { call, device: name.clone(), result };
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.clone(),
            device: device.clone(),
            physical_device: physical,
            debug_settings: Default::default(),
            buffer_device_address: false,
            allocation_sizes: super::memory::block_sizes(),
        })
        .map_err(|error| Error::NoDevice(format!("{}: {error}", properties.name)))?;
        let mut kind =
            vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
        let semaphore = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        let path = owned.as_ref().and_then(|owned| owned.cache_path.as_ref());
        let cached = path.and_then(|path| std::fs::read(path).ok()).unwrap_or_default();
        let cache = vk::PipelineCacheCreateInfo::default().initial_data(&cached);
        // SAFETY: the device is live; a driver ignores cached data that is not its own.
        let (timeline, pipeline_cache) = unsafe {
            let timeline = device
                .create_semaphore(&semaphore, None)
                .map_err(fail.clone()("vkCreateSemaphore"))?;
            let cache = device
                .create_pipeline_cache(&cache, None)
                .map_err(fail("vkCreatePipelineCache"))?;
            (timeline, cache)
        };
        let debug = owned.as_ref().and_then(|owned| owned.messenger.as_ref());
        let debug = debug.map(|_| ext::debug_utils::Device::new(instance, &device));
        let executables = properties
            .tells_statistics
            .then(|| khr::pipeline_executable_properties::Device::new(instance, &device));
        Ok(Self {
            shared: Arc::new(Shared {
                properties,
                push_descriptor: khr::push_descriptor::Device::new(instance, &device),
                debug,
                executables,
                tuned_tiles: OnceLock::new(),
                device,
                allocator: Mutex::new(Some(allocator)),
                queue: Mutex::new(queue),
                progress: Mutex::default(),
                timeline,
                last_use: AtomicU64::new(0),
                usage: MemoryUsage::default(),
                budget: BudgetQuery::of(instance, physical),
                faults,
                retired: Mutex::new(vec![]),
                recorded: super::recorder::Recorded::default(),
                checks: Checks::default(),
                pipeline_cache,
                owned,
            }),
        })
    }
}

// ---------------------------------------------------------------------------
// Instance

fn loader_error(result: vk::Result) -> Error {
    match result {
        // The loader's words for no driver at all.
        vk::Result::ERROR_INCOMPATIBLE_DRIVER => no_device(),
        _ => Error::NoDevice(format!("Vulkan did not start ({result}): {INSTALL}")),
    }
}

fn no_device() -> Error {
    Error::NoDevice(format!("there is no Vulkan device: {INSTALL}"))
}

fn entry() -> Result<ash::Entry> {
    // SAFETY: loading the system's Vulkan loader runs its initialisation, as every Vulkan program does.
    unsafe { ash::Entry::load() }
        .map_err(|error| Error::NoDevice(format!("there is no Vulkan loader ({error}): {INSTALL}")))
}

fn validation_is_installed() -> bool {
    let layers = entry().and_then(|entry| {
        // SAFETY: no preconditions.
        unsafe { entry.enumerate_instance_layer_properties() }.map_err(loader_error)
    });
    layers.is_ok_and(|layers| {
        layers.iter().any(|layer| layer.layer_name_as_c_str() == Ok(validation::LAYER))
    })
}

fn instance(validate: bool) -> Result<Owned> {
    let entry = entry()?;
    let app = vk::ApplicationInfo::default()
        .application_name(c"nightsplat")
        .api_version(vk::API_VERSION_1_3);
    let layers = [validation::LAYER.as_ptr()];
    let extensions = [ext::debug_utils::NAME.as_ptr(), ext::validation_features::NAME.as_ptr()];
    let checks = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&checks);
    let messenger_info = validation::messenger();
    let mut early = messenger_info;
    let mut info = vk::InstanceCreateInfo::default().application_info(&app);
    if validate {
        info = info
            .enabled_layer_names(&layers)
            .enabled_extension_names(&extensions)
            .push_next(&mut features)
            .push_next(&mut early);
    }
    // SAFETY: `info` points at live locals.
    unsafe {
        let instance = entry.create_instance(&info, None).map_err(loader_error)?;
        let messenger = validate
            .then(|| {
                let functions = ext::debug_utils::Instance::new(&entry, &instance);
                let messenger = functions.create_debug_utils_messenger(&messenger_info, None)?;
                Ok((functions, messenger))
            })
            .transpose()
            .map_err(loader_error)?;
        Ok(Owned { instance, messenger, cache_path: None, tuning_path: None, entry })
    }
}

// ---------------------------------------------------------------------------
// Physical device

/// All devices, the most capable kind first; the driver's order within a kind.
fn physical_devices(instance: &ash::Instance) -> Result<Vec<vk::PhysicalDevice>> {
    // SAFETY: the instance is live.
    let mut all = unsafe { instance.enumerate_physical_devices() }.map_err(loader_error)?;
    if all.is_empty() {
        return Err(no_device());
    }
    all.sort_by_key(|&physical| {
        // SAFETY: the handle was just enumerated.
        let kind = unsafe { instance.get_physical_device_properties(physical) }.device_type;
        match kind {
            vk::PhysicalDeviceType::DISCRETE_GPU => 0,
            vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
            vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
            vk::PhysicalDeviceType::CPU => 3,
            _ => 4,
        }
    });
    Ok(all)
}

fn choose(
    instance: &ash::Instance,
    choice: &DeviceChoice,
) -> Result<(vk::PhysicalDevice, Offered)> {
    let offers = physical_devices(instance)?
        .into_iter()
        .map(|physical| Ok((physical, Offered::gather(instance, physical).map_err(loader_error)?)))
        .collect::<Result<Vec<_>>>()?;
    let names: Vec<_> = offers.iter().map(|(_, o)| o.device_name()).collect();
    let index = match choice {
        // Where none meets all requirements, the first is named with what it lacks.
        DeviceChoice::Best => {
            Some(offers.iter().position(|(_, o)| o.missing().is_none()).unwrap_or(0))
        }
        DeviceChoice::Index(index) => Some(*index).filter(|&index| index < offers.len()),
        DeviceChoice::Name(part) => {
            let part = part.to_lowercase();
            names.iter().position(|name| name.to_lowercase().contains(&part))
        }
    };
    let chosen = index.and_then(|index| offers.into_iter().nth(index));
    let Some((physical, offered)) = chosen else {
        let wanted = match choice {
            DeviceChoice::Name(name) => format!("called `{name}`"),
            DeviceChoice::Index(index) => format!("number {index}"),
            DeviceChoice::Best => String::new(),
        };
        let names = names.join(", ");
        return Err(Error::NoDevice(format!(
            "there is no Vulkan device {wanted}; there are: {names}"
        )));
    };
    offered.check()?;
    Ok((physical, offered))
}

fn report(
    Owned { instance, entry, .. }: &Owned,
    physical: vk::PhysicalDevice,
) -> Result<DeviceReport> {
    let offered = Offered::gather(instance, physical).map_err(loader_error)?;
    let version = offered.properties.api_version;
    let (major, minor, patch) = (
        vk::api_version_major(version),
        vk::api_version_minor(version),
        vk::api_version_patch(version),
    );
    Ok(DeviceReport {
        name: offered.device_name(),
        kind: match offered.properties.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => "discrete",
            vk::PhysicalDeviceType::INTEGRATED_GPU => "integrated",
            vk::PhysicalDeviceType::VIRTUAL_GPU => "virtual",
            vk::PhysicalDeviceType::CPU => "software",
            _ => "other",
        },
        api_version: format!("{major}.{minor}.{patch}"),
        subgroup_size: offered.subgroup_size,
        memory: device_memory(instance, physical),
        cooperative_matrix: cooperative::offered(entry, instance, physical, &offered),
        requirements: REQUIREMENTS
            .iter()
            .map(|r| RequirementReport { name: r.name, why: r.why, met: r.met_by(&offered) })
            .collect(),
    })
}

/// Bytes of device-local memory.
fn device_memory(instance: &ash::Instance, physical: vk::PhysicalDevice) -> u64 {
    // SAFETY: the handle was enumerated from the instance.
    let memory = unsafe { instance.get_physical_device_memory_properties(physical) };
    let heaps = memory.memory_heaps_as_slice().iter();
    let local = heaps.filter(|heap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
    local.map(|heap| heap.size).sum()
}

fn properties(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    offered: &Offered,
) -> Properties {
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut driver);
    // SAFETY: the chain points at a live local.
    unsafe { instance.get_physical_device_properties2(physical, &mut properties) };
    let limits = offered.properties.limits;
    let text =
        |text: Result<&CStr, _>| text.map(|t| t.to_string_lossy().into_owned()).unwrap_or_default();
    Properties {
        name: offered.device_name(),
        driver: format!(
            "{} {}",
            text(driver.driver_name_as_c_str()),
            text(driver.driver_info_as_c_str())
        ),
        memory: device_memory(instance, physical),
        subgroup_size: offered.subgroup_size,
        subgroup_size_is_selectable: offered
            .required_subgroup_size_stages
            .contains(vk::ShaderStageFlags::COMPUTE),
        max_storage_buffer_range: u64::from(limits.max_storage_buffer_range),
        max_workgroups: limits.max_compute_work_group_count[0]
            .min(limits.max_compute_work_group_count[1]),
        max_loop_iterations: match driver.driver_id {
            vk::DriverId::MESA_LLVMPIPE => LLVMPIPE_LOOP_ITERATIONS,
            _ => u32::MAX,
        },
        timestamp_bits: offered.timestamp_bits,
        timestamp_period: limits.timestamp_period,
        is_cpu: offered.properties.device_type == vk::PhysicalDeviceType::CPU,
        cooperative_matrix: None,
        tells_statistics: false,
    }
}

/// Mesa's software device ends all loops of an invocation after so many turns in total (`LP_MAX_TGSI_LOOP_ITERATIONS`).
const LLVMPIPE_LOOP_ITERATIONS: u32 = 65_535;

fn create_device(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    offered: &Offered,
    with_cooperative_matrices: bool,
) -> Result<(ash::Device, Queue)> {
    let family = offered.compute_family.unwrap_or_default();
    let priorities = [1.0];
    let queues = [vk::DeviceQueueCreateInfo::default()
        .queue_family_index(family)
        .queue_priorities(&priorities)];
    let mut extensions: Vec<_> = EXTENSIONS.iter().map(|name| name.as_ptr()).collect();
    let (mut vulkan12, mut vulkan13) = required_device_features();
    let mut matrices =
        vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default().cooperative_matrix(true);
    let mut info = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
    if with_cooperative_matrices {
        extensions.push(cooperative::EXTENSION.as_ptr());
        // Under the memory model, the atomics of other kernels need its device scope.
        vulkan12 = vulkan12
            .shader_float16(true)
            .vulkan_memory_model(true)
            .vulkan_memory_model_device_scope(true);
        info = info.push_next(&mut matrices);
    }
    let mut executables = vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default()
        .pipeline_executable_info(true);
    if tells_statistics(offered) {
        extensions.push(statistics::EXTENSION.as_ptr());
        info = info.push_next(&mut executables);
    }
    let info =
        info.enabled_extension_names(&extensions).push_next(&mut vulkan12).push_next(&mut vulkan13);
    let device = offered.device_name();
    // SAFETY: `info` points at live locals; the requirements were checked.
    unsafe {
        let device = instance
            .create_device(physical, &info, None)
            .map_err(|result| Error::Vulkan { call: "vkCreateDevice", device, result })?;
        let raw = device.get_device_queue(family, 0);
        Ok((device, Queue { raw, family }))
    }
}

/// One file per device and driver, in the user's cache folder.
fn cache_path(offered: &Offered) -> Option<PathBuf> {
    let p = &offered.properties;
    let name = format!("{:x}-{:x}-{:x}.pipelines", p.vendor_id, p.device_id, p.driver_version);
    Some(cache_folder()?.join(name))
}

/// Ours in the user's.
fn cache_folder() -> Option<PathBuf> {
    let folder = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")))?;
    Some(folder.join("nightsplat"))
}

/// A device that has the extension has its one feature.
fn tells_statistics(offered: &Offered) -> bool {
    offered.extensions.contains(statistics::EXTENSION.to_string_lossy().as_ref())
}
