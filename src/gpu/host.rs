//! A device that a host application lends, and the contract on its queue, its frames and its memory.
//!
//! - The host's timeline is a use of a resource: what a recording for frame `n` uses is kept until the host says that
//!   frame `n` is done, by its timeline semaphore or by [`Gpu::frames_done`].
//! - Uploads wait for the next recording: creating a buffer or a renderer submits nothing.
//! - Our own submissions hold the host's lock around `vkQueueSubmit2` alone; a record-only device has none.

use std::ffi::{c_char, c_void};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use ash::vk;
use ash::vk::Handle as _;

use super::allocated::DeviceMemory;
use super::recorder::Recorder;
use super::{Bound, Gpu, Shared, lock};
use crate::{Error, Result};

/// A device that a host application lends, as raw handles, so that C++ hosts and other Vulkan bindings work.
///
/// The host must have enabled [`super::required_device_features`] on the device. It should enable
/// `VK_KHR_push_descriptor` where that is supported, which makes recording faster. It keeps device, instance and queue
/// alive for as long as the [`Gpu`] and everything made with it. What is left at its default is not used:
///
/// ```
/// use nightsplat::HostDevice;
///
/// let host = HostDevice { queue_family: 0, is_record_only: true, ..HostDevice::default() };
/// ```
#[derive(Clone, Copy, Debug)]
pub struct HostDevice {
    /// The address of `vkGetInstanceProcAddr` of the host's loader.
    pub get_instance_proc_addr: *const c_void,
    /// `VkInstance`.
    pub instance: u64,
    /// `VkPhysicalDevice`.
    pub physical_device: u64,
    /// `VkDevice`.
    pub device: u64,
    /// `VkQueue` of the family below, with compute; null where the device only records.
    pub queue: u64,
    /// Its family's index.
    pub queue_family: u32,
    /// The queue is never touched: uploads are part of the next recording, and what submits is an error.
    pub is_record_only: bool,
    /// The host enabled `VK_KHR_push_descriptor`; without it descriptors are bound in sets.
    pub has_push_descriptors: bool,
    /// The host enabled `VK_EXT_debug_utils` on the instance: objects are named, passes are labelled.
    pub names_objects: bool,
    /// Held around each of our submissions. `None`: no other thread uses the queue meanwhile.
    pub queue_lock: Option<QueueLock>,
    /// A timeline `VkSemaphore` that reaches the number of each frame; null: the host calls [`Gpu::frames_done`].
    pub frames: u64,
    /// The host's `VkPipelineCache`; null: one of ours that is not saved.
    pub pipeline_cache: u64,
    /// `VkAllocationCallbacks` for the objects that we create; null: the driver's. Outlives the device.
    pub host_memory: *const c_void,
    /// Allocates device memory. `None`: we allocate blocks of 8 to 256 MiB ourselves.
    pub device_memory: Option<MemoryFunctions>,
}

impl Default for HostDevice {
    fn default() -> Self {
        Self {
            get_instance_proc_addr: std::ptr::null(),
            instance: 0,
            physical_device: 0,
            device: 0,
            queue: 0,
            queue_family: 0,
            is_record_only: false,
            has_push_descriptors: true,
            names_objects: false,
            queue_lock: None,
            frames: 0,
            pipeline_cache: 0,
            host_memory: std::ptr::null(),
            device_memory: None,
        }
    }
}

/// The host's lock on its queue. Any thread may call it; it is held for `vkQueueSubmit2` alone, never while we wait,
/// allocate, record or call back.
#[derive(Clone, Copy, Debug)]
pub struct QueueLock {
    /// Takes the lock.
    pub lock: unsafe extern "C" fn(user: *mut c_void, queue: vk::Queue),
    /// Releases it.
    pub unlock: unsafe extern "C" fn(user: *mut c_void, queue: vk::Queue),
    /// Passed to both.
    pub user: *mut c_void,
}

/// A piece of device memory that the host allocated.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct HostAllocation {
    /// The `VkDeviceMemory`.
    pub memory: vk::DeviceMemory,
    /// Bytes from its start; a multiple of the alignment that was required.
    pub offset: vk::DeviceSize,
    /// The address of the first byte where host-visible memory was required; otherwise ignored.
    pub mapped: *mut c_void,
    /// The host's own.
    pub cookie: *mut c_void,
}

/// The host's allocator of device memory. Any thread may call it.
#[derive(Clone, Copy, Debug)]
pub struct MemoryFunctions {
    /// Fills `out` with memory that has every `required` property and, where there is such memory, every `preferred`
    /// one. `name` says what it is for.
    pub allocate: unsafe extern "C" fn(
        user: *mut c_void,
        requirements: *const vk::MemoryRequirements,
        required: vk::MemoryPropertyFlags,
        preferred: vk::MemoryPropertyFlags,
        name: *const c_char,
        out: *mut HostAllocation,
    ) -> vk::Result,
    /// Frees what `allocate` gave.
    pub free: unsafe extern "C" fn(user: *mut c_void, allocation: *const HostAllocation),
    /// Passed to both.
    pub user: *mut c_void,
}

/// A command buffer of the host's that we record into.
#[derive(Clone, Copy, Debug)]
pub struct HostFrame {
    /// The primary `VkCommandBuffer`, recording on the lent family, outside a render pass.
    pub commands: u64,
    /// The number that the host's timeline reaches once this command buffer is done; it never falls.
    pub number: u64,
    /// `VkPipelineStageFlags2` of the host's own commands that read our buffers, before in the queue or later; 0 where
    /// it reads images alone.
    pub readers: u64,
}

/// What we know of the host of a lent device.
pub(super) struct Host {
    pub(super) is_record_only: bool,
    queue_lock: Option<QueueLock>,
    frames: vk::Semaphore,
    frames_done: AtomicU64,
    /// The number of the last frame that was recorded.
    last_frame: AtomicU64,
    /// Uploads for the next recording, in order.
    uploads: Mutex<Vec<Upload>>,
    /// The pipeline cache is the host's.
    pub(super) owns_pipeline_cache: bool,
}

// SAFETY: the host promises that its callbacks may be called from any thread.
unsafe impl Send for Host {}
// SAFETY: as above.
unsafe impl Sync for Host {}

/// A change of a buffer that the next recording begins with.
pub(super) enum Upload {
    /// Every 32-bit word.
    Fill {
        target: Bound,
        word: u32,
    },
    Copy {
        staging: DeviceMemory,
        target: Bound,
        bytes: u64,
    },
}

impl Upload {
    fn target(&self) -> vk::Buffer {
        match self {
            Self::Fill { target, .. } | Self::Copy { target, .. } => target.raw,
        }
    }

    fn record(&self, recorder: &mut Recorder<'_>) {
        match self {
            &Self::Fill { target, word } => recorder.fill_raw(target, word),
            Self::Copy { staging, target, bytes } => {
                recorder.copy_raw(staging.bound(), *target, *bytes);
            }
        }
    }
}

impl Host {
    pub(super) fn new(lent: &HostDevice) -> Self {
        Self {
            is_record_only: lent.is_record_only,
            queue_lock: lent.queue_lock,
            frames: vk::Semaphore::from_raw(lent.frames),
            frames_done: AtomicU64::new(0),
            last_frame: AtomicU64::new(0),
            uploads: Mutex::default(),
            owns_pipeline_cache: lent.pipeline_cache != 0,
        }
    }

    /// Calls `submit` with the host's lock held.
    pub(super) fn with_queue<T>(&self, queue: vk::Queue, submit: impl FnOnce() -> T) -> T {
        let Some(QueueLock { lock, unlock, user }) = self.queue_lock else { return submit() };
        // SAFETY: the host promises that both can be called from any thread with its own pointer.
        unsafe {
            lock(user, queue);
            let done = submit();
            unlock(user, queue);
            done
        }
    }

    pub(super) fn add(&self, upload: Upload) {
        lock(&self.uploads).push(upload);
    }

    /// Forgets the uploads into a buffer that is dropped.
    pub(super) fn forget(&self, target: vk::Buffer) {
        // Staging memory is dropped once the list is free again.
        let forgotten: Vec<_> =
            lock(&self.uploads).extract_if(.., |upload| upload.target() == target).collect();
        drop(forgotten);
    }
}

impl Shared {
    /// The number of the last frame that was recorded; 0 without a host.
    pub(super) fn last_frame(&self) -> u64 {
        self.host.as_ref().map_or(0, |host| host.last_frame.load(Ordering::Acquire))
    }

    /// The number of the last frame that the host's device is done with.
    pub(super) fn frames_reached(&self) -> u64 {
        let Some(host) = &self.host else { return 0 };
        let told = host.frames_done.load(Ordering::Acquire);
        if host.frames == vk::Semaphore::null() {
            return told;
        }
        // SAFETY: the host keeps its semaphore alive. A lost device may not know.
        let counted = unsafe { self.device.get_semaphore_counter_value(host.frames) };
        told.max(counted.unwrap_or_default())
    }

    /// Begins a recording with the uploads that wait for one; `record` follows. Where it fails, the next recording
    /// begins with them again.
    pub(super) fn with_uploads(
        &self,
        recorder: &mut Recorder<'_>,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<()>,
    ) -> Result<()> {
        let Some(host) = &self.host else { return record(recorder) };
        let mut uploads = std::mem::take(&mut *lock(&host.uploads));
        uploads.iter().for_each(|upload| upload.record(recorder));
        record(recorder).inspect_err(|_| {
            let mut waiting = lock(&host.uploads);
            uploads.append(&mut waiting);
            *waiting = std::mem::take(&mut uploads);
        })
    }
}

impl Gpu {
    /// Records into a command buffer of the host application, which submits it once, in the order of recording. What
    /// the recording uses is kept until the frame is done.
    ///
    /// # Errors
    /// What `record` returns; [`Error::Usage`] where the frame's number falls, the device is not lent, or this thread
    /// records already. Nothing is recorded then.
    ///
    /// # Safety
    /// `frame.commands` is recording on this device's queue family, outside a render pass.
    pub unsafe fn record_into(
        &self,
        frame: &HostFrame,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<()>,
    ) -> Result<()> {
        let shared = &self.shared;
        let Some(host) = &shared.host else {
            let problem = "only a device that a host lends records into its command buffers; use \
                           `Gpu::from_host`";
            return Err(Error::Usage(problem.to_owned()));
        };
        shared.refuse_nested("a frame of the host")?;
        let (number, last) = (frame.number, shared.last_frame());
        if number < last {
            return Err(Error::Usage(format!(
                "frame {number} is recorded after frame {last}; frame numbers never fall"
            )));
        }
        host.last_frame.store(number, Ordering::Release);
        shared.collect(shared.reached());
        let mut recorder = Recorder::for_host(shared, frame);
        shared.with_uploads(&mut recorder, record)?;
        recorder.finish();
        Ok(())
    }

    /// Tells that the host's device is done with every frame up to `frame`, or that those left were never submitted;
    /// frees what they used.
    pub fn frames_done(&self, frame: u64) {
        if let Some(host) = &self.shared.host {
            host.frames_done.fetch_max(frame, Ordering::AcqRel);
        }
        self.shared.collect(self.shared.reached());
    }

    /// The number of the last frame of the host's that is done.
    #[cfg_attr(feature = "testing", visibility::make(pub))]
    pub(crate) fn frames_reached(&self) -> u64 {
        self.shared.frames_reached()
    }

    /// Makes a change of a buffer: at once, or with the next recording where a host lends the device.
    pub(super) fn upload(&self, name: &str, upload: Upload) -> Result<()> {
        match &self.shared.host {
            Some(host) => {
                host.add(upload);
                Ok(())
            }
            None => self.run(name, |pass| {
                upload.record(pass);
                Ok(())
            }),
        }
    }
}
