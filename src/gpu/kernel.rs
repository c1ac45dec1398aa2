//! What a compute shader tells the host about itself.

use ash::vk;

/// One storage buffer of a kernel.
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// The name of the array in the shader.
    pub name: &'static str,
    /// The binding number.
    pub index: u32,
    /// False where the shader says `readonly`.
    pub writable: bool,
}

/// A compute shader and everything the host must know to launch it.
///
/// Implemented by `build.rs` from the SPIR-V; never by hand.
pub trait Kernel: 'static {
    /// The shader's stem: also its label in captures, timings and errors.
    const NAME: &'static str;
    /// The module, little-endian words.
    const SPIRV: &'static [u8];
    /// Threads of a workgroup; zero along x stands for the device's subgroup size.
    const WORKGROUP_SIZE: [u32; 3];
    /// The specialization constant that takes the subgroup size, where a workgroup is one subgroup.
    const SUBGROUP_SIZE_ID: Option<u32>;
    /// The storage buffers in binding order.
    const BINDINGS: &'static [Binding];
    /// The push constants.
    type Params: bytemuck::Pod;
    /// The specialization constants.
    type Constants;
    /// The buffers of a dispatch.
    type Buffers<'a>;
    /// The buffers in host memory, for the reference.
    type Slices<'a>;
    /// The Vulkan buffers in binding order.
    fn handles(buffers: &Self::Buffers<'_>) -> Vec<vk::Buffer>;
    /// Specialization ids and the bits of their values.
    fn constants(constants: &Self::Constants) -> Vec<(u32, u32)>;
}

/// The CPU reference of a kernel: same parameters, same buffers, plain loops.
pub trait Reference: Kernel {
    /// Does to the slices what the kernel does to the buffers.
    fn run(params: &Self::Params, constants: &Self::Constants, slices: Self::Slices<'_>);
}
