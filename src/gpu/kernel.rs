//! The host's description of a compute shader.

use std::fmt::Debug;

use ash::vk;

use super::Tolerance;

/// One storage buffer of a kernel.
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// The name of the array in the shader.
    pub name: &'static str,
    /// The binding number.
    pub index: u32,
    /// False where the shader says `readonly`.
    pub writable: bool,
    /// Its elements are 32-bit floats; else integers.
    pub is_float: bool,
}

/// A buffer that a dispatch binds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bound {
    /// The Vulkan buffer.
    pub raw: vk::Buffer,
    /// The offset of its elements, in bytes.
    pub offset: u64,
    /// The size of its elements, in bytes.
    pub size: u64,
}

/// The description of a compute shader for Vulkan, the same type for every kernel.
#[derive(Debug)]
pub struct Interface {
    /// The stem of the shader's file; also its label in captures, timings and errors.
    pub name: &'static str,
    /// The SPIR-V module, as little-endian words.
    pub spirv: &'static [u8],
    /// Threads of a workgroup; 0 along x stands for the device's subgroup size.
    pub workgroup_size: [u32; 3],
    /// The specialization constant that takes the subgroup size, where a workgroup is one subgroup.
    pub subgroup_size_id: Option<u32>,
    /// The storage buffers in binding order.
    pub bindings: &'static [Binding],
    /// Bytes of the push constants.
    pub params_size: usize,
}

/// A compute shader and all that the host needs to launch it.
///
/// Implemented by `build.rs` from the SPIR-V.
pub trait Kernel: 'static {
    /// The untyped side.
    const INTERFACE: &'static Interface;
    /// The push constants.
    type Params: bytemuck::Pod;
    /// The specialization constants.
    type Constants: Copy + Debug;
    /// The buffers of a dispatch.
    type Buffers<'a>;
    /// The Vulkan buffers in binding order.
    fn bound(buffers: &Self::Buffers<'_>) -> Vec<Bound>;
    /// Specialization ids and the bits of their values.
    fn constants(constants: &Self::Constants) -> Vec<(u32, u32)>;
}

/// The buffers of a kernel in host memory. Implemented by `build.rs`.
#[cfg(feature = "train")]
pub trait OnHost: Kernel {
    /// The buffers in host memory.
    type Slices<'a>;
    /// The allowed difference from the reference, for each buffer that it writes.
    type Tolerances: Default + Into<Vec<Tolerance>>;
    /// The slices whose 32-bit numbers these are, in binding order.
    fn slices(words: &mut [Vec<u32>]) -> Self::Slices<'_>;
}

/// A kernel whose passes can be recorded: with feature `train`, one that has a reference.
pub trait Recordable: Kernel {
    /// Runs the reference on the words of a pass's buffers; returns the tolerances from other such words.
    fn reference(
        params: &Self::Params,
        constants: &Self::Constants,
        words: &mut [Vec<u32>],
        before: &mut [Vec<u32>],
    ) -> Vec<Tolerance>;
}

#[cfg(feature = "train")]
impl<K: Reference> Recordable for K {
    fn reference(
        params: &Self::Params,
        constants: &Self::Constants,
        words: &mut [Vec<u32>],
        before: &mut [Vec<u32>],
    ) -> Vec<Tolerance> {
        K::run(params, constants, K::slices(words));
        K::tolerances(params, constants, K::slices(before)).into()
    }
}

/// Nothing is checked: [`Gpu::checked`](super::Gpu) is absent.
#[cfg(not(feature = "train"))]
impl<K: Kernel> Recordable for K {
    fn reference(
        _: &Self::Params,
        _: &Self::Constants,
        _: &mut [Vec<u32>],
        _: &mut [Vec<u32>],
    ) -> Vec<Tolerance> {
        vec![]
    }
}

/// The CPU reference of a kernel: same parameters, same buffers, plain loops.
///
/// It reads no more of a slice than parameters and counts specify: a buffer may be longer than a view needs, and its
/// tail is undefined.
#[cfg(feature = "train")]
pub trait Reference: OnHost {
    /// Does to the slices what the kernel does to the buffers.
    fn run(params: &Self::Params, constants: &Self::Constants, slices: Self::Slices<'_>);

    /// The allowed difference between the kernel's results and those of [`Reference::run`] on the same slices:
    /// roundings of single precision, and both sides of a cutoff where that decides. Exact unless a reference overrides
    /// it.
    fn tolerances(
        params: &Self::Params,
        constants: &Self::Constants,
        slices: Self::Slices<'_>,
    ) -> Self::Tolerances {
        let _ = (params, constants, slices);
        Self::Tolerances::default()
    }
}
