//! The report of `doctor` on every device.

use std::ffi::CStr;

use ash::vk;

use super::REQUIREMENTS;

use super::cooperative::{self, CooperativeMatrix};
use super::instance::{OwnedInstance, instance, loader_error, physical_devices};
use super::limits::max_workgroups;
use super::pci::PciAddress;
use super::supported::Supported;
use crate::Result;

/// One device and whether it meets the requirements, for `doctor`.
#[derive(Clone, Debug, serde::Serialize)]
pub struct DeviceReport {
    /// The device's name.
    pub name: String,
    /// discrete, integrated, virtual, software or other.
    pub kind: &'static str,
    /// The Vulkan version.
    pub api_version: String,
    /// The PCI vendor id.
    pub vendor: u32,
    /// The PCI device id.
    pub device: u32,
    /// The driver's name and version, as the driver gives them.
    pub driver: String,
    /// The driver's version as a number.
    pub driver_version: u32,
    /// `VkPhysicalDeviceIDProperties::deviceUUID`, which NVIDIA's tools print after `GPU-`.
    pub uuid: String,
    /// The PCI address, where the device has one and reports it.
    pub pci: Option<PciAddress>,
    /// Lanes of a subgroup in the kernels.
    pub subgroup_size: u32,
    /// The sizes that `NIGHTSPLAT_SUBGROUP` accepts.
    pub subgroup_sizes: Vec<u32>,
    /// Bytes of device-local memory.
    pub memory: u64,
    /// Limits on scenes and views.
    pub limits: DeviceLimits,
    /// The matrices of `--denoiser-precision half`, where the device supports them.
    pub cooperative_matrix: Option<CooperativeMatrix>,
    /// Every requirement.
    pub requirements: Vec<RequirementReport>,
}

/// Limits of a device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct DeviceLimits {
    /// Bytes that one storage buffer binding can span.
    pub max_storage_buffer_range: u64,
    /// Bytes of one allocation.
    pub max_allocation: u64,
    /// Bytes of one buffer.
    pub max_buffer_size: u64,
    /// Workgroups of a dispatch along its first two dimensions.
    pub max_workgroups: u32,
    /// Invocations of a workgroup.
    pub max_workgroup_invocations: u32,
    /// Bytes of shared memory of a workgroup.
    pub max_shared_memory: u32,
    /// Storage buffers that one kernel binds.
    pub max_storage_buffers: u32,
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
        self.all_missing().next()
    }

    /// Every requirement that the device does not meet, by its name.
    pub fn all_missing(&self) -> impl Iterator<Item = &'static str> {
        self.requirements.iter().filter(|requirement| !requirement.met).map(|missing| missing.name)
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

pub(super) fn report(
    OwnedInstance { instance, entry, .. }: &OwnedInstance,
    physical: vk::PhysicalDevice,
) -> Result<DeviceReport> {
    let supported = Supported::gather(instance, physical).map_err(loader_error)?;
    let version = supported.properties.api_version;
    let (major, minor, patch) = (
        vk::api_version_major(version),
        vk::api_version_minor(version),
        vk::api_version_patch(version),
    );
    let limits = supported.properties.limits;
    Ok(DeviceReport {
        name: supported.device_name(),
        kind: match supported.properties.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => "discrete",
            vk::PhysicalDeviceType::INTEGRATED_GPU => "integrated",
            vk::PhysicalDeviceType::VIRTUAL_GPU => "virtual",
            vk::PhysicalDeviceType::CPU => "software",
            _ => "other",
        },
        api_version: format!("{major}.{minor}.{patch}"),
        vendor: supported.properties.vendor_id,
        device: supported.properties.device_id,
        driver: driver_name(instance, physical).0,
        driver_version: supported.properties.driver_version,
        uuid: hyphenated(&supported.uuid),
        pci: supported.pci,
        // What the variable requires of another device does not matter here.
        subgroup_size: supported.lanes().unwrap_or(supported.subgroups.default),
        subgroup_sizes: supported.subgroups.all(),
        memory: device_memory(instance, physical),
        limits: DeviceLimits {
            max_storage_buffer_range: u64::from(limits.max_storage_buffer_range),
            max_allocation: supported.max_allocation,
            max_buffer_size: supported.max_buffer,
            max_workgroups: max_workgroups(&limits),
            max_workgroup_invocations: limits.max_compute_work_group_invocations,
            max_shared_memory: limits.max_compute_shared_memory_size,
            max_storage_buffers: limits.max_per_stage_descriptor_storage_buffers,
        },
        cooperative_matrix: cooperative::supported(entry, instance, physical, &supported),
        requirements: REQUIREMENTS
            .iter()
            .map(|r| RequirementReport { name: r.name, why: r.why, met: r.met_by(&supported) })
            .collect(),
    })
}

/// Bytes of device-local memory.
pub(super) fn device_memory(instance: &ash::Instance, physical: vk::PhysicalDevice) -> u64 {
    // SAFETY: the handle was enumerated from the instance.
    let memory = unsafe { instance.get_physical_device_memory_properties(physical) };
    let heaps = memory.memory_heaps_as_slice().iter();
    let local = heaps.filter(|heap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
    local.map(|heap| heap.size).sum()
}

/// The driver's name and version, as the driver gives them, and its id.
pub(super) fn driver_name(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
) -> (String, vk::DriverId) {
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut driver);
    // SAFETY: the chain points at a live local.
    unsafe { instance.get_physical_device_properties2(physical, &mut properties) };
    let text =
        |text: Result<&CStr, _>| text.map(|t| t.to_string_lossy().into_owned()).unwrap_or_default();
    let [name, info] = [text(driver.driver_name_as_c_str()), text(driver.driver_info_as_c_str())];
    (format!("{name} {info}"), driver.driver_id)
}

/// A UUID in its usual form.
fn hyphenated(uuid: &[u8; 16]) -> String {
    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    let groups = [&uuid[..4], &uuid[4..6], &uuid[6..8], &uuid[8..10], &uuid[10..]];
    groups.map(hex).join("-")
}
