//! A device that a host application lends, and the contract on its queue, its frames and its memory.
//!
//! - The host's timeline is a use of a resource: what a recording for frame `n` uses is kept until the host says that
//!   frame `n` is done, by its timeline semaphore or by [`Gpu::frames_done`].
//! - Uploads wait for the next recording: creating a buffer or a renderer submits nothing. A recording that the host
//!   drops leaves them to the one after it.
//! - Our own submissions hold the host's lock around `vkQueueSubmit2` alone; a record-only device has none.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use ash::vk;
use ash::vk::Handle as _;
use gpu_allocator::MemoryLocation;

use super::allocated::DeviceMemory;
use super::lent::{HostDevice, HostFrame, QueueLock};
use super::recorder::{HOST_SUBMITS, Recorder};
use super::{Bound, Gpu, GpuShared, lock};
use crate::{Error, Result};

/// What we know of the host of a lent device.
pub(super) struct Host {
    pub(super) is_record_only: bool,
    queue_lock: Option<QueueLock>,
    frames: vk::Semaphore,
    frames_done: AtomicU64,
    /// The number of the last frame that was recorded.
    last_frame: AtomicU64,
    /// Uploads for the next recording, in order.
    uploads: Mutex<Vec<PendingUpload>>,
    /// Those of recordings that may have been dropped.
    recorded: Mutex<Vec<RecordedUploads>>,
    /// The pipeline cache is the host's.
    pub(super) lends_pipeline_cache: bool,
}

// SAFETY: the host promises that its callbacks may be called from any thread.
unsafe impl Send for Host {}
// SAFETY: as above.
unsafe impl Sync for Host {}

/// A change of a buffer that the next recording begins with.
pub(super) enum PendingUpload {
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

/// The uploads of a recording.
struct RecordedUploads {
    /// Of the host's; `None`: of a submission of our own, which is not dropped.
    frame: Option<u64>,
    uploads: Vec<PendingUpload>,
    /// A word on the host that the recording sets to 1: a frame that is done may never have been submitted.
    has_run: DeviceMemory,
}

impl RecordedUploads {
    fn have_run(&self) -> bool {
        self.has_run.mapped().is_none_or(|mapped| mapped[0] == 1)
    }
}

impl PendingUpload {
    fn target(&self) -> vk::Buffer {
        match self {
            Self::Fill { target, .. } | Self::Copy { target, .. } => target.raw,
        }
    }

    pub(super) fn record(&self, recorder: &mut Recorder<'_>) {
        match self {
            &Self::Fill { target, word } => recorder.fill_raw(target, word),
            Self::Copy { staging, target, bytes } => {
                recorder.copy_raw(staging.bound(), *target, *bytes);
            }
        }
    }
}

impl Host {
    pub(super) fn new(lent: &HostDevice<'_>) -> Self {
        Self {
            is_record_only: lent.is_record_only,
            queue_lock: lent.queue_lock,
            frames: vk::Semaphore::from_raw(lent.frames),
            frames_done: AtomicU64::new(0),
            last_frame: AtomicU64::new(0),
            uploads: Mutex::default(),
            recorded: Mutex::default(),
            lends_pipeline_cache: lent.pipeline_cache != 0,
        }
    }

    /// Calls `submit` with the host's lock held.
    pub(super) fn with_queue<T>(&self, queue: vk::Queue, submit: impl FnOnce() -> T) -> T {
        let Some(QueueLock { lock, unlock, user }) = self.queue_lock else { return submit() };
        // SAFETY: the host promises that both can be called from any thread with its own pointer.
        unsafe {
            let queue = queue.as_raw() as *mut std::ffi::c_void;
            lock(user, queue);
            let done = submit();
            unlock(user, queue);
            done
        }
    }

    pub(super) fn add(&self, upload: PendingUpload) {
        lock(&self.uploads).push(upload);
    }

    /// Puts uploads before those that wait.
    fn requeue(&self, mut first: Vec<PendingUpload>) {
        let mut waiting = lock(&self.uploads);
        first.append(&mut waiting);
        *waiting = first;
    }

    /// Forgets the uploads into a buffer that is dropped.
    pub(super) fn forget(&self, target: vk::Buffer) {
        let is_into = |upload: &mut PendingUpload| upload.target() == target;
        // Memory is dropped once the lists are free again.
        let forgotten: Vec<_> = lock(&self.uploads).extract_if(.., is_into).collect();
        drop(forgotten);
        let mut recorded = lock(&self.recorded);
        let forgotten: Vec<_> =
            recorded.iter_mut().flat_map(|them| them.uploads.extract_if(.., is_into)).collect();
        let empty: Vec<_> = recorded.extract_if(.., |them| them.uploads.is_empty()).collect();
        drop(recorded);
        drop((forgotten, empty));
    }
}

impl GpuShared {
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
        self: &Arc<Self>,
        recorder: &mut Recorder<'_>,
        record: impl FnOnce(&mut Recorder<'_>) -> Result<()>,
    ) -> Result<()> {
        let Some(host) = &self.host else { return record(recorder) };
        if lock(&host.uploads).is_empty() {
            return record(recorder);
        }
        let mut has_run = DeviceMemory::new(self, "has run", 4, MemoryLocation::GpuToCpu)?;
        if let Some(mapped) = has_run.mapped_mut() {
            mapped.fill(0);
        }
        let uploads = std::mem::take(&mut *lock(&host.uploads));
        uploads.iter().for_each(|upload| upload.record(recorder));
        let mark = has_run.bound();
        let frame = (recorder.value() == HOST_SUBMITS).then(|| self.last_frame());
        // In the list while `record` runs, which may drop a buffer.
        lock(&host.recorded).push(RecordedUploads { frame, uploads, has_run });
        let done = record(recorder);
        if done.is_ok() && frame.is_some() {
            recorder.fill_raw(mark, 1);
            recorder.leave_for_host();
            return done;
        }
        let is_this = |them: &mut RecordedUploads| them.has_run.handle() == mark.raw;
        let settled: Vec<_> = lock(&host.recorded).extract_if(.., is_this).collect();
        if done.is_err() {
            host.requeue(settled.into_iter().flat_map(|them| them.uploads).collect());
        }
        done
    }

    /// Frees the uploads that the device has run. Those of a recording that was dropped wait for the next one.
    fn settle_uploads(&self) {
        let Some(host) = &self.host else { return };
        if lock(&host.recorded).is_empty() {
            return;
        }
        let reached = self.frames_reached();
        let settled: Vec<_> = lock(&host.recorded)
            .extract_if(.., |them| them.frame.is_some_and(|frame| frame <= reached))
            .collect();
        let mut dropped = vec![];
        for mut them in settled {
            if !them.have_run() {
                let frame = them.frame.unwrap_or_default();
                tracing::warn!("frame {frame} was not submitted; its uploads are part of the next");
                dropped.append(&mut them.uploads);
            }
        }
        host.requeue(dropped);
    }
}

impl Gpu {
    /// Records into a command buffer of the host application, which submits it once, in the order of recording. What
    /// the recording uses is kept until the frame is done. It begins with the uploads that wait. Where a host drops a
    /// recording and reports its frame as done, its uploads are part of the next.
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
        shared.settle_uploads();
        shared.collect(shared.reached());
        let mut recorder = Recorder::for_host(shared, frame);
        shared.with_uploads(&mut recorder, record)?;
        recorder.finish();
        Ok(())
    }

    /// Reports that all frames up to `frame` are done or were never submitted, and frees what they used.
    pub fn frames_done(&self, frame: u64) {
        if let Some(host) = &self.shared.host {
            host.frames_done.fetch_max(frame, Ordering::AcqRel);
            self.shared.settle_uploads();
        }
        self.shared.collect(self.shared.reached());
    }
}
