//! What every device must offer: one table, read by device selection, `doctor` and the embedding check.

use std::collections::BTreeSet;
use std::ffi::CStr;

use ash::{ext, khr, vk};

use super::choice::PciAddress;
use super::descriptors::{MAX_BUFFERS, PUSH_VARIABLE};
use super::subgroups::{SIZES, SubgroupSizes};
use crate::{Error, Result};

/// The subgroup operations that our kernels use.
const SUBGROUP_OPERATIONS: vk::SubgroupFeatureFlags = vk::SubgroupFeatureFlags::from_raw(
    vk::SubgroupFeatureFlags::BASIC.as_raw()
        | vk::SubgroupFeatureFlags::VOTE.as_raw()
        | vk::SubgroupFeatureFlags::ARITHMETIC.as_raw()
        | vk::SubgroupFeatureFlags::BALLOT.as_raw()
        | vk::SubgroupFeatureFlags::SHUFFLE.as_raw(),
);

/// The device extensions that a device of our own is created with where it has them.
pub(super) const OPTIONAL_EXTENSIONS: &[&CStr] =
    &[khr::push_descriptor::NAME, khr::portability_subset::NAME];

/// What a physical device offers, gathered once.
pub(super) struct Offered {
    pub(super) properties: vk::PhysicalDeviceProperties,
    pub(super) uuid: [u8; vk::UUID_SIZE],
    pub(super) pci: Option<PciAddress>,
    pub(super) max_allocation: u64,
    pub(super) subgroups: SubgroupSizes,
    pub(super) subgroup_operations: vk::SubgroupFeatureFlags,
    pub(super) subgroup_stages: vk::ShaderStageFlags,
    pub(super) max_push_descriptors: u32,
    pub(super) extensions: BTreeSet<String>,
    pub(super) vulkan12: vk::PhysicalDeviceVulkan12Features<'static>,
    pub(super) vulkan13: vk::PhysicalDeviceVulkan13Features<'static>,
    pub(super) compute_family: Option<u32>,
    /// Of that family.
    pub(super) timestamp_bits: u32,
}

/// One thing that every device must offer.
#[derive(Clone, Copy)]
pub struct Requirement {
    /// The Vulkan name of the feature, extension or limit.
    pub name: &'static str,
    /// What it is needed for.
    pub why: &'static str,
    offered: fn(&Offered) -> bool,
}

impl std::fmt::Debug for Requirement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name)
    }
}

impl Requirement {
    pub(super) fn met_by(&self, offered: &Offered) -> bool {
        (self.offered)(offered)
    }
}

/// Everything a device must offer, most fundamental first.
pub const REQUIREMENTS: &[Requirement] = &[
    Requirement {
        name: "Vulkan 1.3",
        why: "the baseline of every kernel",
        offered: |o| o.properties.api_version >= vk::API_VERSION_1_3,
    },
    Requirement {
        name: "compute queue",
        why: "everything runs on one",
        offered: |o| o.compute_family.is_some(),
    },
    Requirement {
        name: "maxPerStageDescriptorStorageBuffers >= 16",
        why: "the most buffers that one pass binds",
        offered: |o| o.properties.limits.max_per_stage_descriptor_storage_buffers >= MAX_BUFFERS,
    },
    Requirement {
        name: "timelineSemaphore",
        why: "one counter orders all submissions",
        offered: |o| o.vulkan12.timeline_semaphore == vk::TRUE,
    },
    Requirement {
        name: "scalarBlockLayout",
        why: "the same bytes in GLSL and Rust",
        offered: |o| o.vulkan12.scalar_block_layout == vk::TRUE,
    },
    Requirement {
        name: "hostQueryReset",
        why: "timestamps of every pass",
        offered: |o| o.vulkan12.host_query_reset == vk::TRUE,
    },
    Requirement {
        name: "synchronization2",
        why: "barriers and submissions",
        offered: |o| o.vulkan13.synchronization2 == vk::TRUE,
    },
    Requirement {
        name: "subgroupSizeControl",
        why: "one subgroup owns a tile: its size must be known",
        offered: |o| o.vulkan13.subgroup_size_control == vk::TRUE,
    },
    Requirement {
        name: "computeFullSubgroups",
        why: "every lane of a subgroup takes part",
        offered: |o| o.vulkan13.compute_full_subgroups == vk::TRUE,
    },
    Requirement {
        name: "subgroup operations basic, vote, arithmetic, ballot, shuffle in compute",
        why: "blending and sorting without barriers",
        offered: |o| {
            o.subgroup_operations.contains(SUBGROUP_OPERATIONS)
                && o.subgroup_stages.contains(vk::ShaderStageFlags::COMPUTE)
        },
    },
    Requirement {
        name: "subgroup size 4 to 128",
        why: "a ballot fits four words, a tile at most 32 rows of lanes",
        offered: |o| SIZES.contains(&o.subgroups.own),
    },
    Requirement {
        name: "maxComputeWorkGroupInvocations >= 256",
        why: "the widest workgroup",
        offered: |o| o.properties.limits.max_compute_work_group_invocations >= 256,
    },
    Requirement {
        name: "maxComputeSharedMemorySize >= 24576",
        why: "the state of a tile",
        offered: |o| o.properties.limits.max_compute_shared_memory_size >= 24_576,
    },
];

/// The features a device must be created with, to chain into `VkDeviceCreateInfo`; with the extension
/// `VK_KHR_push_descriptor`, where there is one, passes are recorded faster. For hosts that lend their device to [`Gpu::from_host`](super::Gpu::from_host).
pub fn required_device_features()
-> (vk::PhysicalDeviceVulkan12Features<'static>, vk::PhysicalDeviceVulkan13Features<'static>) {
    let vulkan12 = vk::PhysicalDeviceVulkan12Features::default()
        .timeline_semaphore(true)
        .scalar_block_layout(true)
        .host_query_reset(true);
    let vulkan13 = vk::PhysicalDeviceVulkan13Features::default()
        .synchronization2(true)
        .subgroup_size_control(true)
        .compute_full_subgroups(true);
    (vulkan12, vulkan13)
}

impl Offered {
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
        let mut vulkan11 = vk::PhysicalDeviceVulkan11Properties::default();
        let mut vulkan13_properties = vk::PhysicalDeviceVulkan13Properties::default();
        let mut push = vk::PhysicalDevicePushDescriptorPropertiesKHR::default();
        let mut pci = vk::PhysicalDevicePCIBusInfoPropertiesEXT::default();
        let mut properties = vk::PhysicalDeviceProperties2::default()
            .push_next(&mut vulkan11)
            .push_next(&mut vulkan13_properties);
        // Some drivers complain of what they do not know.
        if has(khr::push_descriptor::NAME) {
            properties = properties.push_next(&mut push);
        }
        let has_pci = has(ext::pci_bus_info::NAME);
        if has_pci {
            properties = properties.push_next(&mut pci);
        }
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
        let mut features = vk::PhysicalDeviceFeatures2::default()
            .push_next(&mut vulkan12)
            .push_next(&mut vulkan13);
        // SAFETY: the chains point at live locals of the types that the structures name.
        let families = unsafe {
            instance.get_physical_device_properties2(physical, &mut properties);
            instance.get_physical_device_features2(physical, &mut features);
            instance.get_physical_device_queue_family_properties(physical)
        };
        let properties = properties.properties;
        let compute =
            families.iter().position(|family| family.queue_flags.contains(vk::QueueFlags::COMPUTE));
        Ok(Self {
            properties,
            uuid: vulkan11.device_uuid,
            pci: has_pci.then_some(PciAddress {
                domain: pci.pci_domain,
                bus: pci.pci_bus,
                device: pci.pci_device,
                function: pci.pci_function,
            }),
            max_allocation: vulkan11.max_memory_allocation_size,
            subgroups: SubgroupSizes {
                own: vulkan11.subgroup_size,
                are_selectable: vulkan13_properties
                    .required_subgroup_size_stages
                    .contains(vk::ShaderStageFlags::COMPUTE),
                least: vulkan13_properties.min_subgroup_size,
                most: vulkan13_properties.max_subgroup_size,
                most_in_workgroup: vulkan13_properties.max_compute_workgroup_subgroups,
            },
            subgroup_operations: vulkan11.subgroup_supported_operations,
            subgroup_stages: vulkan11.subgroup_supported_stages,
            max_push_descriptors: push.max_push_descriptors,
            extensions,
            // The chain pointers die with this function.
            vulkan12: vk::PhysicalDeviceVulkan12Features {
                p_next: std::ptr::null_mut(),
                ..vulkan12
            },
            vulkan13: vk::PhysicalDeviceVulkan13Features {
                p_next: std::ptr::null_mut(),
                ..vulkan13
            },
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

    /// Whether passes may push their descriptors, and the user does not forbid it.
    pub(super) fn pushes_descriptors(&self) -> bool {
        let is_forbidden = std::env::var_os(PUSH_VARIABLE).is_some_and(|value| value == "off");
        self.max_push_descriptors >= MAX_BUFFERS && !is_forbidden
    }

    /// # Errors
    /// The first requirement that is not met, by its name.
    pub(super) fn check(&self) -> Result<()> {
        self.missing().map_or(Ok(()), |requirement| {
            let (device, feature) = (self.device_name(), requirement.name.to_owned());
            Err(Error::MissingFeature { device, feature })
        })
    }

    /// The first requirement that is not met.
    pub(super) fn missing(&self) -> Option<&'static Requirement> {
        REQUIREMENTS.iter().find(|requirement| !requirement.met_by(self))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device that meets every requirement, just so.
    fn sufficient() -> Offered {
        let mut properties =
            vk::PhysicalDeviceProperties { api_version: vk::API_VERSION_1_3, ..Default::default() };
        properties.limits.max_compute_work_group_invocations = 256;
        properties.limits.max_compute_shared_memory_size = 24_576;
        properties.limits.max_per_stage_descriptor_storage_buffers = 16;
        for (to, from) in properties.device_name.iter_mut().zip(b"Abacus 3000") {
            *to = *from as _;
        }
        let (vulkan12, vulkan13) = required_device_features();
        Offered {
            properties,
            subgroups: SubgroupSizes {
                own: 4,
                are_selectable: false,
                least: 4,
                most: 4,
                most_in_workgroup: 64,
            },
            subgroup_operations: SUBGROUP_OPERATIONS,
            subgroup_stages: vk::ShaderStageFlags::COMPUTE,
            uuid: [0; 16],
            pci: None,
            max_allocation: 1 << 30,
            max_push_descriptors: 0,
            extensions: BTreeSet::new(),
            vulkan12,
            vulkan13,
            compute_family: Some(0),
            timestamp_bits: 64,
        }
    }

    #[test]
    fn each_missing_requirement_is_the_one_that_is_named() {
        type Break = (&'static str, fn(&mut Offered));
        let breaks: [Break; 13] = [
            ("Vulkan 1.3", |o| o.properties.api_version = vk::API_VERSION_1_2),
            ("compute queue", |o| o.compute_family = None),
            ("maxPerStageDescriptorStorageBuffers >= 16", |o| {
                o.properties.limits.max_per_stage_descriptor_storage_buffers = 15;
            }),
            ("timelineSemaphore", |o| o.vulkan12.timeline_semaphore = vk::FALSE),
            ("scalarBlockLayout", |o| o.vulkan12.scalar_block_layout = vk::FALSE),
            ("hostQueryReset", |o| o.vulkan12.host_query_reset = vk::FALSE),
            ("synchronization2", |o| o.vulkan13.synchronization2 = vk::FALSE),
            ("subgroupSizeControl", |o| o.vulkan13.subgroup_size_control = vk::FALSE),
            ("computeFullSubgroups", |o| o.vulkan13.compute_full_subgroups = vk::FALSE),
            ("subgroup operations", |o| o.subgroup_operations = vk::SubgroupFeatureFlags::BASIC),
            ("subgroup size", |o| o.subgroups.own = 2),
            ("maxComputeWorkGroupInvocations", |o| {
                o.properties.limits.max_compute_work_group_invocations = 128;
            }),
            ("maxComputeSharedMemorySize", |o| {
                o.properties.limits.max_compute_shared_memory_size = 16_384;
            }),
        ];
        assert!(sufficient().check().is_ok());
        assert_eq!(breaks.len(), REQUIREMENTS.len());
        for (name, break_it) in breaks {
            let mut offered = sufficient();
            break_it(&mut offered);
            let message = offered.check().unwrap_err().to_string();
            assert!(message.starts_with(&format!("Abacus 3000 lacks {name}")), "{message}");
            assert!(message.contains("nightsplat doctor") && !message.contains('\n'), "{message}");
        }
    }
}
