//! Subgroup-uniform control flow: a subgroup whose lanes agree stays converged, whatever the other subgroups of its
//! workgroup do. Kernels in which several subgroups share a tile request it in their GLSL.
//!
//! Core Vulkan guarantees it for whole workgroups only. A device without `VK_KHR_shader_subgroup_uniform_control_flow`
//! gets the kernels without the request, and is relied on to behave as all known drivers do.

use ash::{khr, vk};

use super::spirv::{HEADER, instructions};
use super::supported::Supported;

/// The device extension.
pub(super) const EXTENSION: &std::ffi::CStr = khr::shader_subgroup_uniform_control_flow::NAME;

/// How a module requests it, by the SPIR-V specification and `SPV_KHR_subgroup_uniform_control_flow`.
const NAME: &str = "SPV_KHR_subgroup_uniform_control_flow";
const EXECUTION_MODE: u32 = 4421;
const OP_EXTENSION: u32 = 10;
const OP_EXECUTION_MODE: u32 = 16;

/// Whether the device supports the feature.
pub(super) fn supported(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    supported: &Supported,
) -> bool {
    if !supported.has(EXTENSION) {
        return false;
    }
    let mut feature = vk::PhysicalDeviceShaderSubgroupUniformControlFlowFeaturesKHR::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut feature);
    // SAFETY: the chain points at a live local; the extension is there.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    feature.shader_subgroup_uniform_control_flow == vk::TRUE
}

/// The module without the request.
pub(super) fn unasked(code: &[u32]) -> Vec<u32> {
    let mut kept = code[..HEADER.min(code.len())].to_vec();
    let others = instructions(code).filter(|(opcode, instruction)| !asks(*opcode, instruction));
    others.for_each(|(_, instruction)| kept.extend_from_slice(instruction));
    kept
}

fn asks(opcode: u32, instruction: &[u32]) -> bool {
    match opcode {
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

    fn instruction(opcode: u32, operands: &[u32]) -> Vec<u32> {
        let mut words = vec![((operands.len() as u32 + 1) << 16) | opcode];
        words.extend(operands);
        words
    }

    fn extension(name: &str) -> Vec<u32> {
        let mut bytes = name.as_bytes().to_vec();
        bytes.resize(bytes.len() / 4 * 4 + 4, 0);
        let word = |word: &[u8]| u32::from_le_bytes(word.try_into().unwrap());
        instruction(OP_EXTENSION, &bytes.chunks(4).map(word).collect::<Vec<_>>())
    }

    /// A driver without the extension rejects a module that names it, and a mode without it.
    #[test]
    fn only_the_request_is_removed() {
        const LOCAL_SIZE: u32 = 17;
        let header = vec![0x0723_0203, 0x0001_0600, 0, 99, 0];
        let [capability, storage] = [instruction(17, &[1]), extension("SPV_KHR_16bit_storage")];
        let size = instruction(OP_EXECUTION_MODE, &[4, LOCAL_SIZE, 8, 1, 1]);
        let name = instruction(5, &[EXECUTION_MODE, EXECUTION_MODE]);
        let (question, mode) =
            (extension(NAME), instruction(OP_EXECUTION_MODE, &[4, EXECUTION_MODE]));
        let asking = [&header, &capability, &question, &storage, &mode, &size, &name];
        let kept = [&header, &capability, &storage, &size, &name].map(Vec::as_slice).concat();
        assert_eq!(unasked(&asking.map(Vec::as_slice).concat()), kept);
        assert_eq!(unasked(&kept), kept);
        assert_eq!(unasked(&kept[..3]), kept[..3]);
    }
}
