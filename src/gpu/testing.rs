//! The validated device that all tests of a process share, and injected faults.

use std::cell::Cell;
use std::num::NonZeroU32;
use std::sync::atomic::Ordering;
use std::sync::{Arc, OnceLock};

use ash::vk;
pub use nightsplat_core::testing::not_run;

pub use super::faults::Faults;
use super::{DeviceChoice, Gpu, GpuShared, Interface, Properties, Sorting, TunedTile, Tuning};

static GPU: OnceLock<Gpu> = OnceLock::new();

/// If set, devices run the passes and layouts that a GPU has, on a CPU too: what differs is found before there is one.
const AS_A_GPU_VARIABLE: &str = "NIGHTSPLAT_AS_A_GPU";

/// The device that tests share, with validation and synchronization validation: any message fails the process at its
/// exit, with the name of the test. `NIGHTSPLAT_DEVICE` selects another device than the default.
///
/// # Panics
/// There is no device or no validation layer: a test without them proves nothing.
pub fn gpu() -> Gpu {
    GPU.get_or_init(|| open(|_| ())).clone()
}

/// Another device with validation, whose passes bind descriptor sets.
///
/// # Panics
/// As [`gpu`].
pub fn gpu_that_binds_sets() -> Gpu {
    open(|shared| shared.descriptors = super::descriptors::Descriptors::InSets)
}

/// Another device with validation, with this limit on the bytes of a binding.
///
/// # Panics
/// As [`gpu`].
pub fn gpu_that_binds(bytes: u64) -> Gpu {
    open(|shared| shared.properties.max_storage_buffer_range = bytes)
}

/// Another device with validation, with these properties instead of its own.
///
/// # Panics
/// As [`gpu`].
pub fn gpu_with(adapt: impl FnOnce(&mut Properties)) -> Gpu {
    open(|shared| adapt(&mut shared.properties))
}

/// Another device with validation, a GPU by its properties, where a sort of each tile, and 1536 strips for SSIM, were
/// measured to be the fastest.
///
/// # Panics
/// As [`gpu`].
pub fn gpu_that_sorts_tiles() -> Gpu {
    open(|shared| {
        shared.properties.is_cpu = false;
        let tile = TunedTile { channels: 3, tile: [16, 16].into(), sorting: Sorting::Tiles };
        let ssim_strips = NonZeroU32::new(1536);
        shared.tuning = OnceLock::from(Tuning { tiles: vec![tile], ssim_strips });
    })
}

/// A kernel's module, frozen with these constants for subgroups of this size.
pub fn frozen(
    interface: &Interface,
    constants: Vec<(u32, u32)>,
    subgroup_size: u32,
) -> std::io::Result<Vec<u32>> {
    let code = ash::util::read_spv(&mut std::io::Cursor::new(interface.spirv))?;
    let subgroup_size = interface.subgroup_size_id.map(|id| (id, subgroup_size));
    let constants: Vec<_> = constants.into_iter().chain(subgroup_size).collect();
    Ok(super::spirv::frozen(&code, &constants))
}

#[expect(clippy::panic, reason = "a test without a device must fail")]
fn open(adapt: impl FnOnce(&mut GpuShared)) -> Gpu {
    super::validation::fail_at_exit();
    let choice = std::env::var("NIGHTSPLAT_DEVICE").unwrap_or_default();
    let choice: DeviceChoice = choice.parse().unwrap_or_else(|error| panic!("{error}"));
    let mut gpu = Gpu::with_validation(&choice).unwrap_or_else(|error| panic!("{error}"));
    if let Some(shared) = Arc::get_mut(&mut gpu.shared) {
        shared.properties.is_cpu &=
            std::env::var_os(AS_A_GPU_VARIABLE).is_none_or(|value| value.is_empty());
        adapt(shared);
        // What was compiled so far was for other properties.
        // SAFETY: nothing was submitted since the self-test, which waits for its end.
        unsafe { shared.destroy_pipelines() };
    }
    gpu
}

/// Does what the validation layer must object to: creates a buffer of no bytes.
pub fn misuse(gpu: &Gpu) {
    let device = &gpu.shared.device;
    let info = vk::BufferCreateInfo::default().usage(vk::BufferUsageFlags::STORAGE_BUFFER);
    // SAFETY: the device is live. The size is wrong on purpose; drivers bear it, and nothing uses the buffer.
    unsafe {
        if let Ok(buffer) = device.create_buffer(&info, None) {
            device.destroy_buffer(buffer, None);
        }
    }
}

/// The numbers of dispatches and barriers recorded for the device since it was opened.
pub fn recorded(gpu: &Gpu) -> [u64; 2] {
    let super::Recorded { dispatches, barriers, .. } = &gpu.shared.recorded;
    [dispatches, barriers].map(|count| count.load(Ordering::Relaxed))
}

/// The number of kernels that the device has compiled, each with its constants.
pub fn compiled(gpu: &Gpu) -> usize {
    super::lock(&gpu.shared.pipelines).len()
}

/// The number of command buffers submitted to the device since it was opened.
pub fn submitted(gpu: &Gpu) -> u64 {
    gpu.shared.recorded.submits.load(Ordering::Relaxed)
}

/// Whether what this thread submits is checked.
pub fn is_checked(gpu: &Gpu) -> bool {
    gpu.shared.checks.are_on()
}

/// The faults injected into a device.
pub fn faults(gpu: &Gpu) -> &Faults {
    &gpu.shared.faults
}

/// While it lives, allocations and submissions are not counted, and none fails.
#[derive(Debug)]
pub struct PausedFaults<'a>(&'a Gpu);

/// Pauses the injected faults: the self-test is no part of what is tested.
pub fn pause_faults(gpu: &Gpu) -> PausedFaults<'_> {
    gpu.shared.faults.pause(true);
    PausedFaults(gpu)
}

impl Drop for PausedFaults<'_> {
    fn drop(&mut self) {
        self.0.shared.faults.pause(false);
    }
}

/// A wiring defect: of the pass's parameters, `bits` of 32-bit word `word` reach the device flipped.
#[derive(Clone, Copy, Debug)]
pub struct Defect {
    /// The kernel.
    pub kernel: &'static str,
    /// The index of the word among its parameters.
    pub word: usize,
    /// The bits to flip.
    pub bits: u32,
}

thread_local! {
    static DEFECT: Cell<Option<Defect>> = const { Cell::new(None) };
}

/// Runs `work` on a device that has the defect, in checked passes.
pub fn with_defect<R>(defect: Defect, work: impl FnOnce() -> R) -> R {
    struct Planted;
    impl Drop for Planted {
        fn drop(&mut self) {
            DEFECT.set(None);
        }
    }
    DEFECT.set(Some(defect));
    // Removed where the work panics too.
    let _planted = Planted;
    work()
}

/// The parameters of a pass, altered where the kernel has the defect.
pub(super) fn with_defect_of(kernel: &str, params: &[u8]) -> Vec<u8> {
    let mut params = params.to_vec();
    if let Some(defect) = DEFECT.get().filter(|defect| defect.kernel == kernel) {
        let bytes = params.iter_mut().skip(4 * defect.word);
        bytes.zip(defect.bits.to_le_bytes()).for_each(|(byte, bits)| *byte ^= bits);
    }
    params
}
