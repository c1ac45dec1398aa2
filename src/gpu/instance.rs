//! The Vulkan loader, our instance, and the physical devices that it lists.

use std::ffi::CStr;
use std::path::PathBuf;

use ash::{ext, khr, vk};

use super::{address_space, validation};
use crate::{Error, Result};

/// What to install where Vulkan is missing, loader or driver.
const INSTALL: &str = "install a Vulkan driver, or the software device: on Debian \
     `apt install libvulkan1 mesa-vulkan-drivers`";

/// What we created around a device of our own.
pub(super) struct OwnedInstance {
    pub(super) instance: ash::Instance,
    pub(super) messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    /// Where compiled pipelines are kept.
    pub(super) cache_path: Option<PathBuf>,
    /// Where the fastest tiles are kept.
    pub(super) tuning_path: Option<PathBuf>,
    /// Last, because the instance's functions live in the library.
    pub(super) entry: ash::Entry,
}

impl OwnedInstance {
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

pub(super) fn loader_error(result: vk::Result) -> Error {
    // What has no memory to start says nothing else.
    if let Err(limit) = address_space::check() {
        return limit;
    }
    match result {
        // The loader's answer where there is no driver.
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

pub(super) fn validation_is_installed() -> bool {
    entry().is_ok_and(|entry| validation_version(&entry).is_some())
}

/// The version of Vulkan that the validation layer is built for; `None` where it is not installed.
pub(super) fn validation_version(entry: &ash::Entry) -> Option<u32> {
    // SAFETY: no preconditions.
    let layers = unsafe { entry.enumerate_instance_layer_properties() }.ok()?;
    let layer = layers.iter().find(|layer| layer.layer_name_as_c_str() == Ok(validation::LAYER));
    layer.map(|layer| layer.spec_version)
}

fn instance_has(entry: &ash::Entry, extension: &CStr) -> Result<bool> {
    // SAFETY: no preconditions.
    let all =
        unsafe { entry.enumerate_instance_extension_properties(None) }.map_err(loader_error)?;
    Ok(all.iter().any(|listed| listed.extension_name_as_c_str() == Ok(extension)))
}

pub(super) fn instance(validate: bool) -> Result<OwnedInstance> {
    let entry = entry()?;
    let app = vk::ApplicationInfo::default()
        .application_name(c"nightsplat")
        .api_version(vk::API_VERSION_1_3);
    let layers = [validation::LAYER.as_ptr()];
    let mut extensions = vec![];
    if validate {
        extensions.extend([ext::debug_utils::NAME, ext::validation_features::NAME]);
    }
    let mut flags = vk::InstanceCreateFlags::empty();
    // Without it, a loader hides devices that are not fully conformant, such as MoltenVK.
    if instance_has(&entry, khr::portability_enumeration::NAME)? {
        extensions.push(khr::portability_enumeration::NAME);
        flags |= vk::InstanceCreateFlags::ENUMERATE_PORTABILITY_KHR;
    }
    let extensions: Vec<_> = extensions.into_iter().map(CStr::as_ptr).collect();
    let checks = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&checks);
    let messenger_info = validation::messenger();
    let mut early = messenger_info;
    let mut info = vk::InstanceCreateInfo::default()
        .application_info(&app)
        .flags(flags)
        .enabled_extension_names(&extensions);
    if validate {
        info = info.enabled_layer_names(&layers).push_next(&mut features).push_next(&mut early);
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
        Ok(OwnedInstance { instance, messenger, cache_path: None, tuning_path: None, entry })
    }
}

/// All devices, the most capable type first, in the driver's order within a type.
pub(super) fn physical_devices(instance: &ash::Instance) -> Result<Vec<vk::PhysicalDevice>> {
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
