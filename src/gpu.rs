//! A thin, typed layer over Vulkan compute: a device, its buffers, and a recorder of passes.
//!
//! The only module that speaks Vulkan, and the only one with `unsafe`. It rests on four rules:
//!
//! - one queue, one timeline semaphore, one `u64` per submission; nothing waits for the whole device;
//! - a dropped buffer is freed once every submission, ours or a host's, that may use it is done; a pipeline is compiled
//!   once and kept as long as the device;
//! - barriers follow from what a kernel declares it reads and writes, never from the caller;
//! - a borrowed device ([`Gpu::from_host`]) keeps everything that it had: we destroy what we created and nothing else.

mod address_space;
mod allocated;
mod buffer;
mod check;
mod checked;
mod choice;
mod cooperative;
mod descriptors;
mod device;
mod device_report;
mod download;
#[cfg(debug_assertions)]
mod faults;
mod features;
mod functions;
mod host;
mod image;
mod instance;
mod kernel;
mod lent;
mod limits;
mod memory;
mod parts;
mod pci;
mod pipeline;
mod reconvergence;
mod recorder;
mod requirements;
mod ring;
mod slice;
mod spirv;
mod statistics;
mod subgroups;
mod submission;
mod supported;
#[cfg(debug_assertions)]
#[doc(hidden)]
pub mod testing;
mod tuning;
mod upload;
mod validation;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::{self, ThreadId};

use ash::{ext, khr, vk};

pub use allocated::HostMemoryError;
pub use buffer::Buffer;
pub use check::{CheckReport, CheckedPass, Difference, Tolerance};
pub use choice::DeviceChoice;
pub(crate) use choice::SchedulerVariables;
pub use cooperative::CooperativeMatrix;
pub(crate) use device::cache_folder;
pub use device::check_physical_device;
pub use device_report::{DeviceLimits, DeviceReport, RequirementReport, devices};
pub use download::Download;
pub use features::{FeatureStructs, require_features};
pub use image::{HostImage, ImageFormat, ImageState};
pub use kernel::{Binding, Bound, Interface, Kernel, Recordable};
#[cfg(feature = "train")]
pub use kernel::{OnHost, Reference};
pub use lent::{
    HostAllocation, HostDevice, HostFrame, HostRequirements, MemoryFunctions, QueueLock,
};
pub(crate) use limits::WORKGROUP;
pub use memory::MemoryBudget;
pub use pci::PciAddress;
pub use pipeline::Pipeline;
pub use recorder::{Recorder, Threads};
pub use requirements::{REQUIREMENTS, Requirement};
pub(crate) use ring::Ring;
pub use slice::{Slice, SliceMut};
pub use statistics::{Resources, Statistic};
pub use subgroups::SUBGROUP_VARIABLE;
pub use submission::{PassTime, Submission};
pub use supported::PUSH_VARIABLE;
pub use tuning::{BackwardForm, RecordSums, Sorting, TUNE_VARIABLE, Tile, TunedTile, Tuning};

use crate::{Error, Result};

/// A Vulkan device with one compute queue. Cloning shares the device.
#[derive(Clone, Debug)]
pub struct Gpu {
    shared: Arc<GpuShared>,
}

/// The identity of a device and its limits.
#[derive(Clone, Debug)]
pub struct Properties {
    /// The device's name, as the driver gives it.
    pub name: String,
    /// The driver's name and version, as the driver gives them.
    pub driver: String,
    /// The PCI number of the vendor, or one that Khronos assigned.
    pub vendor: u32,
    /// Bytes of device-local memory.
    pub memory: u64,
    /// Lanes of a subgroup in the kernels.
    pub subgroup_size: u32,
    /// Kernels can require that subgroup size.
    pub subgroup_size_is_selectable: bool,
    /// Bytes that one storage buffer binding can span, within one buffer.
    pub max_storage_buffer_range: u64,
    /// Bytes of the largest buffer: the lesser of `maxBufferSize` and `maxMemoryAllocationSize`.
    pub max_buffer_size: u64,
    /// Workgroups of a dispatch along one dimension.
    pub max_workgroups: u32,
    /// Bytes of shared memory of a workgroup.
    pub max_shared_memory: u32,
    /// Loop iterations, summed over all loops, after which an invocation silently leaves its loops.
    pub max_loop_iterations: u32,
    /// Valid bits of a timestamp on the queue; 0 where the queue has none, and passes cannot be timed.
    pub timestamp_bits: u32,
    /// Nanoseconds of one timestamp tick.
    pub timestamp_period: f32,
    /// The device is a CPU (lavapipe and the like).
    pub is_cpu: bool,
    /// Products of 16-bit matrices; `None` where the device does not support them or a host lends it.
    pub cooperative_matrix: Option<CooperativeMatrix>,
    /// Subgroup-uniform control flow is guaranteed (`VK_KHR_shader_subgroup_uniform_control_flow`); never of a device
    /// that a host lends.
    pub has_uniform_subgroup_control_flow: bool,
    /// Passes push their descriptors; else they bind descriptor sets.
    pub has_push_descriptors: bool,
    /// The driver gets specialization constants as such; else as plain constants.
    pub driver_specializes: bool,
    /// The driver reports registers and spills of kernels; never of a device that a host lends.
    pub has_pipeline_statistics: bool,
}

/// Everything that buffers, pipelines and submissions need to outlive their [`Gpu`].
struct GpuShared {
    properties: Properties,
    modules: device::ModuleForm,
    device: ash::Device,
    descriptors: descriptors::Descriptors,
    /// Names objects; absent without the validation layer.
    debug: Option<ext::debug_utils::Device>,
    /// Labels passes; absent without a validation layer that takes labels from several threads.
    labels: Option<ext::debug_utils::Device>,
    /// Statistics of compiled kernels; absent where the device has none.
    executables: Option<khr::pipeline_executable_properties::Device>,
    /// Taken when the device is torn down.
    memory: Mutex<Option<allocated::MemorySource>>,
    /// The host's allocator of what the driver allocates on the host; absent: the driver's own.
    callbacks: Option<vk::AllocationCallbacks<'static>>,
    /// The host that lends the device.
    host: Option<host::Host>,
    queue: Mutex<Queue>,
    /// The family of the queue.
    family: u32,
    progress: Mutex<SubmissionProgress>,
    timeline: vk::Semaphore,
    /// The timeline value of our last submission that may use a resource that is dropped now.
    last_submission: AtomicU64,
    usage: memory::MemoryUsage,
    /// Memory that other processes take of the device; absent where the driver does not report it.
    budget: Option<memory::BudgetQuery>,
    #[cfg(debug_assertions)]
    faults: faults::Faults,
    retired: Mutex<Vec<(LastUse, Retired)>>,
    recorded: Recorded,
    /// The threads whose submissions are checked.
    checks: checked::Checks,
    pipeline_cache: vk::PipelineCache,
    pipelines: Mutex<pipeline::CompiledKernels>,
    /// The file of what is fastest, read on first use.
    tuning: OnceLock<Tuning>,
    /// What we created around the device and destroy with it; `None` for a borrowed device.
    owned: Option<instance::OwnedInstance>,
}

/// What was recorded since the device was opened.
#[derive(Debug, Default)]
struct Recorded {
    dispatches: AtomicU64,
    barriers: AtomicU64,
    submits: AtomicU64,
}

/// The queue is held while a submission is recorded, so that timeline values are known in advance.
#[derive(Debug)]
struct Queue {
    raw: vk::Queue,
}

/// Progress of recording and submission. Unlike the queue, it is locked only briefly.
#[derive(Default)]
struct SubmissionProgress {
    /// The thread that records, and under which label.
    recording: Option<(ThreadId, String)>,
    /// The timeline value of the last submission.
    submitted: u64,
    /// The labels of the submissions in flight, and of the last that is done.
    labels: BTreeMap<u64, String>,
}

impl SubmissionProgress {
    /// The label under which this thread records.
    fn recorded_here(&self) -> Option<&str> {
        let here = thread::current().id();
        self.recording.as_ref().filter(|(thread, _)| *thread == here).map(|(_, label)| &**label)
    }
}

/// The last submission of ours and the last frame of a host's that may use an object; 0: none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct LastUse {
    submission: u64,
    frame: u64,
}

/// A Vulkan object whose owner is gone.
enum Retired {
    Buffer(vk::Buffer, allocated::Allocation),
    Commands(vk::CommandPool),
    Descriptors(vk::DescriptorPool),
    Queries(vk::QueryPool),
}

impl std::fmt::Debug for GpuShared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("properties", &self.properties).finish_non_exhaustive()
    }
}

/// A lock is only poisoned by a panic elsewhere; our state stays consistent at every point where one could occur.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn vulkan_error(call: &'static str, device: String, result: vk::Result) -> Error {
    Error::Vulkan { call, device, result: result.to_string(), code: result.as_raw() }
}

impl Gpu {
    /// The device's identity and limits.
    pub fn properties(&self) -> &Properties {
        &self.shared.properties
    }
}

impl GpuShared {
    /// An error for a Vulkan call that failed.
    fn error(&self, call: &'static str, result: vk::Result) -> Error {
        let device = self.properties.name.clone();
        match result {
            vk::Result::ERROR_DEVICE_LOST => {
                let submission = self.unfinished().unwrap_or_else(|| call.to_owned());
                Error::DeviceLost { device, submission }
            }
            _ => vulkan_error(call, device, result),
        }
    }

    fn callbacks(&self) -> Option<&vk::AllocationCallbacks<'static>> {
        self.callbacks.as_ref()
    }

    /// The value that the timeline has reached.
    fn reached(&self) -> u64 {
        // SAFETY: the semaphore lives as long as `self`. A lost device may not know.
        unsafe { self.device.get_semaphore_counter_value(self.timeline) }.unwrap_or(0)
    }

    /// The label of the submission that the device executes, or of the last one if all are done.
    fn unfinished(&self) -> Option<String> {
        let done = self.reached();
        let progress = lock(&self.progress);
        let (mut all, later) =
            (progress.labels.values(), progress.labels.range(done.saturating_add(1)..));
        later.map(|(_, label)| label).next().or_else(|| all.next_back()).cloned()
    }

    /// Blocks until the timeline reaches `value`, then frees what is no longer used.
    fn wait(&self, value: u64) -> Result<()> {
        let is_coming = {
            let progress = lock(&self.progress);
            let is_recorded_elsewhere =
                progress.recording.is_some() && progress.recorded_here().is_none();
            value <= progress.submitted || is_recorded_elsewhere
        };
        if !is_coming {
            let problem = "a download that was not submitted cannot be waited for; wait once `Gpu::run` or \
                           `Gpu::submit` has returned";
            return Err(Error::Usage(problem.to_owned()));
        }
        let (semaphores, values) = ([self.timeline], [value]);
        let wait = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore lives as long as `self`.
        unsafe { self.device.wait_semaphores(&wait, u64::MAX) }
            .map_err(|result| self.error("vkWaitSemaphores", result))?;
        #[cfg(debug_assertions)]
        if self.faults.is_lost() {
            return Err(self.error("vkWaitSemaphores", vk::Result::ERROR_DEVICE_LOST));
        }
        self.collect(value);
        let mut progress = lock(&self.progress);
        progress.labels = progress.labels.split_off(&value);
        Ok(())
    }

    fn retire(&self, retired: Retired) {
        lock(&self.retired).push((self.last_use(), retired));
    }

    /// The last use of an object that is dropped now.
    fn last_use(&self) -> LastUse {
        let submission = self.last_submission.load(Ordering::Acquire);
        LastUse { submission, frame: self.last_frame() }
    }

    /// Frees every retired object that no submission of ours after `reached` and no unfinished frame of the host's
    /// uses; command buffers before the objects that they name. One thread at a time: validation layers have crashed
    /// where two threads free objects that belong together.
    fn collect(&self, reached: u64) {
        self.collect_within(LastUse { submission: reached, frame: self.frames_reached() });
    }

    fn collect_within(&self, done: LastUse) {
        let is_done = |(last_use, _): &mut (LastUse, Retired)| {
            last_use.submission <= done.submission && last_use.frame <= done.frame
        };
        let mut retired = lock(&self.retired);
        let mut done: Vec<_> = retired.extract_if(.., is_done).collect();
        done.sort_by_key(|(_, retired)| !matches!(retired, Retired::Commands(_)));
        for (_, retired) in done {
            // SAFETY: the timeline has passed the object's last use, and its owner is gone.
            unsafe { self.destroy(retired) };
        }
    }

    /// # Safety
    /// No submission uses the object any more, and it is destroyed once.
    unsafe fn destroy(&self, retired: Retired) {
        let callbacks = self.callbacks();
        // SAFETY: as the caller promises.
        unsafe {
            match retired {
                Retired::Buffer(raw, allocation) => {
                    self.device.destroy_buffer(raw, callbacks);
                    self.usage.subtract(allocation.size());
                    if let Some(memory) = lock(&self.memory).as_mut() {
                        memory.free(allocation);
                    }
                }
                Retired::Commands(pool) => self.device.destroy_command_pool(pool, callbacks),
                Retired::Descriptors(pool) => self.device.destroy_descriptor_pool(pool, callbacks),
                Retired::Queries(pool) => self.device.destroy_query_pool(pool, callbacks),
            }
        }
    }
}

impl Drop for GpuShared {
    fn drop(&mut self) {
        let submitted = lock(&self.progress).submitted;
        // A lost device must still be destroyed.
        let _ = self.wait(submitted);
        // A host destroys its device once all its frames are done.
        self.collect_within(LastUse { submission: u64::MAX, frame: u64::MAX });
        // The allocator returns its memory blocks to the device before the device goes.
        drop(lock(&self.memory).take());
        if let Some(owned) = &self.owned {
            owned.save_pipeline_cache(&self.device, self.pipeline_cache);
        }
        // SAFETY: every object below was created here and nothing uses it any more.
        unsafe {
            self.destroy_pipelines();
            if !self.host.as_ref().is_some_and(|host| host.lends_pipeline_cache) {
                self.device.destroy_pipeline_cache(self.pipeline_cache, self.callbacks());
            }
            self.device.destroy_semaphore(self.timeline, self.callbacks());
            if let Some(owned) = &self.owned {
                self.device.destroy_device(None);
                owned.destroy();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lost_device_names_its_submission() {
        let gpu = Gpu::open(&DeviceChoice::Best).unwrap();
        let lost = || gpu.shared.error("vkQueueSubmit2", vk::Result::ERROR_DEVICE_LOST).to_string();
        assert!(lost().contains("`vkQueueSubmit2`"), "{}", lost());
        gpu.run("the first", |_| Ok(())).unwrap();
        gpu.submit("the second", |_| Ok(())).unwrap();
        assert!(lost().contains("`the second`"), "{}", lost());
        gpu.run("the third", |_| Ok(())).unwrap();
        assert!(lost().contains("`the third`"), "{}", lost());
        assert_eq!(lock(&gpu.shared.progress).labels.len(), 1);
    }
}
