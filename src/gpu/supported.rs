//! What a physical device supports.

use std::collections::BTreeSet;
use std::ffi::CStr;

use ash::{ext, khr, vk};

use super::features::FeatureStructs;
use super::limits::MAX_BUFFERS;
use super::pci::PciAddress;
use super::subgroups::{SUBGROUP_VARIABLE, SubgroupSizes, lanes};
use crate::{Error, Result};

/// `off` in this variable binds descriptor sets even where descriptors can be pushed. The bits are the same.
pub const PUSH_VARIABLE: &str = "NIGHTSPLAT_PUSH_DESCRIPTORS";

/// The device extensions that are enabled where they are supported.
pub(super) const OPTIONAL_EXTENSIONS: &[&CStr] =
    &[khr::push_descriptor::NAME, khr::portability_subset::NAME];

/// What a physical device supports, queried once.
pub(super) struct Supported {
    pub(super) properties: vk::PhysicalDeviceProperties,
    pub(super) uuid: [u8; vk::UUID_SIZE],
    pub(super) pci: Option<PciAddress>,
    pub(super) max_allocation: u64,
    pub(super) max_buffer: u64,
    pub(super) subgroups: SubgroupSizes,
    pub(super) subgroup_operations: vk::SubgroupFeatureFlags,
    pub(super) subgroup_stages: vk::ShaderStageFlags,
    pub(super) max_push_descriptors: u32,
    pub(super) extensions: BTreeSet<String>,
    pub(super) features: FeatureStructs,
    pub(super) compute_family: Option<u32>,
    /// Of that family.
    pub(super) timestamp_bits: u32,
}

impl Supported {
    pub(super) fn gather(
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
    ) -> Result<Self, vk::Result> {
        // SAFETY: the handle is the instance's.
        let extensions: BTreeSet<String> =
            unsafe { instance.enumerate_device_extension_properties(physical)? }
                .iter()
                .filter_map(|e| Some(e.extension_name_as_c_str().ok()?.to_string_lossy().into()))
                .collect();
        let has = |name: &CStr| extensions.contains(name.to_string_lossy().as_ref());
        // The structs of extensions, which instances of Vulkan 1.1 take too.
        let mut id = vk::PhysicalDeviceIDProperties::default();
        let mut subgroups = vk::PhysicalDeviceSubgroupProperties::default();
        let mut sizes = vk::PhysicalDeviceSubgroupSizeControlProperties::default();
        let mut allocation = vk::PhysicalDeviceMaintenance3Properties::default();
        let mut buffers = vk::PhysicalDeviceMaintenance4Properties::default();
        let mut push = vk::PhysicalDevicePushDescriptorPropertiesKHR::default();
        let mut pci = vk::PhysicalDevicePCIBusInfoPropertiesEXT::default();
        let mut properties = vk::PhysicalDeviceProperties2::default()
            .push_next(&mut id)
            .push_next(&mut subgroups)
            .push_next(&mut sizes)
            .push_next(&mut allocation)
            .push_next(&mut buffers);
        // Some drivers reject structures that they do not know.
        if has(khr::push_descriptor::NAME) {
            properties = properties.push_next(&mut push);
        }
        let has_pci = has(ext::pci_bus_info::NAME);
        if has_pci {
            properties = properties.push_next(&mut pci);
        }
        // SAFETY: the chain points at live locals of the types that the structures name.
        let families = unsafe {
            instance.get_physical_device_properties2(physical, &mut properties);
            instance.get_physical_device_queue_family_properties(physical)
        };
        let properties = properties.properties;
        let compute =
            families.iter().position(|family| family.queue_flags.contains(vk::QueueFlags::COMPUTE));
        Ok(Self {
            properties,
            uuid: id.device_uuid,
            pci: has_pci.then_some(PciAddress {
                domain: pci.pci_domain,
                bus: pci.pci_bus,
                device: pci.pci_device,
                function: pci.pci_function,
            }),
            max_allocation: allocation.max_memory_allocation_size,
            max_buffer: buffers.max_buffer_size,
            subgroups: SubgroupSizes {
                default: subgroups.subgroup_size,
                are_selectable: sizes
                    .required_subgroup_size_stages
                    .contains(vk::ShaderStageFlags::COMPUTE),
                least: sizes.min_subgroup_size,
                most: sizes.max_subgroup_size,
                workgroup_limit: sizes.max_compute_workgroup_subgroups,
            },
            subgroup_operations: subgroups.supported_operations,
            subgroup_stages: subgroups.supported_stages,
            max_push_descriptors: push.max_push_descriptors,
            extensions,
            features: FeatureStructs::supported(instance, physical),
            compute_family: compute.and_then(|index| u32::try_from(index).ok()),
            timestamp_bits: compute.map_or(0, |index| families[index].timestamp_valid_bits),
        })
    }

    /// The device's name, as the driver gives it.
    pub(super) fn device_name(&self) -> String {
        let name = self.properties.device_name_as_c_str();
        name.map_or_else(|_| "unnamed device".to_owned(), |name| name.to_string_lossy().into())
    }

    pub(super) fn has(&self, extension: &CStr) -> bool {
        self.extensions.contains(extension.to_string_lossy().as_ref())
    }

    /// Bytes of the largest buffer that has memory.
    pub(super) fn max_buffer_size(&self) -> u64 {
        self.max_allocation.min(self.max_buffer)
    }

    /// Whether passes push their descriptors: supported, and not disabled by the user.
    pub(super) fn has_push_descriptors(&self) -> bool {
        let is_forbidden = std::env::var_os(PUSH_VARIABLE).is_some_and(|value| value == "off");
        self.max_push_descriptors >= MAX_BUFFERS && !is_forbidden
    }

    /// The subgroup size of the kernels: the built-in one, or that of the variable.
    pub(super) fn lanes(&self) -> Result<u32> {
        let wanted = std::env::var(SUBGROUP_VARIABLE).ok().filter(|value| !value.is_empty());
        lanes(self.subgroups, self.properties.vendor_id, wanted.as_deref()).map_err(|problem| {
            Error::Usage(format!("{SUBGROUP_VARIABLE} on {}: {problem}", self.device_name()))
        })
    }
}
