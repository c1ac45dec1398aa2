//! That a subgroup whose lanes agree stays together, whatever the other subgroups of its workgroup do: kernels in which several
//! subgroups share a tile ask for it in their GLSL, and a device that promises it is held to that.
//!
//! The core of Vulkan promises it of whole workgroups alone. A device without `VK_KHR_shader_subgroup_uniform_control_flow` gets
//! such kernels without the question, and is relied on to do what all known drivers do.

use ash::{khr, vk};

use super::requirements::Offered;

/// The extension a device is created with to be asked.
pub(super) const EXTENSION: &std::ffi::CStr = khr::shader_subgroup_uniform_control_flow::NAME;

/// What a module says of it, by the SPIR-V specification and `SPV_KHR_subgroup_uniform_control_flow`.
const NAME: &str = "SPV_KHR_subgroup_uniform_control_flow";
const EXECUTION_MODE: u32 = 4421;
const OP_EXTENSION: u32 = 10;
const OP_EXECUTION_MODE: u32 = 16;
/// Words before the first instruction.
const HEADER: usize = 5;

/// Whether the device makes the promise.
pub(super) fn offered(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    offered: &Offered,
) -> bool {
    if !offered.has(EXTENSION) {
        return false;
    }
    let mut feature = vk::PhysicalDeviceShaderSubgroupUniformControlFlowFeaturesKHR::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut feature);
    // SAFETY: the chain points at a live local; the extension is there.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    feature.shader_subgroup_uniform_control_flow == vk::TRUE
}

/// The module without the question.
pub(super) fn unasked(code: &[u32]) -> Vec<u32> {
    let (header, mut rest) = code.split_at(HEADER.min(code.len()));
    let mut kept = header.to_vec();
    while let Some(&first) = rest.first() {
        let length = (first >> 16) as usize;
        let (instruction, behind) = rest.split_at(length.clamp(1, rest.len()));
        if !asks(instruction) {
            kept.extend_from_slice(instruction);
        }
        rest = behind;
    }
    kept
}

fn asks(instruction: &[u32]) -> bool {
    match instruction[0] & 0xffff {
        OP_EXTENSION => {
            let bytes = instruction[1..].iter().flat_map(|word| word.to_le_bytes());
            bytes.take_while(|&byte| byte != 0).eq(NAME.bytes())
        }
        OP_EXECUTION_MODE => instruction.get(2) == Some(&EXECUTION_MODE),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::Kernel;
    use crate::kernels::{blend_backward, blend_forward, tone_map};

    fn words(spirv: &[u8]) -> Vec<u32> {
        spirv.chunks(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect()
    }

    /// A device that was not asked for the extension refuses a module that names it, and a mode without it.
    #[test]
    fn the_question_and_nothing_else_goes() {
        for interface in [blend_forward::Kernel::INTERFACE, blend_backward::Kernel::INTERFACE] {
            let asking = words(interface.spirv);
            let unasked = unasked(&asking);
            let of_extension = 1 + NAME.len() / 4 + 1;
            assert_eq!(unasked.len(), asking.len() - of_extension - 3, "{}", interface.name);
            assert_eq!(super::unasked(&unasked), unasked);
        }
        let other = words(tone_map::Kernel::INTERFACE.spirv);
        assert_eq!(unasked(&other), other);
    }
}
