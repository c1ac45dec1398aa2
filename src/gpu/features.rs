//! The device features that the library needs, in the structs of a host's chain.

use std::ffi::c_void;
use std::mem::offset_of;

use ash::vk;
use ash::vk::TaggedStructure as _;

use super::functions::CoreVersion;
use crate::{Error, Result};

/// A feature, and where its bit is.
struct NeededFeature {
    name: &'static str,
    /// In the struct of its Vulkan version.
    in_version: Bit,
    /// In the struct of its extension.
    in_extension: Bit,
    /// The struct of the extension among [`FeatureStructs`].
    storage: fn(&mut FeatureStructs) -> *mut vk::BaseOutStructure<'static>,
}

#[derive(Clone, Copy)]
struct Bit {
    kind: vk::StructureType,
    offset: usize,
}

macro_rules! bit {
    ($of:ident, $feature:ident) => {
        Bit { kind: vk::$of::STRUCTURE_TYPE, offset: offset_of!(vk::$of<'static>, $feature) }
    };
}
macro_rules! feature {
    ($name:expr, $feature:ident, $version:ident, $extension:ident, $storage:ident) => {
        NeededFeature {
            name: $name,
            in_version: bit!($version, $feature),
            in_extension: bit!($extension, $feature),
            storage: |structs| (&raw mut structs.$storage).cast(),
        }
    };
}

const FEATURES: [NeededFeature; 5] = [
    feature!(
        "timelineSemaphore",
        timeline_semaphore,
        PhysicalDeviceVulkan12Features,
        PhysicalDeviceTimelineSemaphoreFeatures,
        timeline_semaphore
    ),
    feature!(
        "scalarBlockLayout",
        scalar_block_layout,
        PhysicalDeviceVulkan12Features,
        PhysicalDeviceScalarBlockLayoutFeatures,
        scalar_block_layout
    ),
    feature!(
        "synchronization2",
        synchronization2,
        PhysicalDeviceVulkan13Features,
        PhysicalDeviceSynchronization2Features,
        synchronization2
    ),
    feature!(
        "subgroupSizeControl",
        subgroup_size_control,
        PhysicalDeviceVulkan13Features,
        PhysicalDeviceSubgroupSizeControlFeatures,
        subgroup_size_control
    ),
    feature!(
        FULL_SUBGROUPS,
        compute_full_subgroups,
        PhysicalDeviceVulkan13Features,
        PhysicalDeviceSubgroupSizeControlFeatures,
        subgroup_size_control
    ),
];

/// The feature that Vulkan 1.3 does not need: there, SPIR-V 1.6 has full subgroups.
const FULL_SUBGROUPS: &str = "computeFullSubgroups";

/// The structs that [`require_features`] chains where the host has none. They stay where they are until the device is
/// created.
#[repr(C)]
#[derive(Debug, Default)]
pub struct FeatureStructs {
    pub(super) timeline_semaphore: vk::PhysicalDeviceTimelineSemaphoreFeatures<'static>,
    pub(super) scalar_block_layout: vk::PhysicalDeviceScalarBlockLayoutFeatures<'static>,
    pub(super) synchronization2: vk::PhysicalDeviceSynchronization2Features<'static>,
    pub(super) subgroup_size_control: vk::PhysicalDeviceSubgroupSizeControlFeatures<'static>,
}

impl FeatureStructs {
    /// Those that a physical device supports.
    pub(super) fn supported(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Self {
        let mut structs = Self::default();
        let mut features = vk::PhysicalDeviceFeatures2::default();
        // SAFETY: the chain is of live locals, and each bit is overwritten.
        unsafe {
            require_features((&raw mut features).cast(), &mut structs, &[]);
            instance.get_physical_device_features2(physical, &mut features);
        }
        let Self {
            timeline_semaphore,
            scalar_block_layout,
            synchronization2,
            subgroup_size_control,
        } = &mut structs;
        // They move.
        timeline_semaphore.p_next = std::ptr::null_mut();
        scalar_block_layout.p_next = std::ptr::null_mut();
        synchronization2.p_next = std::ptr::null_mut();
        subgroup_size_control.p_next = std::ptr::null_mut();
        structs
    }
}

/// Enables the features that the library needs, in the chain with which a host creates the device that it lends to
/// [`Gpu::from_host`](super::Gpu::from_host). `chain` is the host's `VkDeviceCreateInfo` or
/// `VkPhysicalDeviceFeatures2`. Each feature is enabled in the struct that has it, of a Vulkan version or of an
/// extension; for the others, `structs` are appended. `chained_later` are the `VkStructureType`s of feature structs
/// that the host adds itself afterwards, and with which it enables the features.
///
/// Without Vulkan 1.3, the host enables the extensions `VK_KHR_synchronization2` and `VK_EXT_subgroup_size_control` as
/// well. With `VK_KHR_push_descriptor`, where it is supported, recording is faster.
///
/// # Safety
/// `chain` is a valid chain of structs that may be written, and `structs` outlives it.
pub unsafe fn require_features(
    chain: *mut c_void,
    structs: &mut FeatureStructs,
    chained_later: &[i32],
) {
    let mut present: Vec<_> =
        chained_later.iter().copied().map(vk::StructureType::from_raw).collect();
    let mut last = chain.cast::<vk::BaseOutStructure<'static>>();
    // SAFETY: each struct begins with its type, which tells what it is, and the next of the chain.
    unsafe {
        loop {
            present.push((*last).s_type);
            FEATURES.iter().for_each(|feature| feature.enable(last));
            match (*last).p_next {
                next if next.is_null() => break,
                next => last = next,
            }
        }
        for feature in &FEATURES {
            let bits = [feature.in_version, feature.in_extension];
            if !bits.iter().any(|bit| present.contains(&bit.kind)) {
                let added = (feature.storage)(structs);
                (*added).p_next = std::ptr::null_mut();
                (*last).p_next = added;
                last = added;
                present.push((*added).s_type);
            }
            feature.enable(last);
        }
    }
}

impl NeededFeature {
    /// The bit in a struct of a chain, if it has it.
    ///
    /// # Safety
    /// The struct is what its type says.
    unsafe fn find(&self, at: *mut vk::BaseOutStructure<'_>) -> Option<*mut vk::Bool32> {
        // SAFETY: as the caller promises; the offset is of a member of this type.
        unsafe {
            let mut bits = [self.in_version, self.in_extension].into_iter();
            let bit = bits.find(|bit| bit.kind == (*at).s_type)?;
            Some(at.cast::<u8>().add(bit.offset).cast())
        }
    }

    /// # Safety
    /// As [`NeededFeature::find`], and the struct may be written.
    unsafe fn enable(&self, at: *mut vk::BaseOutStructure<'_>) {
        // SAFETY: as the caller promises.
        unsafe {
            if let Some(bit) = self.find(at) {
                *bit = vk::TRUE;
            }
        }
    }
}

/// How the modules of kernels guarantee full subgroups, in which every lane takes part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FullSubgroups {
    /// By the flag of a pipeline.
    ByFlag,
    /// By SPIR-V 1.6, which guarantees it where workgroups are whole multiples of the subgroup.
    BySpirv16,
}

/// Refuses a chain of enabled features without one that is needed. Null: those of [`require_features`].
///
/// # Safety
/// `chain` is null or a valid chain.
pub(super) unsafe fn check_enabled(
    chain: *const c_void,
    version: CoreVersion,
) -> Result<FullSubgroups> {
    let mut missing: Vec<_> = FEATURES.iter().collect();
    let mut next = chain.cast_mut().cast::<vk::BaseOutStructure<'_>>();
    if next.is_null() {
        // What the extension alone enables is not assumed where the version does without.
        missing.retain(|feature| feature.name == FULL_SUBGROUPS && version == CoreVersion::V1_3);
    }
    // SAFETY: each struct begins with its type, which tells what it is, and the next of the chain.
    while let Some(base) = unsafe { next.as_ref() } {
        missing.retain(|feature| {
            // SAFETY: as above.
            let bit = unsafe { feature.find(next) };
            // SAFETY: as above.
            bit.is_none_or(|bit| unsafe { *bit } == vk::FALSE)
        });
        next = base.p_next;
    }
    let has_flag = !missing.iter().any(|feature| feature.name == FULL_SUBGROUPS);
    missing.retain(|feature| feature.name != FULL_SUBGROUPS || version < CoreVersion::V1_3);
    match missing.first() {
        Some(NeededFeature { name, .. }) => Err(Error::NoDevice(format!(
            "the enabled features lack {name}; create the device with require_features (nsp_require_features)"
        ))),
        None if has_flag => Ok(FullSubgroups::ByFlag),
        None => Ok(FullSubgroups::BySpirv16),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chained(info: &vk::DeviceCreateInfo<'_>) -> Vec<vk::StructureType> {
        let (mut all, mut next) = (vec![], info.p_next.cast::<vk::BaseInStructure<'_>>());
        // SAFETY: a valid chain.
        while let Some(base) = unsafe { next.as_ref() } {
            all.push(base.s_type);
            next = base.p_next;
        }
        all
    }

    fn require(info: &mut vk::DeviceCreateInfo<'_>, later: &[i32]) -> FeatureStructs {
        let mut structs = FeatureStructs::default();
        // SAFETY: a valid chain; the structs are read by the tests alone, before they move.
        unsafe { require_features((&raw mut *info).cast(), &mut structs, later) };
        structs
    }

    #[test]
    fn the_structs_of_versions_are_filled_and_nothing_is_added() {
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default();
        let mut info =
            vk::DeviceCreateInfo::default().push_next(&mut vulkan12).push_next(&mut vulkan13);
        let before = chained(&info);
        require(&mut info, &[]);
        assert_eq!(chained(&info), before);
        // SAFETY: a valid chain.
        let found = unsafe { check_enabled(info.p_next, CoreVersion::V1_2) };
        assert_eq!(found.unwrap(), FullSubgroups::ByFlag);
        assert_eq!((vulkan12.timeline_semaphore, vulkan12.descriptor_indexing), (1, 0));
        assert_eq!((vulkan13.synchronization2, vulkan13.dynamic_rendering), (1, 0));
    }

    #[test]
    fn what_is_missing_is_added_once_and_what_comes_later_is_not() {
        let mut subgroups = vk::PhysicalDeviceSubgroupSizeControlFeatures::default();
        let mut info = vk::DeviceCreateInfo::default().push_next(&mut subgroups);
        let timeline = vk::PhysicalDeviceTimelineSemaphoreFeatures::STRUCTURE_TYPE;
        let mut structs = FeatureStructs::default();
        // SAFETY: a valid chain.
        unsafe {
            require_features((&raw mut info).cast(), &mut structs, &[timeline.as_raw()]);
        }
        let expected = [
            vk::PhysicalDeviceSubgroupSizeControlFeatures::STRUCTURE_TYPE,
            vk::PhysicalDeviceScalarBlockLayoutFeatures::STRUCTURE_TYPE,
            vk::PhysicalDeviceSynchronization2Features::STRUCTURE_TYPE,
        ];
        assert_eq!(chained(&info), expected);
        // SAFETY: a valid chain.
        let missing = unsafe { check_enabled(info.p_next, CoreVersion::V1_3) }.unwrap_err();
        assert!(missing.to_string().contains("timelineSemaphore"), "{missing}");
        assert_eq!((subgroups.subgroup_size_control, subgroups.compute_full_subgroups), (1, 1));
        assert_eq!(structs.synchronization2.synchronization2, 1);
    }

    #[test]
    fn only_before_vulkan_1_3_is_the_feature_of_full_subgroups_needed() {
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default()
            .timeline_semaphore(true)
            .scalar_block_layout(true);
        let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default()
            .synchronization2(true)
            .subgroup_size_control(true);
        let info =
            vk::DeviceCreateInfo::default().push_next(&mut vulkan12).push_next(&mut vulkan13);
        // SAFETY: valid chains.
        unsafe {
            let found = check_enabled(info.p_next, CoreVersion::V1_3);
            assert_eq!(found.unwrap(), FullSubgroups::BySpirv16);
            let missing = check_enabled(info.p_next, CoreVersion::V1_2).unwrap_err();
            assert!(missing.to_string().contains("computeFullSubgroups"), "{missing}");
            let assumed = check_enabled(std::ptr::null(), CoreVersion::V1_3);
            assert_eq!(assumed.unwrap(), FullSubgroups::BySpirv16);
            let assumed = check_enabled(std::ptr::null(), CoreVersion::V1_2);
            assert_eq!(assumed.unwrap(), FullSubgroups::ByFlag);
        }
    }
}
