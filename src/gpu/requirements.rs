//! The requirements on a device: one table, read by device selection, `doctor` and the embedding check.

use ash::vk;

use super::limits::{MAX_BUFFERS, SHARED_MEMORY, SUBGROUP_SIZES};
use super::supported::Supported;
use crate::{Error, Result};

/// The subgroup operations that our kernels use.
const SUBGROUP_OPERATIONS: vk::SubgroupFeatureFlags = vk::SubgroupFeatureFlags::from_raw(
    vk::SubgroupFeatureFlags::BASIC.as_raw()
        | vk::SubgroupFeatureFlags::VOTE.as_raw()
        | vk::SubgroupFeatureFlags::ARITHMETIC.as_raw()
        | vk::SubgroupFeatureFlags::BALLOT.as_raw()
        | vk::SubgroupFeatureFlags::SHUFFLE.as_raw(),
);

/// One requirement.
#[derive(Clone, Copy)]
pub struct Requirement {
    /// The Vulkan name of the feature, extension or limit.
    pub name: &'static str,
    /// What it is needed for.
    pub why: &'static str,
    supported: fn(&Supported) -> bool,
}

impl std::fmt::Debug for Requirement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name)
    }
}

impl Requirement {
    pub(super) fn met_by(&self, supported: &Supported) -> bool {
        (self.supported)(supported)
    }
}

/// All requirements, the most fundamental first.
pub const REQUIREMENTS: &[Requirement] = &[
    Requirement {
        name: "Vulkan 1.3",
        why: "the baseline of every kernel",
        supported: |o| o.properties.api_version >= vk::API_VERSION_1_3,
    },
    Requirement {
        name: "compute queue",
        why: "everything runs on one",
        supported: |o| o.compute_family.is_some(),
    },
    Requirement {
        name: "maxPerStageDescriptorStorageBuffers >= 12",
        why: "the most buffers that one pass binds",
        supported: |o| o.properties.limits.max_per_stage_descriptor_storage_buffers >= MAX_BUFFERS,
    },
    Requirement {
        name: "timelineSemaphore",
        why: "one counter orders all submissions",
        supported: |o| o.features.timeline_semaphore.timeline_semaphore == vk::TRUE,
    },
    Requirement {
        name: "scalarBlockLayout",
        why: "the same bytes in GLSL and Rust",
        supported: |o| o.features.scalar_block_layout.scalar_block_layout == vk::TRUE,
    },
    Requirement {
        name: "synchronization2",
        why: "barriers and submissions",
        supported: |o| o.features.synchronization2.synchronization2 == vk::TRUE,
    },
    Requirement {
        name: "subgroupSizeControl",
        why: "one subgroup owns a tile: its size must be known",
        supported: |o| o.features.subgroup_size_control.subgroup_size_control == vk::TRUE,
    },
    Requirement {
        name: "computeFullSubgroups",
        why: "every lane of a subgroup takes part",
        supported: |o| o.features.subgroup_size_control.compute_full_subgroups == vk::TRUE,
    },
    Requirement {
        name: "an instance of Vulkan 1.1 (VkApplicationInfo::apiVersion)",
        why: "an older one does not tell what subgroups can do: every device of Vulkan 1.1 has basic operations",
        supported: |o| o.subgroup_operations.contains(vk::SubgroupFeatureFlags::BASIC),
    },
    Requirement {
        name: "subgroup operations basic, vote, arithmetic, ballot, shuffle in compute",
        why: "blending and sorting without barriers",
        supported: |o| {
            o.subgroup_operations.contains(SUBGROUP_OPERATIONS)
                && o.subgroup_stages.contains(vk::ShaderStageFlags::COMPUTE)
        },
    },
    Requirement {
        name: "subgroup size 4 to 128",
        why: "a ballot fits four words, a tile at most 32 rows of lanes",
        supported: |o| {
            SUBGROUP_SIZES.contains(&o.subgroups.default) && !o.subgroups.all().is_empty()
        },
    },
    Requirement {
        name: "maxComputeWorkGroupInvocations >= 256",
        why: "the widest workgroup",
        supported: |o| o.properties.limits.max_compute_work_group_invocations >= 256,
    },
    Requirement {
        name: "maxComputeSharedMemorySize >= 16384",
        why: "the state of a tile",
        supported: |o| o.properties.limits.max_compute_shared_memory_size >= SHARED_MEMORY,
    },
];

impl Supported {
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
    use std::collections::BTreeSet;

    use super::*;
    use crate::gpu::features::{FeatureStructs, require_features};
    use crate::gpu::subgroups::SubgroupSizes;

    /// A device that meets every requirement and no more.
    fn sufficient() -> Supported {
        let mut properties =
            vk::PhysicalDeviceProperties { api_version: vk::API_VERSION_1_3, ..Default::default() };
        properties.limits.max_compute_work_group_invocations = 256;
        properties.limits.max_compute_shared_memory_size = 16_384;
        properties.limits.max_per_stage_descriptor_storage_buffers = 12;
        for (to, from) in properties.device_name.iter_mut().zip(b"Abacus 3000") {
            *to = *from as _;
        }
        let (mut features, mut chain) =
            (FeatureStructs::default(), vk::PhysicalDeviceFeatures2::default());
        // SAFETY: a valid chain.
        unsafe { require_features((&raw mut chain).cast(), &mut features, &[]) };
        Supported {
            properties,
            subgroups: SubgroupSizes {
                default: 4,
                are_selectable: false,
                least: 4,
                most: 4,
                workgroup_limit: 64,
            },
            subgroup_operations: SUBGROUP_OPERATIONS,
            subgroup_stages: vk::ShaderStageFlags::COMPUTE,
            uuid: [0; 16],
            pci: None,
            max_allocation: 1 << 30,
            max_buffer: 1 << 30,
            max_push_descriptors: 0,
            extensions: BTreeSet::new(),
            features,
            compute_family: Some(0),
            timestamp_bits: 64,
        }
    }

    #[test]
    fn each_missing_requirement_is_the_one_that_is_named() {
        type Break = (&'static str, fn(&mut Supported));
        let breaks: [Break; 13] = [
            ("Vulkan 1.3", |o| o.properties.api_version = vk::API_VERSION_1_2),
            ("compute queue", |o| o.compute_family = None),
            ("maxPerStageDescriptorStorageBuffers >= 12", |o| {
                o.properties.limits.max_per_stage_descriptor_storage_buffers = 11;
            }),
            ("timelineSemaphore", |o| o.features.timeline_semaphore.timeline_semaphore = vk::FALSE),
            ("scalarBlockLayout", |o| {
                o.features.scalar_block_layout.scalar_block_layout = vk::FALSE;
            }),
            ("synchronization2", |o| o.features.synchronization2.synchronization2 = vk::FALSE),
            ("subgroupSizeControl", |o| {
                o.features.subgroup_size_control.subgroup_size_control = vk::FALSE;
            }),
            ("computeFullSubgroups", |o| {
                o.features.subgroup_size_control.compute_full_subgroups = vk::FALSE;
            }),
            ("an instance of Vulkan 1.1", |o| {
                o.subgroup_operations = vk::SubgroupFeatureFlags::empty();
            }),
            ("subgroup operations", |o| o.subgroup_operations = vk::SubgroupFeatureFlags::BASIC),
            ("subgroup size", |o| o.subgroups.default = 2),
            ("maxComputeWorkGroupInvocations", |o| {
                o.properties.limits.max_compute_work_group_invocations = 128;
            }),
            ("maxComputeSharedMemorySize", |o| {
                o.properties.limits.max_compute_shared_memory_size = 16_383;
            }),
        ];
        assert!(sufficient().check().is_ok());
        assert_eq!(breaks.len(), REQUIREMENTS.len());
        for (name, break_it) in breaks {
            let mut supported = sufficient();
            break_it(&mut supported);
            let message = supported.check().unwrap_err().to_string();
            assert!(message.starts_with(&format!("Abacus 3000 lacks {name}")), "{message}");
            assert!(message.contains("nightsplat doctor") && !message.contains('\n'), "{message}");
        }
    }
}
