//! The kernels as drivers get them: without specialization constants, valid, and within what is required of a device.

use std::io::Write as _;
use std::process::Output;

use nightsplat::gpu::testing::frozen;
use nightsplat::gpu::{Interface, Kernel as _, REQUIREMENTS};
use nightsplat::kernels::splat::MAX_CHANNELS;
use nightsplat::kernels::{ALL, blend_backward, blend_forward};

use crate::common::not_run;
use crate::common::prelude::*;

// Opcodes and enumerants of the SPIR-V specification.
/// From `OpSourceContinued` to `OpLine`.
const OP_DEBUG: std::ops::RangeInclusive<u32> = 2..=8;
const OP_EXECUTION_MODE: u32 = 16;
const OP_TYPE_VECTOR: u32 = 23;
const OP_TYPE_ARRAY: u32 = 28;
const OP_TYPE_POINTER: u32 = 32;
const OP_CONSTANT: u32 = 43;
const OP_SPEC_CONSTANT_TRUE: u32 = 48;
const OP_SPEC_CONSTANT_OP: u32 = 52;
const OP_VARIABLE: u32 = 59;
const OP_DECORATE: u32 = 71;
const DECORATION_SPEC_ID: u32 = 1;
const MODE_LOCAL_SIZE: u32 = 17;
const STORAGE_WORKGROUP: u32 = 4;

/// Opcodes and operands.
fn instructions(module: &[u32]) -> Vec<(u32, &[u32])> {
    let (mut found, mut rest) = (vec![], &module[5..]);
    while let [first, ..] = rest {
        let (instruction, after) = rest.split_at((first >> 16) as usize);
        found.push((first & 0xffff, &instruction[1..]));
        rest = after;
    }
    found
}

fn all() -> impl Iterator<Item = (&'static Interface, Vec<u32>)> {
    ALL.iter()
        .map(|(interface, constants)| (*interface, frozen(interface, constants(), 32).unwrap()))
}

fn backward(channels: u32, subgroups_per_tile: u32, lanes: u32) -> Vec<u32> {
    let constants = blend_backward::Constants {
        channels,
        subgroups_per_tile,
        ..blend_backward::Constants::default()
    };
    let constants = blend_backward::Kernel::constants(&constants);
    frozen(blend_backward::Kernel::INTERFACE, constants, lanes).unwrap()
}

#[test]
fn no_kernel_is_shipped_with_names_for_debuggers() {
    for (interface, module) in all() {
        let names =
            instructions(&module).iter().filter(|(opcode, _)| OP_DEBUG.contains(opcode)).count();
        assert_eq!(names, 0, "{}", interface.name);
    }
}

#[test]
fn no_kernel_has_a_specialization_constant_left_and_all_are_of_spirv_1_5() {
    for (interface, module) in all() {
        // From 1.6 on, subgroups vary in size unless a kernel forbids it.
        assert_eq!(module[1], 0x0001_0500, "{}", interface.name);
        for (opcode, operands) in instructions(&module) {
            let is_left = (OP_SPEC_CONSTANT_TRUE..=OP_SPEC_CONSTANT_OP).contains(&opcode)
                || opcode == OP_DECORATE && operands[1] == DECORATION_SPEC_ID;
            assert!(!is_left, "{}: {opcode} {operands:?}", interface.name);
        }
    }
}

fn validated(module: &[u32]) -> std::io::Result<Output> {
    let options = ["--target-env", "vulkan1.3", "--scalar-block-layout", "-"];
    let mut command = Command::new("spirv-val");
    command.args(options).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn()?;
    let bytes: Vec<u8> = module.iter().flat_map(|word| word.to_le_bytes()).collect();
    child.stdin.take().unwrap().write_all(&bytes)?;
    child.wait_with_output()
}

#[test]
fn every_frozen_kernel_is_valid() {
    for (interface, module) in all() {
        let Ok(output) = validated(&module) else {
            return not_run(
                "spirv-val",
                "there is no spirv-val (on Debian `apt install spirv-tools`)",
            );
        };
        let printed =
            String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        // An older validator does not know cooperative matrices.
        let is_unknown = interface.name.ends_with("_half") && printed.contains("Invalid");
        assert!(output.status.success() || is_unknown, "{}: {printed}", interface.name);
    }
}

#[test]
fn the_workgroup_size_is_that_of_the_execution_mode() {
    let constants =
        blend_forward::Constants { subgroups_per_tile: 4, ..blend_forward::Constants::default() };
    let constants = blend_forward::Kernel::constants(&constants);
    let module = frozen(blend_forward::Kernel::INTERFACE, constants, 16).unwrap();
    let instructions = instructions(&module).into_iter();
    let sizes: Vec<_> = instructions
        .filter(|(opcode, operands)| *opcode == OP_EXECUTION_MODE && operands[1] == MODE_LOCAL_SIZE)
        .map(|(_, operands)| &operands[2..])
        .collect();
    assert_eq!(sizes, [[16, 4, 1]]);
}

#[test]
fn each_value_of_a_constant_has_a_module_of_its_own() {
    assert_eq!(backward(3, 1, 8), backward(3, 1, 8));
    assert!(backward(3, 1, 8) != backward(4, 1, 8) && backward(3, 1, 8) != backward(3, 1, 16));
}

/// The bytes of a module's variables in shared memory, which are arrays of 32-bit numbers, or vectors of them.
fn shared_memory(module: &[u32]) -> u32 {
    let (mut constants, mut sizes, mut total) = (BTreeMap::new(), BTreeMap::new(), 0);
    for (opcode, operands) in instructions(module) {
        match (opcode, operands) {
            (OP_CONSTANT, [_, result, value, ..]) => drop(constants.insert(*result, *value)),
            (OP_TYPE_VECTOR, [ty, _, count]) => drop(sizes.insert(*ty, 4 * count)),
            (OP_TYPE_ARRAY, [ty, element, count]) => {
                let size = sizes.get(element).unwrap_or(&4) * constants[count];
                sizes.insert(*ty, size);
            }
            (OP_TYPE_POINTER, [ty, STORAGE_WORKGROUP, of]) => {
                let size = *sizes.get(of).unwrap_or(&4);
                sizes.insert(*ty, size);
            }
            (OP_VARIABLE, [ty, _, STORAGE_WORKGROUP, ..]) => total += sizes[ty],
            _ => {}
        }
    }
    total
}

/// The number in a requirement such as `maxComputeSharedMemorySize >= 16384`.
fn required(limit: &str) -> u32 {
    let requirement = REQUIREMENTS.iter().find(|known| known.name.starts_with(limit)).unwrap();
    requirement.name.split(' ').next_back().unwrap().parse().unwrap()
}

#[test]
fn kernels_need_the_buffers_and_the_shared_memory_that_are_required_of_a_device_and_no_more() {
    let most = all().map(|(interface, _)| interface.bindings.len()).max();
    let buffers = required("maxPerStageDescriptorStorageBuffers") as usize;
    assert!(most <= Some(buffers) && most > Some(buffers - 2), "{most:?}");
    let shared = all().map(|(_, module)| shared_memory(&module));
    let tiles = [(8, 4), (32, 4), (64, 4), (128, 2)];
    let of_tiles = tiles.map(|(lanes, parts)| shared_memory(&backward(MAX_CHANNELS, parts, lanes)));
    let most = shared.chain(of_tiles).max().unwrap();
    let limit = required("maxComputeSharedMemorySize");
    assert!(most <= limit && most > limit / 2, "{most}");
}
