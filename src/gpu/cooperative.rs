//! Cooperative matrices of 16 bits: optional, enabled on an own device that supports them.

use ash::{khr, vk};

use super::supported::Supported;

/// The shape of the matrix products that kernels use, rows x columns x shared side: 16-bit factors, sums in single
/// precision, one subgroup each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct CooperativeMatrix {
    /// Rows of the first factor and of the sum.
    pub m: u32,
    /// Columns of the second factor and of the sum.
    pub n: u32,
    /// Columns of the first factor, rows of the second.
    pub k: u32,
}

/// The largest side that kernels take: channels and pixels are rounded up to it.
const MAX_SIDE: u32 = 16;

/// The extension a device is created with to use [`CooperativeMatrix`].
pub(super) const EXTENSION: &std::ffi::CStr = khr::cooperative_matrix::NAME;

/// The largest product that the device supports; `None` without the extension or one of the features it needs.
pub(super) fn supported(
    entry: &ash::Entry,
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    supported: &Supported,
) -> Option<CooperativeMatrix> {
    if !supported.has(EXTENSION) {
        return None;
    }
    let functions = khr::cooperative_matrix::Instance::new(entry, instance);
    let mut feature = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default();
    let mut halves = vk::PhysicalDevice16BitStorageFeatures::default();
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut features = vk::PhysicalDeviceFeatures2::default()
        .push_next(&mut feature)
        .push_next(&mut halves)
        .push_next(&mut vulkan12);
    // SAFETY: the chain points at a live local; the extension is there.
    let shapes = unsafe {
        instance.get_physical_device_features2(physical, &mut features);
        functions.get_physical_device_cooperative_matrix_properties(physical)
    };
    let needed = [
        feature.cooperative_matrix,
        halves.storage_buffer16_bit_access,
        vulkan12.shader_float16,
        vulkan12.vulkan_memory_model,
        vulkan12.vulkan_memory_model_device_scope,
    ];
    if needed.contains(&vk::FALSE) {
        return None;
    }
    let (half, single) = (vk::ComponentTypeKHR::FLOAT16, vk::ComponentTypeKHR::FLOAT32);
    shapes
        .ok()?
        .iter()
        .filter(|shape| {
            [shape.a_type, shape.b_type] == [half; 2]
                && [shape.c_type, shape.result_type] == [single; 2]
                && shape.scope == vk::ScopeKHR::SUBGROUP
                && [shape.m_size, shape.n_size, shape.k_size].iter().all(|&side| side <= MAX_SIDE)
                // A matrix starts at a multiple of sixteen bytes, whichever of its sides is contiguous.
                && [shape.m_size, shape.n_size, shape.k_size].iter().all(|&side| side % 8 == 0)
        })
        .map(|shape| CooperativeMatrix { m: shape.m_size, n: shape.n_size, k: shape.k_size })
        .max_by_key(|shape| shape.m * shape.n * shape.k)
}
